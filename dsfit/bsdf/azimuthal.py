"""Azimuthal scattering N_R, N_TT, N_TRT and its average over incident half circles, N^G."""

from __future__ import annotations

import math
from typing import Literal

import torch
from torch import Tensor

from dsfit.bsdf.attenuation import Absorption, attenuation, lobe_energies
from dsfit.bsdf.fiber import Fiber
from dsfit.bsdf.glint import Glint
from dsfit.bsdf.scattered import beyond_pi, offset_windows, simplified_windows
from dsfit.bsdf.snell import Caustic, Rays, Refraction, rays_trt, rays_tt
from dsfit.frame import HALF_PI, wrap
from dsfit.special import wrapped_normal_log_prob

AzimuthalModel = Literal["marschner", "raw", "simplified"]
_CHUNK = 512
AZIMUTHAL_MODELS: tuple[str, ...] = ("marschner", "raw", "simplified")
ALL_LOBES = (0, 1, 2)


def refractions(fiber: Fiber, theta_diff: Tensor, phi_h: Tensor | None) -> tuple[Refraction, Refraction, Refraction]:
    """Refraction that R, TT and TRT see; eccentricity changes that of TRT alone."""
    plain = Refraction.at(fiber.eta, theta_diff)
    return plain, plain, plain if fiber.is_round else Refraction.at(fiber.eta_trt(phi_h), theta_diff)


def azimuthal(
    fiber: Fiber,
    theta_diff: Tensor,
    phi: Tensor,
    phi_h: Tensor | None,
    model: AzimuthalModel,
    absorption: Absorption,
    lobes: tuple[int, ...] = ALL_LOBES,
) -> Tensor:
    """N_p(theta_diff, phi) = (1/2) sum over roots of A(p, h) |dphi/dh|^-1, `[..., len(lobes), C]`, per radian.

    `lobes` are some of 0, 1, 2: R, TT, TRT. Even in phi. `marschner` treats the TRT caustic, `raw` leaves it
    (unbounded at the caustic), `simplified` is N_R, N_TRT ~ cos(phi/2), N_TT ~ g(phi - pi; gamma_TT) (chapter eqs 21,
    25) times each lobe's energy E_p; see `simplified_shapes`.
    """
    theta_diff, phi = torch.broadcast_tensors(theta_diff, wrap(phi).abs())
    bent = refractions(fiber, theta_diff, phi_h)
    if model == "simplified":
        energies = lobe_energies(bent, fiber.sigma_a, absorption)
        return (simplified_shapes(fiber, phi).unsqueeze(-1) * energies)[..., list(lobes), :]
    values = (
        lambda: _n_r(fiber, bent[0], phi, absorption),
        lambda: _n_tt(fiber, bent[1], phi, absorption),
        lambda: _n_trt(fiber, bent[2], phi, model, absorption),
    )
    return torch.stack(torch.broadcast_tensors(*(values[p]() for p in lobes)), dim=-2)


def simplified_shapes(fiber: Fiber, phi: Tensor) -> Tensor:
    """Unit-integral azimuths cos(phi/2)/4, wrapped g(phi - pi; gamma_TT), cos(phi/2)/4, `[..., 3]`."""
    cosine = torch.cos(phi / 2).abs() / 4  # pi of float32 lies beyond pi
    transmitted = torch.exp(wrapped_normal_log_prob(beyond_pi(phi), fiber.gamma_tt))
    return torch.stack(torch.broadcast_tensors(cosine, transmitted, cosine), dim=-1)


def printed_shapes(fiber: Fiber, phi: Tensor) -> Tensor:
    """The simplified azimuths exactly as printed: cos(phi/2), g(phi - pi; gamma_TT), cos(phi/2) (eqs 25, 21)."""
    factor = torch.tensor([4.0, 1.0, 4.0], dtype=phi.dtype, device=phi.device)
    return simplified_shapes(fiber, phi) * factor


def _n_r(fiber: Fiber, bent: Refraction, phi: Tensor, absorption: Absorption) -> Tensor:
    """R: gamma = -phi/2, |dphi/dh| = 2/cos(gamma)."""
    sin_gamma, cos_gamma = torch.sin(phi / 2), torch.cos(phi / 2).abs()  # pi of float32 lies beyond pi
    return attenuation(0, bent, fiber.sigma_a, sin_gamma, cos_gamma, absorption) * (cos_gamma / 4).unsqueeze(-1)


def _n_tt(fiber: Fiber, bent: Refraction, phi: Tensor, absorption: Absorption) -> Tensor:
    """TT: at most one ray."""
    return _lobe_of(1, rays_tt(bent.kappa, phi), fiber, bent, absorption)


