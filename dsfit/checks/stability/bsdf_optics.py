"""Entries: refraction, Fresnel and attenuation of a fibre."""

from __future__ import annotations

import math

import torch
from torch import Tensor

import dsfit
from dsfit.bsdf.attenuation import attenuation
from dsfit.bsdf.fresnel import fresnel
from dsfit.bsdf.snell import Refraction
from dsfit.checks.stability import exact_bsdf as exact
from dsfit.checks.stability.function import Function
from dsfit.checks.stability.points import DEG, product

EDGE = 89.999 * DEG
"""An inclination next to the fibre's axis."""
ETAS = (1.3, 1.55)
NEAR_ONE = (1.01, 1.0001)


def fibers(eta: Tensor, sigma_a: Tensor | None = None, **fields: Tensor | float) -> dsfit.Fiber:
    """One fibre of one channel for each element of the columns."""
    absorption = torch.zeros_like(eta) if sigma_a is None else sigma_a
    return dsfit.Fiber(eta=eta, sigma_a=absorption.unsqueeze(-1), **fields)


def inclination_of(eta: float, index: float) -> float:
    """theta_diff at which a fibre of index eta has the effective index eta' = index."""
    return math.atan2(math.sqrt((index - eta) * (index + eta)), math.sqrt((eta - 1) * (eta + 1)))


def caustic_azimuth(eta: float, theta_diff: float) -> float:
    """phi_c, where two rays of TRT meet, for eta' < 2; to choose points beside it."""
    index = math.sqrt(eta * eta - math.sin(theta_diff) ** 2) / math.cos(theta_diff)
    h = math.sqrt((4 - index * index) / 3)
    return 4 * math.asin(h / index) - 2 * math.asin(h)


def edge_azimuth(eta: float, theta_diff: float, p: int) -> float:
    """The azimuth at which the ray of offset 1 leaves: the edge of the lobe's support."""
    index = math.sqrt(eta * eta - math.sin(theta_diff) ** 2) / math.cos(theta_diff)
    angle = 2 * p * math.asin(1 / index) - math.pi + p * math.pi
    return abs(angle - 2 * math.pi * round(angle / (2 * math.pi)))


def _fresnel(eta: Tensor, theta_diff: Tensor, cos_gamma: Tensor) -> Tensor:
    return fresnel(eta, torch.cos(theta_diff) * cos_gamma)[0]


def _fresnel_naive(eta: Tensor, theta_diff: Tensor, cos_gamma: Tensor) -> Tensor:
    """Each polarisation refracted by its own index: total reflection is made up where eta'' < 1."""
    first = torch.sqrt(eta**2 - torch.sin(theta_diff) ** 2) / torch.cos(theta_diff)
    parts = []
    for index in (first, eta**2 / first):
        inner = torch.sqrt((1 - (1 - cos_gamma**2) / index**2).clamp_min(0.0))
        if index is first:
            ratio = (cos_gamma - index * inner) / (cos_gamma + index * inner)
        else:
            ratio = (index * cos_gamma - inner) / (index * cos_gamma + inner)
        parts.append(ratio**2)
    return (parts[0] + parts[1]) / 2


def _transmitted(eta: Tensor, theta_diff: Tensor, cos_gamma: Tensor) -> Tensor:
    return fresnel(eta, torch.cos(theta_diff) * cos_gamma)[1]


def _transmitted_naive(eta: Tensor, theta_diff: Tensor, cos_gamma: Tensor) -> Tensor:
    c = torch.cos(theta_diff) * cos_gamma
    g = torch.sqrt(eta * eta - 1 + c * c)
    return 1 - (((c - g) / (c + g)) ** 2 + ((eta * eta * c - g) / (eta * eta * c + g)) ** 2) / 2


def _attenuation(p: int, eta: Tensor, sigma_a: Tensor, theta_diff: Tensor, h: Tensor) -> Tensor:
    bent = Refraction.at(eta, theta_diff)
    return attenuation(p, bent, sigma_a.unsqueeze(-1), h, torch.sqrt((1 - h) * (1 + h)), "geometric")[..., 0]


