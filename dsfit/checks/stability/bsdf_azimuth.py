"""Entries: the azimuthal lobes N_R, N_TT, N_TRT, raw, treated and simplified.

Conditioning: next to the edge of a lobe's support and next to a caustic, at a distance d, rounding of the arguments
alone moves the value by eps/d of itself; points are put at distances where this is bounded, and the limits of those
regimes say so.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from dsfit.bsdf.azimuthal import AzimuthalModel, azimuthal
from dsfit.checks.stability import exact_bsdf as exact
from dsfit.checks.stability import exact_bsdf_scattered as scattered
from dsfit.checks.stability.bsdf_optics import EDGE, ETAS, caustic_azimuth, edge_azimuth, fibers, inclination_of
from dsfit.checks.stability.function import Function
from dsfit.checks.stability.points import product

GLINT = {"glint_scale": 0.75, "caustic_fade": 0.25, "caustic_max_offset": 0.5}
"""Numbers that float32 holds exactly, as the twin must see the same fibre."""
_PI = math.pi
_SIGMA = (0.1,)
_CLOSE = {"float64": (1e-8, 1e-8), "float32": (0.5, 0.5)}
_PREFIX = (0.125,)


def lobe(p: int, model: AzimuthalModel, *columns: Tensor) -> Tensor:
    """N_p of the library for columns eta, sigma_a, theta_diff, phi[, caustic_width or gamma_TT]."""
    eta, sigma_a, theta_diff, phi, *width = columns
    name = "gamma_tt" if model == "simplified" else "caustic_width"
    fiber = fibers(eta, sigma_a, **GLINT, **({name: width[0]} if width else {}))
    return azimuthal(fiber, theta_diff, phi, None, model, "geometric")[..., p, 0]


def lobe_of_ellipse(eccentricity: Tensor, phi_h: Tensor, theta_diff: Tensor, phi: Tensor) -> Tensor:
    """N_TRT, treated, of an elliptic fibre of index 1.5 and absorption 0.125."""
    one = torch.ones_like(phi)
    fiber = fibers(1.5 * one, 0.125 * one, eccentricity=eccentricity, caustic_width=0.25, **GLINT)
    return azimuthal(fiber, theta_diff, phi, phi_h, "marschner", "geometric")[..., 2, 0]


def trt_by_cubic(eta: Tensor, sigma_a: Tensor, theta_diff: Tensor, phi: Tensor) -> Tensor:
    """N_TRT as published: Marschner's cubic for the exit azimuth, solved by Cardano's formula, a and b as printed."""
    first = torch.sqrt(eta**2 - torch.sin(theta_diff) ** 2) / torch.cos(theta_diff)
    c = torch.asin(1 / first)
    a, b = 16 * c / _PI**3, 12 * c / _PI - 2
    p, q = -b / a, phi / a  # gamma^3 + p gamma + q = 0
    disc = q * q / 4 + p**3 / 27
    root = torch.sqrt(disc.clamp_min(0.0))
    cube = torch.sign(-q / 2 + root) * (-q / 2 + root).abs() ** (1 / 3)
    single = cube - p / (3 * cube)
    radius = 2 * torch.sqrt((-p / 3).clamp_min(0.0))
    angle = torch.acos((3 * q / (p * radius)).clamp(-1.0, 1.0)) / 3
    total = torch.zeros_like(phi)
    for k in range(3):
        gamma = torch.where(disc > 0, single, radius * torch.cos(angle - 2 * _PI * k / 3))
        used = (gamma.abs() <= _PI / 2) & ((disc <= 0) | (k == 0))
        h, cosine = torch.sin(gamma), torch.cos(gamma)
        wide = torch.cos(theta_diff) * cosine
        g = torch.sqrt(eta**2 - 1 + wide**2)
        f = (((wide - g) / (wide + g)) ** 2 + ((eta**2 * wide - g) / (eta**2 * wide + g)) ** 2) / 2
        path = 4 * torch.sqrt(1 - (h / first) ** 2) / torch.sqrt(1 - (torch.sin(theta_diff) / eta) ** 2)
        part = (1 - f) ** 2 * f * torch.exp(-sigma_a * path) * cosine / (2 * (b - 3 * a * gamma**2).abs())
        total = total + torch.where(used, part, 0.0)
    return total


def _near_caustic(eta: float, *distances: float) -> list[tuple[float, ...]]:
    """Points inside the fold, at those distances from phi_c."""
    return [(eta, 0.125, t, caustic_azimuth(eta, t) - d) for t in (0.25, 0.5) for d in distances]


_TRT = {
    "ordinary": product(ETAS, _SIGMA, (-0.4, 0.3), (-0.05, 0.2)),
    "grazing: theta_diff 89.999 deg": product((1.01, 1.55, 3.0), (0.1, 0.0), (-EDGE, EDGE), (0.5, -2.0, 3.0), most=10),
    "index: 1.01": product((1.01,), _SIGMA, (0.2, 1.2), (0.1, -1.0)),
    "index: 3": product((3.0,), _SIGMA, (0.2, 1.0), (0.3, 1.0, 1.4)),
    "clear": product((1.5,), (0.0, 1e-12), (0.3, 1.0), (0.1, -0.3)),
    "dark": product((1.5,), (10.0, 100.0, 1e4), (0.3,), (0.1, 0.2)),
    "caustic: phi near 0": product((1.5,), _PREFIX, (0.2, 0.7, 1.0), (0.0, 1e-12, 1e-6), most=8),
    "caustic: 0.01 and 0.001 beside it": _near_caustic(1.5, 1e-2, 1e-3),
    "caustic: 1e-5 and 1e-6 beside it": _near_caustic(1.5, 1e-5, 1e-6),
    "caustic: 1e-4 inside the edge": [
        (1.5, 0.125, t, edge_azimuth(1.5, t, 2) - d) for t in (0.2, 1.0) for d in (1e-3, 1e-4)
    ],
    "switch: eta' = 2 -+ 1e-12 to 0.01": [
        (1.5, 0.125, inclination_of(1.5, 2 + s * d), f)
        for d in (1e-12, 1e-8, 1e-4, 1e-2) for s in (-1, 1) for f in (0.3, 1e-3)
    ],
}  # fmt: skip


FUNCTIONS: list[Function] = [
    Function(
        name="bsdf.N_R",
        arguments=("eta", "theta_diff", "phi"),
        compute=lambda eta, theta_diff, phi: lobe(0, "raw", eta, 0 * eta, theta_diff, phi),
        exact=lambda eta, theta_diff, phi: exact.lobe(0, exact.Hair(eta), theta_diff, phi),
        regimes={
            "ordinary": product(ETAS, (-0.4, 0.3), (-2.0, 0.5, 3.0), most=8),
            "grazing: theta_diff 89.999 deg": product((1.01, 1.55, 3.0), (-EDGE, EDGE), (0.5, -2.0, 3.1), most=8),
            "index: 1.01 and 3": product((1.01, 3.0), (0.2, 1.0), (0.5, -2.0, 3.1), most=8),
            "caustic: phi at 0 and pi": product((1.55,), (0.3,), (_PI, -_PI, 3.1415, 1e-6, 0.0)),
        },
        density=True,
        limits={"float64": (3e-15, 1e-11), "float32": (2e-6, 1e-3)},
    ),
    Function(
        name="bsdf.N_TT",
        arguments=("eta", "sigma_a", "theta_diff", "phi"),
        compute=lambda *columns: lobe(1, "raw", *columns),
        exact=lambda eta, sigma_a, theta_diff, phi: exact.lobe(1, exact.Hair(eta, sigma_a), theta_diff, phi),
        regimes={
            "ordinary": product(ETAS, _SIGMA, (-0.4, 0.3), (-2.5, 3.0)),
            "grazing: theta_diff 89.999 deg": product(
                (1.01, 1.55, 3.0), (0.1, 0.0), (-EDGE, EDGE), (0.5, -2.0, 3.1), most=10
            ),
            "index: 1.01": product((1.01,), _SIGMA, (0.2, 1.0), (3.1, 3.14, -3.05)),
            "index: 3": product((3.0,), _SIGMA, (0.2,), (1.0, 2.0, 3.1)),
            "clear": product((1.5,), (0.0, 1e-12), (0.3, 1.0), (2.0, -3.0)),
            "dark": product((1.55,), (10.0, 100.0, 1e4), (0.3,), (2.5, 3.1)),
            "caustic: phi at pi": product((1.55,), _SIGMA, (0.3,), (_PI, -_PI, 3.1415, 3.1415926)),
            "caustic: 1e-4 inside the edge": [
                (1.5, 0.125, t, edge_azimuth(1.5, t, 1) + d) for t in (0.2, 1.0) for d in (1e-2, 1e-3, 1e-4)
            ],
        },
        density=True,
        limits={"float64": (1e-13, 1e-11), "float32": (1e-4, 2e-3)},
        loose={"caustic: 1e-4 inside the edge": {"float64": (1e-10, 1e-10), "float32": (2e-2, 2e-2)}},
    ),
    Function(
        name="bsdf.N_TRT raw",
        arguments=("eta", "sigma_a", "theta_diff", "phi"),
        compute=lambda *columns: lobe(2, "raw", *columns),
        exact=lambda eta, sigma_a, theta_diff, phi: exact.lobe(2, exact.Hair(eta, sigma_a), theta_diff, phi),
        regimes=_TRT,
        naive=trt_by_cubic,
        density=True,
        limits={"float64": (1e-12, 1e-11), "float32": (1e-4, 3e-3)},
        loose={
            "caustic: 0.01 and 0.001 beside it": {"float64": (1e-11, 1e-11), "float32": (2e-3, 2e-3)},
            "caustic: 1e-5 and 1e-6 beside it": _CLOSE,
            "caustic: 1e-4 inside the edge": {"float64": (1e-10, 1e-10), "float32": (2e-2, 2e-2)},
        },
    ),
    Function(
        name="bsdf.N_TRT",
        arguments=("eta", "sigma_a", "theta_diff", "phi", "caustic_width"),
        compute=lambda *columns: lobe(2, "marschner", *columns),
        exact=lambda eta, sigma_a, theta_diff, phi, width: exact.lobe_treated(
            exact.Hair(eta, sigma_a, caustic_width=width, **GLINT), theta_diff, phi
        ),
        regimes={
            name: [(*point, width) for point in points for width in ((0.25, 0.002) if "beside" in name else (0.25,))]
            for name, points in _TRT.items()
        },
        density=True,
        limits={"float64": (1e-12, 1e-8), "float32": (1e-4, 3e-3)},
        loose={
            # a narrow glint's removal varies over 0.002 rad, phi_c is rounded
            "caustic: 1e-5 and 1e-6 beside it": {"float64": (1e-12, 1e-9), "float32": (1e-4, 0.1)},
            "caustic: 1e-4 inside the edge": {"float64": (3e-11, 3e-11), "float32": (2e-2, 2e-2)},
        },
    ),
    Function(
        name="bsdf.N_TRT of an ellipse",
        arguments=("eccentricity", "phi_h", "theta_diff", "phi"),
        compute=lobe_of_ellipse,
        exact=lambda eccentricity, phi_h, theta_diff, phi: exact.lobe_treated(
            exact.Hair(1.5, 0.125, eccentricity, phi_h, 0.25, **GLINT), theta_diff, phi
        ),
        regimes={
            "ordinary": product((0.9, 1.1), (0.1, 1.3, -2.0), (0.3, 0.9), (0.1, 0.6), most=12),
            "index: eccentricity 0.8 and 1.2": product((0.8, 1.2), (0.0, 1.5), (0.3, 1.2), (0.1, 0.6), most=10),
            "switch: eccentricity near 1": product((1.0, 1 - 1e-7, 1 + 1e-7), (0.7,), (0.3,), (0.1, 0.6)),
            "grazing: theta_diff 89.999 deg": product((0.8, 1.2), (0.0, 1.5), (EDGE,), (0.5, 2.0)),
        },
        density=True,
        limits={"float64": (1e-12, 1e-9), "float32": (1e-4, 3e-3)},
    ),
    Function(
        name="bsdf.N_TT simplified",
        arguments=("eta", "sigma_a", "theta_diff", "phi", "gamma_tt"),
        compute=lambda *columns: lobe(1, "simplified", *columns),
        exact=lambda eta, sigma_a, theta_diff, phi, gamma: scattered.lobe_simplified(
            1, exact.Hair(eta, sigma_a, gamma_tt=gamma), theta_diff, phi
        ),
        regimes={
            "ordinary": product((1.5,), _SIGMA, (0.3,), (2.5, -3.0, 0.5), (0.5,)),
            "narrow: 0.001 rad": product((1.5,), _SIGMA, (0.3,), (_PI, 3.14, -3.135), (1e-3,)),
            "wide: 3 to 50 rad": product((1.5,), _SIGMA, (0.3,), (3.0, -0.1), (3.0, 8.0, 50.0)),
            "switch: gamma_TT = 1 and 2": product(
                (1.5,), _SIGMA, (0.3,), (3.0, 0.1), (1 - 1e-6, 1 + 1e-6, 2 - 1e-6, 2 + 1e-6)
            ),
            "tail": product((1.5,), _SIGMA, (0.3,), (0.0, 1.0), (0.125, 0.3)),
            "grazing: theta_diff 89.999 deg": product((1.01, 3.0), (0.1, 1e4), (EDGE,), (3.0,), (0.5,)),
        },
        density=True,
        limits={"float64": (3e-13, 3e-13), "float32": (3e-5, 3e-5)},
        loose={"narrow": {"float64": (1e-11, 1e-11), "float32": (3e-3, 3e-3)}},  # angles are rounded to a part of it
    ),
]
