"""Rows of the atlas: laws of transmitted light and of uniform directions, as functions of scalars."""

from __future__ import annotations

import math

import mpmath as mp
import torch
from torch import Tensor

from dsfit.checks.stability import twins
from dsfit.checks.stability.function import Function
from dsfit.checks.stability.limits import FEW_ULPS, within
from dsfit.checks.stability.lobe_functions import angle, window, within_domain
from dsfit.checks.stability.lobe_points import ENDS, HALF_PI, MIDDLES, POLES, STEEP, VIEWS
from dsfit.checks.stability.points import DEG, deg, product
from dsfit.proposals.inclination import TruncatedGaussianInclination
from dsfit.proposals.transmittance import TransmittanceCosineInclination
from dsfit.proposals.uniform import UniformInclinationLaw


def _gauss_in_density(theta_i: mp.mpf, mean: mp.mpf, std: mp.mpf) -> mp.mpf:
    if not within_domain(theta_i):
        return mp.nan
    return twins.truncated_log_density(theta_i, mean, std, -mp.pi / 2, mp.pi / 2)


def _naive_cosine_sample(u: Tensor, theta_r: Tensor) -> Tensor:
    low, high = torch.sin(theta_r / 2 - math.pi / 4), torch.sin(theta_r / 2 + math.pi / 4)
    return theta_r - 2 * torch.asin(low + u * (high - low))


def _cosine_density(theta_i: mp.mpf, theta_r: mp.mpf) -> mp.mpf:
    if not within_domain(theta_i):
        return mp.nan
    return mp.log(mp.cos((theta_r - theta_i) / 2) / (2 * mp.sqrt(2) * mp.cos(theta_r / 2)))


def _cosine_sample(u: mp.mpf, theta_r: mp.mpf) -> mp.mpf:
    if not 0 < u < 1:
        return mp.nan
    low, high = (mp.sin(end) for end in window(theta_r))
    return theta_r - 2 * mp.asin(low + u * (high - low))


_VIEWED = {
    "ordinary": list(VIEWS),
    "grazing: theta_r to 89.999 deg": list(STEEP),
    "grazing: theta_r = 90 deg": list(POLES),
}

FUNCTIONS: list[Function] = [
    Function(
        "transmittance_gaussian.log_prob",
        ("theta_i", "centre", "width"),
        lambda x, mean, std: TruncatedGaussianInclination(torch.zeros_like(x), mean, std, "in").log_prob(x),
        _gauss_in_density,
        {
            "ordinary": product(deg(-60.0, -3.0, 40.0), deg(-5.0, 2.0), deg(15.0, 39.0), most=10),
            "narrow: width 1e-5 rad": [(0.05 + k * 1e-5, 0.05, 1e-5) for k in (-3.0, -0.4, 1.2, 5.0)],
            "wide: width 1 to 100 rad": product(deg(-60.0, 40.0), deg(2.0, 70.0), [1.0, 10.0, 100.0], most=8),
            "grazing: theta_i to 89.9999 deg": product(deg(-89.9, 89.9999), deg(-5.0), deg(4.0, 20.0)),
        },
        logarithm=True,
        limits=FEW_ULPS,
        loose={
            "narrow": within(7e-15, 1e-14, 3e-6, 1e-5),
            "wide": within(4e-15, 2e-11, 2e-6, 2e-2),
        },
    ),
    Function(
        "transmittance_cosine.log_prob",
        ("theta_i", "theta_r"),
        lambda x, theta_r: TransmittanceCosineInclination(theta_r).log_prob(x),
        _cosine_density,
        {name: product(deg(-80.0, -3.0, 50.0), views) for name, views in _VIEWED.items()}
        | {"caustic: theta_diff to 90 deg": [(89.999 * DEG, -89.999 * DEG), (-HALF_PI, 89.9999 * DEG), (1.55, -1.55)]},
        logarithm=True,
        limits=FEW_ULPS,
        loose={
            "ordinary": within(2e-15, 3e-14, 2e-6, 1e-5),
            "grazing": within(3e-15, 3e-14, 2e-6, 2e-5),
            "caustic": within(5e-11, 7e-10, 2e-6, 1e-5),
        },
    ),
    Function(
        "transmittance_cosine.sample",
        ("u", "theta_r"),
        lambda u, theta_r: TransmittanceCosineInclination(theta_r).sample(u),
        _cosine_sample,
        {name: product(MIDDLES, views, most=12) for name, views in _VIEWED.items()}
        # Not at 90 degrees, where the slope in u at its ends is 1 / cos(90 degrees).
        | {"ends of u": product(ENDS, VIEWS, most=18)},
        naive=_naive_cosine_sample,
        scale=angle,
        limits=FEW_ULPS,
        loose={
            "ordinary": within(5e-15, 5e-14, 3e-6, 3e-5),
            "grazing": within(9e-15, 6e-14, 5e-6, 3e-5),
            "ends of u": within(2e-15, 4e-10, 2e-6, 2e-1),
        },
    ),
    Function(
        "uniform_inclination.log_prob",
        ("theta_i",),
        lambda theta: UniformInclinationLaw().log_prob(theta),
        lambda theta: mp.log(mp.cos(theta) / 2) if within_domain(theta) else mp.nan,
        {
            "ordinary": [(x,) for x in deg(-60.0, -3.0, 0.5, 40.0)],
            "grazing: to 90 deg": [(x,) for x in (*deg(89.9, -89.999, 89.99999), HALF_PI)],
        },
        logarithm=True,
        limits=FEW_ULPS,
    ),
    Function(
        "uniform_inclination.sample",
        ("u",),
        UniformInclinationLaw().sample,
        lambda u: mp.asin(2 * u - 1) if 0 < u < 1 else mp.nan,
        {"ordinary": [(u,) for u in MIDDLES], "ends of u": [(u,) for u in (1e-300, *ENDS)]},
        naive=lambda u: torch.asin(2 * u - 1),
        scale=angle,
        limits=FEW_ULPS,
    ),
]
