"""Rows of the atlas: longitudinal laws as functions of scalars, densities and samplers."""

from __future__ import annotations

import math

import mpmath as mp
import torch
from torch import Tensor

from dsfit.checks.stability import twins
from dsfit.checks.stability.function import Function, Point
from dsfit.checks.stability.points import DEG, deg, product, thin, where
from dsfit.proposals.cauchy_lobe import CauchyInclination
from dsfit.proposals.inclination import TruncatedGaussianInclination
from dsfit.proposals.split_lobe import SplitGaussianInclination
from dsfit.proposals.transmittance import TransmittanceCosineInclination
from dsfit.proposals.uniform import UniformInclinationLaw

HALF_PI = math.pi / 2
ENDS = (1e-30, 2e-38, 1e-7, 1 - 2**-24, 1 - 2**-53)
MIDDLES = (0.03, 0.31, 0.64, 0.97)
VIEWS = deg(-60.0, 0.7, 35.0)
STEEP = deg(89.0, -89.9, 89.999, -89.999)
POLES = (HALF_PI, -HALF_PI)


def lobe_laws() -> dict[str, list[Point]]:
    """(mean, std, theta_r) of lobes in theta_h, radians."""
    alphas = deg(-7.5, 3.75, 11.25)
    return {
        "ordinary: beta 2 to 20 deg": product(alphas, deg(2.0, 7.5, 20.0), VIEWS, most=6),
        "narrow: beta 0.01 deg": product(alphas, deg(0.01), VIEWS, most=3),
        "narrow: beta 1e-5 rad": product(alphas, [1e-5], VIEWS, most=3),
        "wide: beta 60 deg to 100 rad": product(alphas, [60 * DEG, 5.0, 100.0], VIEWS, most=4),
        "grazing: theta_r to 89.999 deg": product(alphas, deg(1.0, 7.5), STEEP, most=5),
        "grazing: theta_r = 90 deg": product(alphas, deg(1.0, 7.5), POLES, most=4),
        "tail: reached only 4 to 80 widths out": [
            (-7.5 * DEG, 0.1 * DEG, 89.999 * DEG),
            (11.25 * DEG, 2.0 * DEG, -89.0 * DEG),
            (-1.2, 0.02, 0.9),
            (1.5, 0.05, -0.6),
        ],
    }


def _densities() -> dict[str, list[Point]]:
    """(theta_i, mean, std, theta_r) with theta_i inside the support, near the mode and out to 6 widths."""
    regimes = {}
    for name, laws in lobe_laws().items():
        points = []
        for mean, std, theta_r in laws:
            low, high = theta_r / 2 - math.pi / 4, theta_r / 2 + math.pi / 4
            nearest = min(max(mean, low), high)
            step = min(std, std**2 / max(abs(nearest - mean), std), 0.3)
            around = [nearest + k * step for k in (-6.1, -2.3, -0.6, 0.4, 1.3, 3.2)]
            points += [(2 * t - theta_r, mean, std, theta_r) for t in around if low < t < high]
        regimes[name] = thin(where(points, lambda theta_i, *_: abs(theta_i) < HALF_PI), 14)
    regimes["grazing: theta_i to 89.9999 deg"] = product(
        deg(89.9, -89.999, 89.9999), deg(-7.5, 3.75), deg(7.5, 30.0), deg(-60.0, 40.0), most=10
    )
    return regimes


def _samples() -> dict[str, list[Point]]:
    """(u, mean, std, theta_r)."""
    regimes = {name: thin([(u, *law) for law in laws for u in MIDDLES], 12) for name, laws in lobe_laws().items()}
    ends = [(-7.5 * DEG, 7.5 * DEG, 0.7 * DEG), (3.75 * DEG, 0.01 * DEG, 0.6), (0.1, 1.0, -1.0)]
    regimes["ends of u"] = [(u, *law) for u in ENDS for law in ends]
    regimes["ends of u: 1e-300"] = [(1e-300, 3.75 * DEG, 0.5 * DEG, 0.6)]
    return regimes


def _with_second_width(regimes: dict[str, list[Point]]) -> dict[str, list[Point]]:
    """For the two-piece law, whose other width is 0.6 of the first."""
    return {name: [(x, mean, std, 0.6 * std, r) for x, mean, std, r in rows] for name, rows in regimes.items()}


def _window(theta_r: mp.mpf) -> tuple[mp.mpf, mp.mpf]:
    return theta_r / 2 - mp.pi / 4, theta_r / 2 + mp.pi / 4


def _within(theta_i: mp.mpf) -> bool:
    return abs(theta_i) <= mp.pi / 2


def _gauss_density(theta_i: mp.mpf, mean: mp.mpf, std: mp.mpf, theta_r: mp.mpf) -> mp.mpf:
    if not _within(theta_i):
        return mp.nan
    return twins.truncated_log_density((theta_i + theta_r) / 2, mean, std, *_window(theta_r)) - mp.log(2)


def _gauss_sample(u: mp.mpf, mean: mp.mpf, std: mp.mpf, theta_r: mp.mpf) -> mp.mpf:
    return 2 * twins.truncated_quantile(u, mean, std, *_window(theta_r)) - theta_r if 0 < u < 1 else mp.nan


def _gauss_in_density(theta_i: mp.mpf, mean: mp.mpf, std: mp.mpf) -> mp.mpf:
    if not _within(theta_i):
        return mp.nan
    return twins.truncated_log_density(theta_i, mean, std, -mp.pi / 2, mp.pi / 2)


