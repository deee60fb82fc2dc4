"""Azimuths drawn exactly from Snell's geometry: a uniform offset h over the fibre, refracted."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from dsfit.bsdf.snell import Caustic, Refraction, exit_trt, rays_trt, rays_tt
from dsfit.context import Context
from dsfit.errors import as_real, check_choice, check_range
from dsfit.frame import wrap
from dsfit.proposals.base import Azimuthal, AzimuthalDistribution

_LOBES = ("R", "TT", "TRT")


@dataclass(frozen=True)
class OffsetDistribution(AzimuthalDistribution):
    """phi of the ray at offset h = 2 u - 1, given theta_diff; density (1/2) sum over roots of |dphi/dh|^-1."""

    theta_r: Tensor
    eta: Tensor
    lobe: str

    def select(self, take: Callable[[Tensor], Tensor]) -> OffsetDistribution:
        return OffsetDistribution(take(self.theta_r), self.eta, self.lobe)

    def _kappa(self, theta_i: Tensor) -> Tensor:
        return Refraction.at(self.eta, 0.5 * (self.theta_r - theta_i)).kappa

    def sample(self, u: Tensor, theta_i: Tensor) -> Tensor:
        # asin is steep at its ends; 1 - |h| is known exactly from u there
        h = (2 * u[..., 0] - 1).clamp(-1 + torch.finfo(u.dtype).eps, 1 - torch.finfo(u.dtype).eps)
        kappa, gamma = torch.broadcast_tensors(self._kappa(theta_i), torch.asin(h))
        if self.lobe == "R":
            return -2 * gamma
        if self.lobe == "TT":
            return wrap(math.pi - 2 * gamma + 2 * torch.asin(kappa * torch.sin(gamma)))
        return wrap(exit_trt(kappa, gamma))

    def log_prob(self, phi: Tensor, theta_i: Tensor) -> Tensor:
        kappa, phi = torch.broadcast_tensors(self._kappa(theta_i), phi.abs())
        density = {"R": self._r, "TT": self._tt, "TRT": self._trt}[self.lobe](kappa, phi)
        empty = density <= 0
        return torch.log(torch.where(empty, 1.0, density)).masked_fill(empty, -math.inf)

    def _r(self, kappa: Tensor, phi: Tensor) -> Tensor:
        return torch.cos(phi / 2).clamp_min(0.0) / 4

    def _tt(self, kappa: Tensor, phi: Tensor) -> Tensor:
        rays = rays_tt(kappa, phi)
        return torch.where(rays.lit, rays.spread / 2, 0.0)

    def _trt(self, kappa: Tensor, phi: Tensor) -> Tensor:
        total = torch.zeros_like(phi)
        for rays in rays_trt(kappa, Caustic.at(kappa), phi):
            total = total + torch.where(rays.lit, rays.spread / 2, 0.0)
        return total


class OffsetAzimuth(Azimuthal):
    """Exact-offset azimuth of R, TT or TRT: h uniform on [-1, 1], phi by Snell's law at theta_diff (d'Eon et al. 2013
    in spirit).

    Its density is N_p with A = 1: all of the geometry, with its support edges and its caustic, none of the absorption.
    That of TRT is unbounded (but integrable) at the caustic, as the raw N_TRT is.

    Args:
        lobe: "R", "TT" or "TRT".
        eta: refractive index, > 1.

    Raises:
        InputError: another lobe, or eta <= 1.
    """

    eta: Tensor

    def __init__(self, lobe: str, eta: float | Tensor) -> None:
        super().__init__()
        self.lobe = check_choice("lobe", lobe, _LOBES)
        value = as_real("eta", eta, torch.float64).detach().clone()
        self.register_buffer("eta", check_range("eta", value, 1.0, open_low=True))

    def forward(self, context: Context) -> OffsetDistribution:
        return OffsetDistribution(context.theta_r, self.eta.to(context.dtype), self.lobe)