_FRESNEL = {
    "ordinary": product(ETAS, (-0.6, 0.1), (0.1, 0.5, 0.95), most=10),
    "grazing: theta_diff 89.999 deg": product((1.01, 1.55, 3.0), (EDGE, -EDGE), (1.0, 0.1, 1e-3), most=10),
    "grazing: offset near 1": product((1.01, 1.55, 3.0), (0.2, 1.2), (1e-12, 1e-8, 1e-5, 1e-3), most=14),
    "index: 1.01 and 1.0001": product(NEAR_ONE, (0.1, 0.9), (0.05, 0.5, 0.999), most=10),
    "index: 3": product((3.0,), (0.1, 0.9), (0.05, 0.5, 0.999)),
    "switch: F near 1/2": [(1.55, 0.0, c) for c in (0.12, 0.121, 0.122, 0.123, 0.124)],
}


def _attenuations(p: int) -> Function:
    # exp(-x) has the relative condition x, up to 700 (float32: 87) before it underflows
    dark = {"float64": (1e-12, 1e-11), "float32": (2e-5, 3e-4)}
    return Function(
        name=f"bsdf.A_{('R', 'TT', 'TRT')[p]}",
        arguments=("eta", "sigma_a", "theta_diff", "h"),
        compute=lambda eta, sigma_a, theta_diff, h: _attenuation(p, eta, sigma_a, theta_diff, h),
        exact=lambda eta, sigma_a, theta_diff, h: exact.attenuation(p, eta, sigma_a, theta_diff, h),
        regimes={
            "ordinary": product(ETAS, (0.1, 0.6), (0.3, -0.8), (0.2, -0.7), most=10),
            "clear": product((1.55,), (0.0, 1e-12), (0.3,), (0.0, 0.2, 0.99)),
            "dark": product((1.55,), (10.0, 40.0, 300.0, 1e4), (0.3, 1.2), (0.2, 0.99)),
            "grazing: theta_diff 89.999 deg": product(
                (1.01, 1.55, 3.0), (0.0, 0.1, 1e4), (-EDGE, EDGE), (0.2, 0.9, 0.999999), most=14
            ),
            "index: 1.01 and 3": product((1.01, 3.0), (0.1,), (0.3, 1.2), (0.2, 0.9)),
        },
        density=True,
        limits={"float64": (1e-14, 1e-11), "float32": (3e-6, 1e-3)},
        loose={"dark": dark, "grazing: theta_diff 89.999 deg": dark},
    )


FUNCTIONS: list[Function] = [
    Function(
        name="bsdf.kappa",
        arguments=("eta", "theta_diff"),
        compute=lambda eta, theta_diff: Refraction.at(eta, theta_diff).kappa,
        exact=lambda eta, theta_diff: 1 / exact.effective_index(eta, theta_diff),
        regimes={
            "ordinary": product(ETAS, (-0.6, 0.1, 0.5, 0.8)),
            "grazing": product((1.01, 1.55, 3.0), (EDGE, -EDGE, 89.9999 * DEG)),
            "index: 1.01, 1.0001, 3": product((1.01, 1.0001, 3.0), (0.01, 0.6, 1.2)),
        },
        naive=lambda eta, theta_diff: torch.cos(theta_diff) / torch.sqrt(eta**2 - torch.sin(theta_diff) ** 2),
        limits={"float64": (1e-15, 1e-11), "float32": (1e-6, 1e-3)},
    ),
    Function(
        name="bsdf.fresnel",
        arguments=("eta", "theta_diff", "cos_gamma"),
        compute=_fresnel,
        exact=exact.fresnel,
        regimes=_FRESNEL,
        naive=_fresnel_naive,
        density=True,
        limits={"float64": (3e-15, 1e-11), "float32": (2e-6, 1e-3)},
    ),
    Function(
        name="bsdf.fresnel transmittance",
        arguments=("eta", "theta_diff", "cos_gamma"),
        compute=_transmitted,
        exact=lambda eta, theta_diff, cos_gamma: 1 - exact.fresnel(eta, theta_diff, cos_gamma),
        regimes=_FRESNEL,
        naive=_transmitted_naive,
        density=True,
        limits={"float64": (3e-15, 1e-11), "float32": (2e-6, 1e-3)},
    ),
    *(_attenuations(p) for p in (1, 2)),
]
