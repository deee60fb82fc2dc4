"""Symmetries of the BSDF: which hold, by derivation, and by how much the others fail.

`f_s = c_M sum_p g(theta_h - alpha_p) N_p(theta_diff, phi) / cos^2(theta_diff)`. Exchanging light and viewer keeps
theta_h, changes the sign of theta_diff, of which N_p and the cosine are even functions, and the sign of phi, in which
N_p is even; phi_h stays. So single scattering is reciprocal, tilted cuticles and eccentric sections included. A tilt
does break the mirror symmetry theta -> -theta: it holds with alpha -> -alpha. A section with two axes of symmetry does
not change when the azimuths are turned by pi, or mirrored (phi_h -> -phi_h with phi -> -phi).

f_back and everything scattered depend on averages at theta_in, the light's inclination: dual scattering is not
reciprocal, by construction. That is measured, not judged.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from dsfit.bsdf.dual_scattering import DualScattering
from dsfit.frame import HALF_PI

_FLOOR = 1e-9


@dataclass(frozen=True)
class Symmetries:
    """Largest relative deviations over the directions tried (values below 1e-9 of the largest count as that).

    Attributes:
        exchange: f_s(theta_i, theta_r, phi) from f_s(theta_r, theta_i, -phi), phi_h kept. Zero but for rounding.
        mirror: f_s(-theta_i, -theta_r, phi) with tilts -alpha from f_s(theta_i, theta_r, phi). Zero.
        section: f_s at phi_h + pi, and at -phi_h with -phi, from f_s. Zero.
        tilt: f_s(-theta_i, -theta_r, phi) with the same tilts from f_s: not zero unless alpha = 0.
        orientation: f_s at phi_h + pi/2 from f_s: not zero unless the section is round.
        back, scatter: as `exchange` for f_back and F_scatter (n = 2): not zero.
    """

    exchange: float
    mirror: float
    section: float
    tilt: float
    orientation: float
    back: float
    scatter: float


def relative_deviation(a: Tensor, b: Tensor) -> float:
    """max |a - b| / max(|a|, |b|, 1e-9 of the largest)."""
    if not bool(a.isfinite().all() and b.isfinite().all()):
        return math.inf
    scale = torch.maximum(a.abs(), b.abs())
    floor = _FLOOR * float(scale.max()) + torch.finfo(scale.dtype).tiny
    return float(((a - b).abs() / scale.clamp_min(floor)).max())


def directions(count: int, generator: torch.Generator, limit: float = 1.55) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """theta_i, theta_r (uniform in +-limit), phi and phi_h `[count]`."""
    u = torch.rand(4, count, generator=generator, dtype=torch.float64) * 2 - 1
    return u[0] * limit, u[1] * limit, u[2] * math.pi, u[3] * math.pi


def symmetries(bsdf: DualScattering, count: int = 2000, *, generator: torch.Generator) -> Symmetries:
    """Evaluate the symmetries at random directions, of which half are near the lobes."""
    theta_i, theta_r, phi, phi_h = directions(count, generator)
    near = torch.arange(count) % 2 == 0
    theta_i = torch.where(near, (0.3 * theta_i - theta_r).clamp(-1.55, 1.55), theta_i)
    untilted = bsdf.replace(fiber=bsdf.fiber.replace(alpha=-bsdf.fiber.alpha), precision="exact")
    with torch.no_grad():
        value = bsdf.single(theta_i, theta_r, phi, phi_h=phi_h)
        turned = bsdf.single(theta_i, theta_r, phi, phi_h=phi_h + math.pi)
        reflected = bsdf.single(theta_i, theta_r, -phi, phi_h=-phi_h)
        return Symmetries(
            exchange=relative_deviation(value, bsdf.single(theta_r, theta_i, -phi, phi_h=phi_h)),
            mirror=relative_deviation(value, untilted.single(-theta_i, -theta_r, phi, phi_h=phi_h)),
            section=max(relative_deviation(value, turned), relative_deviation(value, reflected)),
            tilt=relative_deviation(value, bsdf.single(-theta_i, -theta_r, phi, phi_h=phi_h)),
            orientation=relative_deviation(value, bsdf.single(theta_i, theta_r, phi, phi_h=phi_h + HALF_PI)),
            back=relative_deviation(
                bsdf.back_scattering(theta_i, theta_r, phi), bsdf.back_scattering(theta_r, theta_i, -phi)
            ),
            scatter=relative_deviation(
                bsdf.scatter(theta_i, theta_r, phi, 2.0, phi_h=phi_h),
                bsdf.scatter(theta_r, theta_i, -phi, 2.0, phi_h=phi_h),
            ),
        )
