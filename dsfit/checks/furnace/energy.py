"""Energy of one fibre: attenuation, lobes, averages, and the furnace of single scattering."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from dsfit.bsdf.averages import LobeShares
from dsfit.bsdf.azimuthal import support_edges
from dsfit.bsdf.breaks import theta_breaks
from dsfit.bsdf.conventions import Convention
from dsfit.bsdf.dual_scattering import DualScattering
from dsfit.bsdf.fiber import Fiber
from dsfit.cubature import integrate
from dsfit.frame import HALF_PI, cos_inclination
from dsfit.quadrature import panel_points

FURNACE_DEG = (0.0, 30.0, 45.0, 60.0, 70.0, 80.0, 85.0, 89.0)
PRINTED_FURNACE = (1.9008, 2.0227, 2.0803, 2.1006, 2.0432, 1.8844, 1.8069, 1.9353)
"""int S cos(theta_o) domega_o of a lossless fibre at these inclinations (eta = 1.55, alpha_R = -7.5, beta_R = 7.5
degrees), with c_M = 1 as printed: lobes of unit integral in theta_h. The consistent model has half of it."""


def independent_energies(
    eta: np.ndarray | float, diff: np.ndarray, sigma_a: np.ndarray | float = 0.0, absorption: str = "geometric"
) -> np.ndarray:
    """(1/2) int A(p, h) dh for R, TT, TRT, and for all p >= 3 of a lossless fibre, `[..., 4]`; shares no code with the
    BSDF.

    Fresnel's equations in three dimensions, for the angle between ray and surface, cos = cos(theta_diff) cos(gamma): no
    Bravais index. A(0) = F, A(p) = (1 - F)^2 F^(p - 1) T^p, and sum_{p >= 3} A = (1 - F) F^2 where T = 1, so that all
    four add up to 1.

    Args:
        eta, diff, sigma_a: refractive index, theta_diff, and absorption per radius; broadcast.
        absorption: "geometric" T = exp(-2 sigma' cos gamma_t) or "printed2003" exp(-4 sigma' cos^2 gamma_t), sigma' =
            sigma_a / cos(theta_t).
    """
    x, w = np.polynomial.legendre.leggauss(160)
    gamma = (x + 1) * math.pi / 4
    eta, diff, sigma_a = (np.asarray(a, dtype=float)[..., None] for a in (eta, diff, sigma_a))
    cos_in = np.cos(diff) * np.cos(gamma)
    cos_out = np.sqrt(1 - (1 - cos_in**2) / eta**2)
    senkrecht = (cos_in - eta * cos_out) / (cos_in + eta * cos_out)
    parallel = (eta * cos_in - cos_out) / (eta * cos_in + cos_out)
    f = (senkrecht**2 + parallel**2) / 2
    sin_out = np.sin(diff) / eta  # of the inclination inside
    cos_gamma_t = np.sqrt(1 - (np.cos(diff) * np.sin(gamma)) ** 2 / (eta**2 * (1 - sin_out**2)))
    path = 2 * cos_gamma_t if absorption == "geometric" else 4 * cos_gamma_t**2
    t = np.exp(-sigma_a * path / np.sqrt(1 - sin_out**2))
    parts = np.broadcast_arrays(f, (1 - f) ** 2 * t, (1 - f) ** 2 * f * t * t, (1 - f) * f * f)
    weight = w * math.pi / 4 * np.cos(gamma)
    return np.stack([(a * weight).sum(-1) for a in parts], axis=-1)


@dataclass(frozen=True)
class LobeEnergies:
    """Azimuthal energies at inclinations theta_diff `[D]`, each `[D, 3, C]`.

    Attributes:
        direct: int N_p dphi by quadrature.
        scattered: int N^G_p dphi by quadrature.
        offsets: (1/2) int A(p, h) dh, by code of its own.
    """

    direct: Tensor
    scattered: Tensor
    offsets: Tensor


def azimuthal_energies(bsdf: DualScattering, diff: Tensor, phi_h: float = 0.0) -> LobeEnergies:
    """The three that have to be equal, on panels that follow the edges and caustics.

    N^G is an average over turned N, and keeps its energy whatever the azimuthal model. (1/2) int A dh is that energy
    for R and TT always, and for TRT where the caustic is left alone: the glint that replaces it has its own.
    """
    fiber = bsdf.fiber
    angle = None if fiber.is_round else torch.full_like(diff, phi_h)
    edges = support_edges(fiber, diff, angle)
    shifted = torch.cat([(edges - HALF_PI).abs(), math.pi - (edges - HALF_PI).abs()], dim=-1)
    even = torch.linspace(0, 1, 9, dtype=diff.dtype).expand(len(diff), -1) * math.pi
    breaks = torch.sort(torch.cat([edges, shifted, even], dim=-1), dim=-1).values
    panels = breaks.shape[-1] - 1
    s, w = panel_points(torch.linspace(0, 1, panels + 1, dtype=diff.dtype), 20)
    cell = (s * panels).long().clamp_max(panels - 1)
    t = s * panels - cell
    width = breaks[:, cell + 1] - breaks[:, cell]
    phi = breaks[:, cell] + width * torch.sin(HALF_PI * t) ** 2  # square roots at the ends become smooth
    weight = (2 * w * panels * width * HALF_PI * torch.sin(math.pi * t))[..., None, None]
    wide = None if angle is None else angle[:, None]
    with torch.no_grad():
        direct = (bsdf.azimuthal(diff[:, None], phi, phi_h=wide) * weight).sum(1)
        scattered = (bsdf.azimuthal_scattered(diff[:, None], phi, phi_h=wide) * weight).sum(1)
    return LobeEnergies(direct, scattered, _offsets(bsdf, diff, angle))


def _offsets(bsdf: DualScattering, diff: Tensor, phi_h: Tensor | None) -> Tensor:
    fiber = bsdf.fiber
    eta = [fiber.eta.expand_as(diff)] * 2 + [fiber.eta_trt(phi_h).expand_as(diff)]
    lobes = []
    for p, index in enumerate(eta):
        found = independent_energies(
            index.numpy()[:, None], diff.numpy()[:, None], fiber.sigma_a.numpy(), bsdf.convention.absorption
        )
        lobes.append(torch.from_numpy(found[..., p]).expand(len(diff), fiber.channels))
    return torch.stack(lobes, dim=1)


def attenuation_sum(bsdf: DualScattering, theta_in: Tensor) -> Tensor:
    """a_f + a_b before anything limits it, `[..., C]`: at most 1, or the series of back scattering diverges."""
    front, back = bsdf.lobe_shares(theta_in)
    return front.sum(-2) + back.sum(-2)


@dataclass(frozen=True)
class SingleScattering:
    """Forward and backward energy of single scattering at one inclination, each `[C]`.

    Attributes:
        front, back: by two-dimensional quadrature of f_s over directions, and `error` its bound.
        a_f, a_b: from the averages' own integrals over offsets.
    """

    front: Tensor
    back: Tensor
    error: Tensor
    a_f: Tensor
    a_b: Tensor

    @property
    def deviation(self) -> float:
        """Largest difference, relative to the sum."""
        total = (self.a_f + self.a_b).abs().max()
        gap = torch.stack([self.front - self.a_f, self.back - self.a_b]).abs().max()
        return float(gap / total)


def single_scattering(bsdf: DualScattering, theta_in: float, rtol: float = 1e-6) -> SingleScattering:
    """a_f and a_b against quadrature of f_s with the averages' weights: cos(theta_in) or cos(theta_o), and |phi| / pi
    or the half space (Zinke et al. 2008, eqs 6 and 12).

    The averages count energy, so f_s is taken with raw azimuths, whatever the BSDF's, and with its 1 / cos^2. For round
    sections; an eccentric one would need an average over orientations as well.

    Raises:
        ValueError: the section is not round.
    """
    if not bsdf.fiber.is_round:
        raise ValueError("single_scattering takes round sections")
    convention = Convention.named(bsdf.convention, inverse_cos2=True)
    raw = bsdf.replace(azimuthal="raw", precision="exact", convention=convention, d_b=0.0)
    theta = torch.tensor(theta_in, dtype=torch.float64)

    def edges(out: Tensor) -> Tensor:
        inner = support_edges(raw.fiber, (out - theta) / 2)
        ends = torch.tensor([0.0, HALF_PI, math.pi], dtype=out.dtype).expand(*out.shape, -1)
        return torch.sort(torch.cat([inner, ends], dim=-1), dim=-1).values

    def columns(out: Tensor, phi: Tensor) -> Tensor:
        value = raw.single(theta, out, phi) * (2 * cos_inclination(out))[..., None]
        incident = convention.average_weight == "incident"
        value = value * cos_inclination(theta if incident else out)[..., None]
        share = phi / math.pi if convention.split == "fraction" else (phi > HALF_PI).to(phi)
        return torch.cat([value * share[..., None], value * (1 - share)[..., None]], dim=-1)

    found = integrate(columns, theta_breaks(bsdf, theta), edges, rtol, 3_000_000)
    front, back = found.value.chunk(2)
    a_f, a_b = (x.sum(-2) for x in bsdf.lobe_shares(theta))
    return SingleScattering(front, back, found.error, a_f, a_b)


def single_furnace(fiber: Fiber, theta_i: Tensor, norm: str = "energy", absorption: str = "geometric") -> Tensor:
    """int S cos(theta_o) domega_o of single scattering, `[..., C]`, from integrals over offsets.

    Args:
        fiber: one fibre.
        theta_i: inclinations of the light.
        norm: "energy" (c_M = 1/2) or "printed" (c_M = 1).
        absorption: as in `Convention`.
    """
    convention = Convention.named("consistent", average_weight="outgoing", lobe_norm=norm, absorption=absorption)
    front, back = LobeShares(fiber, convention)(theta_i)
    return front.sum(-2) + back.sum(-2)