def _cauchy_angles(mean: mp.mpf, scale: mp.mpf, theta_r: mp.mpf) -> tuple[mp.mpf, mp.mpf]:
    low, high = _window(theta_r)
    return mp.atan((low - mean) / scale), mp.atan((high - mean) / scale)


def _cauchy_density(theta_i: mp.mpf, mean: mp.mpf, scale: mp.mpf, theta_r: mp.mpf) -> mp.mpf:
    if not _within(theta_i):
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
    low, high = _window(theta_r)
    split = min(max(mode, low), high)
    root = mp.sqrt(2 * mp.pi)
    left = below * root * twins.mass((low - mode) / below, (split - mode) / below)
    right = above * root * twins.mass((split - mode) / above, (high - mode) / above)
    return low, high, split, left, right


def _split_density(theta_i: mp.mpf, mode: mp.mpf, below: mp.mpf, above: mp.mpf, theta_r: mp.mpf) -> mp.mpf:
    if not _within(theta_i):
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


def _naive_cosine_sample(u: Tensor, theta_r: Tensor) -> Tensor:
    low, high = torch.sin(theta_r / 2 - math.pi / 4), torch.sin(theta_r / 2 + math.pi / 4)
    return theta_r - 2 * torch.asin(low + u * (high - low))


def _cosine_density(theta_i: mp.mpf, theta_r: mp.mpf) -> mp.mpf:
    if not _within(theta_i):
        return mp.nan
    return mp.log(mp.cos((theta_r - theta_i) / 2) / (2 * mp.sqrt(2) * mp.cos(theta_r / 2)))


def _cosine_sample(u: mp.mpf, theta_r: mp.mpf) -> mp.mpf:
    if not 0 < u < 1:
        return mp.nan
    low, high = (mp.sin(end) for end in _window(theta_r))
    return theta_r - 2 * mp.asin(low + u * (high - low))


def _angle(*_: float) -> float:
    """An angle near zero: a sample's error counts against a tenth of a radian."""
    return 0.1


_VIEWED = {
    "ordinary": list(VIEWS),
    "grazing: theta_r to 89.999 deg": list(STEEP),
    "grazing: theta_r = 90 deg": list(POLES),
}

FUNCTIONS: list[Function] = [
    Function(
        "gaussian_lobe.log_prob",
        ("theta_i", "alpha", "beta", "theta_r"),
        lambda x, mean, std, theta_r: TruncatedGaussianInclination(theta_r, mean, std).log_prob(x),
        _gauss_density,
        _densities(),
        naive=_naive_gauss,
        logarithm=True,
    ),
    Function(
        "gaussian_lobe.sample",
        ("u", "alpha", "beta", "theta_r"),
        lambda u, mean, std, theta_r: TruncatedGaussianInclination(theta_r, mean, std).sample(u),
        _gauss_sample,
        _samples(),
        naive=_naive_gauss_sample,
        scale=_angle,
    ),
    Function(
        "cauchy_lobe.log_prob",
        ("theta_i", "alpha", "scale", "theta_r"),
        lambda x, mean, scale, theta_r: CauchyInclination(theta_r, mean, scale).log_prob(x),
        _cauchy_density,
        _densities(),
        naive=_naive_cauchy,
        logarithm=True,
    ),
    Function(
        "cauchy_lobe.sample",
        ("u", "alpha", "scale", "theta_r"),
        lambda u, mean, scale, theta_r: CauchyInclination(theta_r, mean, scale).sample(u),
        _cauchy_sample,
        _samples(),
        naive=_naive_cauchy_sample,
        scale=_angle,
    ),
    Function(
        "split_lobe.log_prob",
        ("theta_i", "mode", "below", "above", "theta_r"),
        lambda x, *law: _split_law(*law).log_prob(x),
        _split_density,
        _with_second_width(_densities()),
        naive=_naive_split,
        logarithm=True,
    ),
    Function(
        "split_lobe.sample",
        ("u", "mode", "below", "above", "theta_r"),
        lambda u, *law: _split_law(*law).sample(u),
        _split_sample,
        _with_second_width(_samples()),
        scale=_angle,
    ),
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
    ),
    Function(
        "transmittance_cosine.log_prob",
        ("theta_i", "theta_r"),
        lambda x, theta_r: TransmittanceCosineInclination(theta_r).log_prob(x),
        _cosine_density,
        {name: product(deg(-80.0, -3.0, 50.0), views) for name, views in _VIEWED.items()}
        | {"caustic: theta_diff to 90 deg": [(89.999 * DEG, -89.999 * DEG), (-HALF_PI, 89.9999 * DEG), (1.55, -1.55)]},
        logarithm=True,
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
        scale=_angle,
    ),
    Function(
        "uniform_inclination.log_prob",
        ("theta_i",),
        lambda theta: UniformInclinationLaw().log_prob(theta),
        lambda theta: mp.log(mp.cos(theta) / 2) if _within(theta) else mp.nan,
        {
            "ordinary": [(x,) for x in deg(-60.0, -3.0, 0.5, 40.0)],
            "grazing: to 90 deg": [(x,) for x in (*deg(89.9, -89.999, 89.99999), HALF_PI)],
        },
        logarithm=True,
    ),
    Function(
        "uniform_inclination.sample",
        ("u",),
        UniformInclinationLaw().sample,
        lambda u: mp.asin(2 * u - 1) if 0 < u < 1 else mp.nan,
        {"ordinary": [(u,) for u in MIDDLES], "ends of u": [(u,) for u in (1e-300, *ENDS)]},
        naive=lambda u: torch.asin(2 * u - 1),
        scale=_angle,
    ),
]
