"""Energy of a smooth fibre, whose lobes are narrow and whose surface is not tilted: everything is known there."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable

import torch
from torch import Tensor

from dsfit.bsdf.dual_scattering import DualScattering
from dsfit.bsdf.fiber import Fiber
from dsfit.bsdf.fresnel import fresnel
from dsfit.checks.controls.scene import DEG
from dsfit.frame import HALF_PI, cos_inclination
from dsfit.quadrature import gauss_legendre, panel_points

Lobe = Callable[[Tensor, Tensor, Tensor], Tensor]
"""theta_i, theta_r, phi `[Q]` to a BSDF `[Q, C]`."""

WIDTH = 0.05 * DEG
LIGHT = 60 * DEG
ENERGY_BOUND = 1e-5
"""The energy of lobes of this width differs from that of a mirror by some WIDTH^2 = 8e-7."""


@functools.cache
def smooth_fiber() -> Fiber:
    """No absorption, no tilt, lobes of 0.05 degrees."""
    return Fiber(sigma_a=(0.0,), alpha=(0.0, 0.0, 0.0), beta=(WIDTH, WIDTH, WIDTH))


def smooth_bsdf(**changes: object) -> DualScattering:
    """The smooth fibre's BSDF with simplified azimuths, which carry each lobe's energy; d_b = 0 unless given."""
    return DualScattering(smooth_fiber(), **{"azimuthal": "simplified", "d_b": 0.0, **changes})  # type: ignore[arg-type]


def outgoing_energy(lobe: Lobe, theta_i: float = LIGHT, phi_max: float = math.pi) -> float:
    """int f cos(theta_o) domega_o of light from theta_i, over |phi| <= phi_max (pi/2 or pi), for a narrow lobe about
    the mirror direction -theta_i that is even in phi."""
    steps = torch.tensor([-18.0, -12.0, -8.0, -5.0, -2.5, 0.0, 2.5, 5.0, 8.0, 12.0, 18.0], dtype=torch.float64)
    theta, theta_weight = panel_points(-theta_i + 2 * WIDTH * steps, 12)
    ends = torch.linspace(0.0, phi_max, 1 + round(phi_max / HALF_PI), dtype=torch.float64)
    phi, phi_weight = panel_points(ends, 40)
    theta_o, azimuth = (x.flatten() for x in torch.meshgrid(theta, phi, indexing="ij"))
    value = lobe(torch.full_like(theta_o, theta_i), theta_o, azimuth)[:, 0]
    weight = 2 * (theta_weight[:, None] * phi_weight).flatten() * cos_inclination(theta_o) ** 2
    return float((weight * value).sum())


def remainder(theta_i: float = LIGHT) -> float:
    """Energy that leaves the fibre after three and more internal segments: the mean of (1 - F) F^2 over offsets."""
    gamma, weight = gauss_legendre(64)
    gamma, weight = (gamma + 1) * math.pi / 4, weight * math.pi / 4
    reflected, entered = fresnel(smooth_fiber().eta, math.cos(theta_i) * torch.cos(gamma))
    return float((weight * torch.cos(gamma) * entered * reflected**2).sum())


def energy_gap(lobe: Lobe, expected: float = 1.0) -> float:
    """|energy + expected x remainder - expected|: 0 where R, TT and TRT reflect what a smooth fibre must."""
    return abs(outgoing_energy(lobe) + expected * remainder() - expected)