def _lobe_of(p: int, rays: Rays, fiber: Fiber, bent: Refraction, absorption: Absorption) -> Tensor:
    """A(p, h) |dh/dphi| / 2 of one branch of rays, 0 where there is none."""
    value = attenuation(p, bent, fiber.sigma_a, rays.sin_gamma, rays.cos_gamma, absorption)
    return torch.where(rays.lit.unsqueeze(-1), value * (rays.spread / 2).unsqueeze(-1), 0.0)


def _n_trt(fiber: Fiber, bent: Refraction, phi: Tensor, model: AzimuthalModel, absorption: Absorption) -> Tensor:
    """TRT: up to three rays; two meet at the caustic phi_c, where the raw density is infinite."""
    kappa, phi = torch.broadcast_tensors(bent.kappa, phi)
    caustic = Caustic.at(kappa)
    total = torch.zeros(*phi.shape, fiber.channels, dtype=phi.dtype, device=phi.device)
    for rays in rays_trt(kappa, caustic, phi):
        total = total + _lobe_of(2, rays, fiber, bent, absorption)
    if model == "raw":
        return total
    glint = Glint.of(fiber, bent, caustic, absorption)
    return total * glint.removal(phi).unsqueeze(-1) + glint.added(phi)


def azimuthal_scattered(
    fiber: Fiber,
    theta_diff: Tensor,
    phi: Tensor,
    phi_h: Tensor | None,
    model: AzimuthalModel,
    absorption: Absorption,
    lobes: tuple[int, ...] = ALL_LOBES,
) -> Tensor:
    """N^G_p(phi) = (1/pi) int_{-pi/2}^{pi/2} N_p(theta_diff, wrap(phi - phi')) dphi', `[..., len(lobes), C]`, per
    radian (eq 11 as a convolution).

    A difference of the cumulative azimuth, which is an integral over offsets and so smooth even where N_p is infinite;
    int N^G = int N. For an eccentric fibre the index of TRT is that of the unscattered pair of directions (phi_h is
    held during the average).
    """
    theta_diff, phi = torch.broadcast_tensors(theta_diff, wrap(phi).abs())
    if not fiber.batch_shape and phi.numel() > _CHUNK:
        return _in_chunks(fiber, theta_diff, phi, phi_h, model, absorption, lobes)
    bent = refractions(fiber, theta_diff, phi_h)
    if model == "simplified":
        energies = lobe_energies(bent, fiber.sigma_a, absorption)
        return (simplified_windows(fiber, phi).unsqueeze(-1) * energies / math.pi)[..., list(lobes), :]
    return offset_windows(fiber, bent, phi, model, absorption, lobes) / math.pi


def _in_chunks(
    fiber: Fiber,
    theta_diff: Tensor,
    phi: Tensor,
    phi_h: Tensor | None,
    model: AzimuthalModel,
    absorption: Absorption,
    lobes: tuple[int, ...],
) -> Tensor:
    """Hundreds of attenuations per direction: a few hundred directions at a time stay in cache (several times
    faster).
    """
    shape = torch.broadcast_shapes(phi.shape, () if phi_h is None else phi_h.shape)
    given = [theta_diff, phi] if phi_h is None else [theta_diff, phi, phi_h]
    rows = [x.expand(shape).reshape(-1).split(_CHUNK) for x in given]
    parts = []
    for row in zip(*rows, strict=True):
        orientation = row[2] if len(row) > 2 else None
        parts.append(azimuthal_scattered(fiber, row[0], row[1], orientation, model, absorption, lobes))
    return torch.cat(parts).reshape(*shape, *parts[0].shape[-2:])


def azimuthal_constant(
    fiber: Fiber,
    theta_diff: Tensor,
    phi_h: Tensor | None,
    model: AzimuthalModel,
    absorption: Absorption,
    lobes: tuple[int, ...] = ALL_LOBES,
) -> Tensor:
    """N^G as eq (11) prints it: (1/pi) int_{-pi/2}^{pi/2} N_p(theta_diff, phi') dphi', the same for every phi."""
    return azimuthal_scattered(fiber, theta_diff, torch.zeros_like(theta_diff), phi_h, model, absorption, lobes)


def support_edges(
    fiber: Fiber, theta_diff: Tensor, phi_h: Tensor | None = None, lobes: tuple[int, ...] = ALL_LOBES
) -> Tensor:
    """|phi| in [0, pi] where N_p of some of `lobes` starts, ends, or peaks: TT's edge, the TRT edge, the caustic;
    `[..., 0 to 3]`, sorted.
    """
    bent = refractions(fiber, theta_diff, phi_h)
    caustic = Caustic.at(bent[2].kappa)
    whole = torch.broadcast_tensors(2 * torch.asin(bent[1].kappa), caustic.edge.abs(), caustic.phi)
    edges = [edge for lobe, edge in zip((1, 2, 2), whole, strict=True) if lobe in lobes]
    if not edges:
        return whole[0].new_zeros(*whole[0].shape, 0)
    return torch.sort(torch.stack(edges, dim=-1), dim=-1).values.clamp(0.0, 2 * HALF_PI)
