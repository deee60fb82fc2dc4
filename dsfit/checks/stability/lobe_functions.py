"""Rows of the atlas: longitudinal lobes as functions of scalars, densities and samplers."""

from __future__ import annotations

import math

import mpmath as mp
import torch
from torch import Tensor

from dsfit.checks.stability import twins
from dsfit.checks.stability.function import Function
from dsfit.checks.stability.limits import FEW_ULPS, within
from dsfit.checks.stability.lobe_points import densities, samples, with_second_width
from dsfit.proposals.cauchy_lobe import CauchyInclination
from dsfit.proposals.inclination import TruncatedGaussianInclination
from dsfit.proposals.split_lobe import SplitGaussianInclination


def window(theta_r: mp.mpf) -> tuple[mp.mpf, mp.mpf]:
    """What theta_h and theta_diff can reach."""
    return theta_r / 2 - mp.pi / 4, theta_r / 2 + mp.pi / 4


def within_domain(theta_i: mp.mpf) -> bool:
    """False beyond 90 degrees, which float32 rounds up."""
    return abs(theta_i) <= mp.pi / 2


def _gauss_density(theta_i: mp.mpf, mean: mp.mpf, std: mp.mpf, theta_r: mp.mpf) -> mp.mpf:
    if not within_domain(theta_i):
        return mp.nan
    return twins.truncated_log_density((theta_i + theta_r) / 2, mean, std, *window(theta_r)) - mp.log(2)


def _gauss_sample(u: mp.mpf, mean: mp.mpf, std: mp.mpf, theta_r: mp.mpf) -> mp.mpf:
    return 2 * twins.truncated_quantile(u, mean, std, *window(theta_r)) - theta_r if 0 < u < 1 else mp.nan


def _cauchy_angles(mean: mp.mpf, scale: mp.mpf, theta_r: mp.mpf) -> tuple[mp.mpf, mp.mpf]:
    low, high = window(theta_r)
    return mp.atan((low - mean) / scale), mp.atan((high - mean) / scale)


def _cauchy_density(theta_i: mp.mpf, mean: mp.mpf, scale: mp.mpf, theta_r: mp.mpf) -> mp.mpf:
    if not within_domain(theta_i):
        return mp.nan
    t, (start, end) = (theta_i + theta_r) / 2 - mean, _cauchy_angles(mean, scale, theta_r)
    return mp.log(scale / (t**2 + scale**2) / (2 * (end - start)))


def _cauchy_sample(u: mp.mpf, mean: mp.mpf, scale: mp.mpf, theta_r: mp.mpf) -> mp.mpf:
    if not 0 < u < 1:
        return mp.nan
    start, end = _cauchy_angles(mean, scale, theta_r)
    return 2 * (mean + scale * mp.tan(start + u * (end - start))) - theta_r


def _split_pieces(mode: mp.mpf, below: mp.mpf, above: mp.mpf, theta_r: mp.mpf) -> tuple[mp.mpf, ...]:
    """L, H, where the pieces meet, and their masses over the peak density."""
    low, high = window(theta_r)
    split = min(max(mode, low), high)
    root = mp.sqrt(2 * mp.pi)
    left = below * root * twins.mass((low - mode) / below, (split - mode) / below)
    right = above * root * twins.mass((split - mode) / above, (high - mode) / above)
    return low, high, split, left, right


def _split_density(theta_i: mp.mpf, mode: mp.mpf, below: mp.mpf, above: mp.mpf, theta_r: mp.mpf) -> mp.mpf:
    if not within_domain(theta_i):
        return mp.nan
    x = (theta_i + theta_r) / 2 - mode
    *_, left, right = _split_pieces(mode, below, above, theta_r)
    return -((x / (below if x < 0 else above)) ** 2) / 2 - mp.log(2 * (left + right))


def _split_sample(u: mp.mpf, mode: mp.mpf, below: mp.mpf, above: mp.mpf, theta_r: mp.mpf) -> mp.mpf:
    if not 0 < u < 1:
        return mp.nan
    low, high, split, left, right = _split_pieces(mode, below, above, theta_r)
    share = left / (left + right)
    if u < share:
        return 2 * twins.truncated_quantile(u / share, mode, below, low, split) - theta_r
    return 2 * twins.truncated_quantile((u - share) / (1 - share), mode, above, split, high) - theta_r


def _split_law(mode: Tensor, below: Tensor, above: Tensor, theta_r: Tensor) -> SplitGaussianInclination:
    return SplitGaussianInclination(theta_r, mode, below, above)


def _ndtr_mass(mean: Tensor, std: Tensor, low: Tensor, high: Tensor) -> Tensor:
    return torch.special.ndtr((high - mean) / std) - torch.special.ndtr((low - mean) / std)


def _naive_gauss(theta_i: Tensor, mean: Tensor, std: Tensor, theta_r: Tensor) -> Tensor:
    low, high = theta_r / 2 - math.pi / 4, theta_r / 2 + math.pi / 4
    peak = torch.exp(-0.5 * (((theta_i + theta_r) / 2 - mean) / std) ** 2) / (std * math.sqrt(2 * math.pi))
    return torch.log(peak / (2 * _ndtr_mass(mean, std, low, high)))


def _naive_gauss_sample(u: Tensor, mean: Tensor, std: Tensor, theta_r: Tensor) -> Tensor:
    low, high = theta_r / 2 - math.pi / 4, theta_r / 2 + math.pi / 4
    start = torch.special.ndtr((low - mean) / std)
    return 2 * (mean + std * torch.special.ndtri(start + u * _ndtr_mass(mean, std, low, high))) - theta_r


