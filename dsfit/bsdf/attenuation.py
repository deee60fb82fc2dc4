"""Attenuation A(p, h) of the ray with p internal segments, and its integrals over offsets."""

from __future__ import annotations

import math
from typing import Literal

import torch
from torch import Tensor

from dsfit.bsdf.fresnel import fresnel
from dsfit.bsdf.snell import Caustic, Refraction, cos_refracted, exit_trt
from dsfit.frame import HALF_PI
from dsfit.quadrature import gauss_legendre

Absorption = Literal["geometric", "printed2003"]


def attenuation(
    p: int, refraction: Refraction, sigma_a: Tensor, sin_gamma: Tensor, cos_gamma: Tensor, absorption: Absorption
) -> Tensor:
    """A(p, h), shape `[..., C]`: A(0) = F; A(p) = (1 - F)^2 F^(p - 1) T^p.

    T = exp(-2 sigma' cos gamma_t) ("geometric", Zinke and Weber 2007 eq 20) or exp(-4 sigma' cos^2 gamma_t)
    ("printed2003", Marschner et al. 2003), sigma' = sigma_a / cos(theta_t).
    """
    reflected, transmitted = fresnel(refraction.eta, refraction.cos_diff * cos_gamma)
    if p == 0:
        return reflected.unsqueeze(-1).expand(*reflected.shape, sigma_a.shape[-1])
    cos_t = cos_refracted(refraction.kappa, sin_gamma)
    path = 2 * cos_t if absorption == "geometric" else 4 * cos_t * cos_t
    depth = (p * path / refraction.cos_t).unsqueeze(-1) * sigma_a
    scale = transmitted * transmitted * reflected ** (p - 1)
    return scale.unsqueeze(-1) * torch.exp(-depth)


def integrate_offsets(
    p: int,
    refraction: Refraction,
    sigma_a: Tensor,
    low: Tensor,
    high: Tensor,
    absorption: Absorption,
    weight=None,  # noqa: ANN001
    nodes: int = 32,
) -> Tensor:
    """(1/2) int A(p, h) w dh over h = sin(gamma), gamma in [low, high], by Gauss-Legendre in gamma; shape `[..., C]`.

    In gamma the integrand is analytic (dh = cos(gamma) d gamma removes the square roots at |h| = 1). `weight(gamma)`
    is an optional factor.
    """
    x, w = gauss_legendre(nodes, low.dtype, low.device)
    half = (high - low).unsqueeze(-1) / 2
    gamma = low.unsqueeze(-1) + half * (1 + x)
    wide = refraction.map(lambda value: value.unsqueeze(-1))
    sin_gamma, cos_gamma = torch.sin(gamma), torch.cos(gamma)
    factor = cos_gamma * w * half / 2
    if weight is not None:
        factor = factor * weight(gamma)
    value = attenuation(p, wide, sigma_a.unsqueeze(-2), sin_gamma, cos_gamma, absorption)
    return (value * factor.unsqueeze(-1)).sum(-2)


def lobe_energies(refraction: tuple[Refraction, ...], sigma_a: Tensor, absorption: Absorption) -> Tensor:
    """E_p = int N_p dphi = (1/2) int_{-1}^{1} A(p, h) dh for R, TT, TRT (one refraction each), shape `[..., 3, C]`."""
    zero = torch.zeros_like(refraction[0].kappa)
    parts = []
    for p, bent in enumerate(refraction):
        parts.append(2 * integrate_offsets(p, bent, sigma_a, zero, zero + HALF_PI, absorption))
    return torch.stack(torch.broadcast_tensors(*parts), dim=-2)


def forward_backward_energies(
    refraction: tuple[Refraction, ...], sigma_a: Tensor, absorption: Absorption
) -> tuple[Tensor, Tensor]:
    """int N_p |phi|/pi dphi and int N_p (1 - |phi|/pi) dphi, each `[..., 3, C]`.

    The weight is the share of light, incident uniformly over a half circle, that the exit azimuth phi carries into the
    opposite half (Zinke et al. 2008, eqs 6 and 12, after the azimuth of incidence is integrated out). |phi| has a kink
    where TRT crosses phi = 0, so its integral is split there.
    """
    zero = torch.zeros_like(refraction[0].kappa)
    front, total = [], []
    for p, bent in enumerate(refraction):
        cuts = [zero, zero + HALF_PI] if p < 2 else [zero, _zero_azimuth(bent.kappa), zero + HALF_PI]
        front_p: Tensor | float = 0.0
        total_p: Tensor | float = 0.0
        for low, high in zip(cuts[:-1], cuts[1:], strict=True):
            weight = _azimuth_share(p, bent.kappa.unsqueeze(-1))
            front_p = front_p + 2 * integrate_offsets(p, bent, sigma_a, low, high, absorption, weight)
            total_p = total_p + 2 * integrate_offsets(p, bent, sigma_a, low, high, absorption)
        front.append(front_p)
        total.append(total_p)
    front_all = torch.stack(torch.broadcast_tensors(*front), dim=-2)
    return front_all, torch.stack(torch.broadcast_tensors(*total), dim=-2) - front_all


def _azimuth_share(p: int, kappa: Tensor):  # noqa: ANN202
    def share(gamma: Tensor) -> Tensor:
        if p == 0:
            return 2 * gamma / math.pi
        if p == 1:
            return 1 - 2 * (gamma - torch.asin(kappa * torch.sin(gamma))) / math.pi
        return exit_trt(kappa, gamma).abs() / math.pi

    return share


def _zero_azimuth(kappa: Tensor) -> Tensor:
    """gamma at which TRT leaves at phi = 0: gamma = 2 gamma_t, i.e. cos gamma_t = 1/(2 kappa); 0 or pi/2 where there
    is none.
    """
    inside = (kappa > 0.5) & (kappa < math.sqrt(0.5))
    safe = torch.where(inside, kappa, 0.6)
    sin_gamma = torch.sqrt(1 - 1 / (4 * safe * safe)) / safe
    root = torch.asin(sin_gamma.clamp_max(1 - 1e-14))
    return torch.where(inside, root, torch.where(kappa <= 0.5, 0.0, HALF_PI))


def caustic_attenuation(refraction: Refraction, caustic: Caustic, sigma_a: Tensor, absorption: Absorption) -> Tensor:
    """A(2, h_c) `[..., C]`, the attenuation that the glint carries."""
    sin_gamma, cos_gamma = torch.sin(caustic.gamma), torch.cos(caustic.gamma)
    return attenuation(2, refraction, sigma_a, sin_gamma, cos_gamma, absorption)