def _naive_cauchy(theta_i: Tensor, mean: Tensor, scale: Tensor, theta_r: Tensor) -> Tensor:
    low, high = theta_r / 2 - math.pi / 4 - mean, theta_r / 2 + math.pi / 4 - mean
    angle = torch.atan(high / scale) - torch.atan(low / scale)
    t = (theta_i + theta_r) / 2 - mean
    return torch.log(scale / (t * t + scale * scale) / (2 * angle))


def _naive_cauchy_sample(u: Tensor, mean: Tensor, scale: Tensor, theta_r: Tensor) -> Tensor:
    start = torch.atan((theta_r / 2 - math.pi / 4 - mean) / scale)
    end = torch.atan((theta_r / 2 + math.pi / 4 - mean) / scale)
    return 2 * (scale * torch.tan(u * (end - start) + start) + mean) - theta_r


def _naive_split(theta_i: Tensor, mode: Tensor, below: Tensor, above: Tensor, theta_r: Tensor) -> Tensor:
    low, high = theta_r / 2 - math.pi / 4, theta_r / 2 + math.pi / 4
    split = torch.minimum(torch.maximum(mode, low), high)
    mass = below * _ndtr_mass(mode, below, low, split) + above * _ndtr_mass(mode, above, split, high)
    x = (theta_i + theta_r) / 2 - mode
    peak = torch.exp(-0.5 * (x / torch.where(x < 0, below, above)) ** 2)
    return torch.log(peak / (2 * math.sqrt(2 * math.pi) * mass))


def angle(*_: float) -> float:
    """An angle near zero: a sample's error counts against a tenth of a radian."""
    return 0.1


FUNCTIONS: list[Function] = [
    Function(
        "gaussian_lobe.log_prob",
        ("theta_i", "alpha", "beta", "theta_r"),
        lambda x, mean, std, theta_r: TruncatedGaussianInclination(theta_r, mean, std).log_prob(x),
        _gauss_density,
        densities(),
        naive=_naive_gauss,
        logarithm=True,
        limits=FEW_ULPS,
        loose={
            "narrow": within(3e-15, 1e-14, 2e-4, 6e-4),
            "wide": within(2e-15, 2e-10, 2e-6, 9e-2),
            "grazing": within(4e-14, 4e-13, 3e-5, 2e-4),
            "tail": within(1e-12, 2e-12, 7e-4, 2e-3),
        },
    ),
    Function(
        "gaussian_lobe.sample",
        ("u", "alpha", "beta", "theta_r"),
        lambda u, mean, std, theta_r: TruncatedGaussianInclination(theta_r, mean, std).sample(u),
        _gauss_sample,
        samples(),
        naive=_naive_gauss_sample,
        scale=angle,
        limits=FEW_ULPS,
        loose={
            "ordinary": within(2e-15, 4e-14, 2e-6, 2e-5),
            "wide": within(6e-15, 4e-12, 7e-6, 9e-4),
            "grazing": within(2e-15, 4e-11, 2e-6, 4e-2),
            "tail": within(2e-15, 3e-9, 2e-6, 3e-1),
            "ends of u": within(3e-15, 8e-10, 2e-6, 6e-2),
        },
    ),
    Function(
        "cauchy_lobe.log_prob",
        ("theta_i", "alpha", "scale", "theta_r"),
        lambda x, mean, scale, theta_r: CauchyInclination(theta_r, mean, scale).log_prob(x),
        _cauchy_density,
        densities(),
        naive=_naive_cauchy,
        logarithm=True,
        limits=FEW_ULPS,
        loose={
            "narrow": within(2e-15, 1e-14, 4e-5, 4e-4),
            "wide": within(4e-15, 3e-10, 3e-6, 1e-1),
            "grazing": within(3e-15, 2e-13, 2e-6, 5e-5),
            "tail": within(4e-15, 9e-13, 2e-6, 3e-4),
        },
    ),
    Function(
        "cauchy_lobe.sample",
        ("u", "alpha", "scale", "theta_r"),
        lambda u, mean, scale, theta_r: CauchyInclination(theta_r, mean, scale).sample(u),
        _cauchy_sample,
        samples(),
        naive=_naive_cauchy_sample,
        scale=angle,
        limits=FEW_ULPS,
        loose={
            "wide": within(6e-15, 2e-12, 3e-6, 2e-3),
            "grazing": within(4e-15, 3e-12, 3e-6, 2e-3),
            "tail": within(5e-14, 5e-11, 7e-6, 2e-2),
            "ends of u": within(2e-15, 5e-10, 2e-6, 2e-1),
        },
    ),
    Function(
        "split_lobe.log_prob",
        ("theta_i", "mode", "below", "above", "theta_r"),
        lambda x, *law: _split_law(*law).log_prob(x),
        _split_density,
        with_second_width(densities()),
        naive=_naive_split,
        logarithm=True,
        limits=FEW_ULPS,
        loose={
            "ordinary": within(7e-15, 2e-14, 3e-6, 1e-5),
            "narrow": within(3e-15, 1e-14, 2e-4, 3e-3),
            "wide": within(2e-15, 1e-8, 2e-6, 6.0),
            "grazing": within(2e-13, 3e-12, 7e-5, 2e-3),
            "tail": within(8e-12, 3e-12, 6e-3, 2e-3),
        },
    ),
    Function(
        "split_lobe.sample",
        ("u", "mode", "below", "above", "theta_r"),
        lambda u, *law: _split_law(*law).sample(u),
        _split_sample,
        with_second_width(samples()),
        scale=angle,
        limits=FEW_ULPS,
        loose={
            "wide": within(2e-14, 4e-12, 5e-6, 2e-3),
            "grazing": within(2e-15, 4e-10, 2e-6, 4e-3),
            "tail": within(2e-15, 3e-9, 2e-6, 2e-1),
            "ends of u": within(2e-15, 3e-10, 2e-6, 5e-2),
        },
    ),
]
