"""Rows of the atlas: `dsfit.special`."""

from __future__ import annotations

import math

import mpmath as mp
import torch
from torch import Tensor

from dsfit import special
from dsfit.checks.stability import twins
from dsfit.checks.stability.function import Function, Point
from dsfit.checks.stability.limits import FEW_ULPS, within
from dsfit.checks.stability.points import product, thin

INF = math.inf
LOG_ROOT = 0.5 * math.log(2 * math.pi)


def _windows() -> dict[str, list[Point]]:
    """Ends (a, b) in standard deviations."""
    wide = [(-INF, 2.0), (4.0, INF), (-30.0, 1e4), (-1e4, 0.3), (-50.0, 60.0)]
    return {
        "ordinary: 0.1 to 8 wide": [(-1.0, 1.0), (-5.0, 3.0), (0.2, 0.9), (-0.1, 2.0), (3.0, 5.0), (-5.0, -3.0)],
        "wide: to infinity": wide,
        "tail: (8, 9), (30, 31) and on": [
            (8.0, 9.0),
            (30.0, 31.0),
            (-31.0, -30.0),
            (37.0, 50.0),
            (300.0, 305.0),
            (-1e4, -9e3),
            (1e5, 1.1e5),
        ],
        "small: 1e-300 to 1e-3 wide": [
            (0.0, 1e-300),
            (0.0, 1e-30),
            (0.5, 0.5 + 1e-12),
            (-1.0, -1.0 + 1e-8),
            (1e3, 1e3 + 1e-3),
            (-1e5, -1e5 + 0.02),
            (3.0, 3.001),
        ],
        "switch: either side of a series": [
            (0.3, 0.4 - 1e-6),
            (0.3, 0.4 + 1e-6),
            (5.0, 5.0198),
            (5.0, 5.0202),
            (-1e-9, 0.5),
            (1e-9, 0.5),
            (7.9999, 8.5),
            (8.0001, 8.5),
        ],
    }


def _log_window_twin(a: mp.mpf, b: mp.mpf) -> mp.mpf:
    nearest = a if a > 0 else (b if b < 0 else mp.mpf(0))
    return mp.log(twins.mass(a, b)) + nearest**2 / 2 + mp.log(2 * mp.pi) / 2


def _naive_mass(a: Tensor, b: Tensor) -> Tensor:
    return torch.special.ndtr(b) - torch.special.ndtr(a)


def _naive_log_mass(a: Tensor, b: Tensor) -> Tensor:
    return torch.log(_naive_mass(a, b))


def _naive_log_window(a: Tensor, b: Tensor) -> Tensor:
    nearest = special.nearest_to_zero(a, b)
    return _naive_log_mass(a, b) + 0.5 * nearest * nearest + LOG_ROOT


def _naive_mills(a: Tensor) -> Tensor:
    return torch.log(torch.special.ndtr(-a)) + 0.5 * a * a + LOG_ROOT


def _mills_twin(a: mp.mpf) -> mp.mpf:
    return mp.log(mp.erfc(a / mp.sqrt(2)) * mp.sqrt(mp.pi / 2)) + a**2 / 2


def _naive_gauss(x: Tensor, std: Tensor) -> Tensor:
    return torch.log(torch.exp(-x * x / (2 * std * std)) / (std * math.sqrt(2 * math.pi)))


def _truncated_points() -> dict[str, list[Point]]:
    """(t, mean, std, low, high): t in [0, 1] is where in the window; turned into x by `_at`."""
    low, high = -0.9, 0.67
    return {
        "ordinary": product([0.2, 0.45, 0.8], [-0.13, 0.2], [0.05, 0.13, 0.4], [low], [high]),
        "narrow: 0.01 and 0.0006 deg": [
            (0.5 + k * std, 0.5 * (low + high), std, low, high)
            for std in (1.7e-4, 1e-5)
            for k in (-3.0, -1.1, 0.4, 2.0)
        ],
        "wide: 1 to 100 rad": product([0.1, 0.6, 0.9], [-0.4, 0.1], [1.0, 10.0, 100.0], [low], [high]),
        "tail: mean 10 to 1e4 widths outside": [
            (1e-3, 0.8, 0.01, -1.5, 0.1),
            (0.999, 0.8, 0.01, -1.5, 0.1),
            (0.01, -0.13, 0.02, 0.4, 1.2),
            (1e-6, 1.5, 1e-4, -1.5, 0.5),
            (0.999999, 1.5, 1e-4, -1.5, 0.5),
            (0.5, -0.13, 0.002, 0.0, 1.57),
        ],
        "small: window 1e-9 to 1e-3": [
            (0.3, 0.2, 0.1, 0.3, 0.3 + 1e-9),
            (0.7, 0.2, 0.1, 0.3, 0.3 + 1e-6),
            (0.5, -0.4, 1e-3, 0.1, 0.1 + 1e-3),
            (0.4, 0.1, 1e-3, 0.1 - 1e-5, 0.1 + 1e-5),
        ],
    }


def _at(points: list[Point]) -> list[Point]:
    return [(low + t * (high - low), mean, std, low, high) for t, mean, std, low, high in points]


def _inside(x: mp.mpf, mean: mp.mpf, std: mp.mpf, low: mp.mpf, high: mp.mpf) -> mp.mpf:
    return twins.truncated_log_density(x, mean, std, low, high) if low <= x <= high else mp.nan


def _naive_truncated(x: Tensor, mean: Tensor, std: Tensor, low: Tensor, high: Tensor) -> Tensor:
    return torch.distributions.Normal(mean, std).log_prob(x) - _naive_log_mass((low - mean) / std, (high - mean) / std)


def _quantile_points() -> dict[str, list[Point]]:
    regimes = {}
    for name, rows in _truncated_points().items():
        regimes[name] = [(max(min(t, 0.97), 0.03), *rest) for t, *rest in rows]
    ends = (1e-30, 2e-38, 1e-10, 1 - 2**-53, 1 - 2**-24)
    laws = ((-0.13, 0.1, -0.9, 0.67), (0.1, 1e-3, -0.9, 0.67), (-0.13, 0.02, 0.4, 1.2), (0.0, 10.0, -0.7, 0.8))
    regimes["ends of u"] = [(u, *law) for u in ends for law in laws]
    regimes["ends of u: 1e-300"] = [(1e-300, *law) for law in laws[1:3]]
    return regimes


def _quantile_twin(u: mp.mpf, mean: mp.mpf, std: mp.mpf, low: mp.mpf, high: mp.mpf) -> mp.mpf:
    return twins.truncated_quantile(u, mean, std, low, high) if 0 < u < 1 else mp.nan


def _naive_quantile(u: Tensor, mean: Tensor, std: Tensor, low: Tensor, high: Tensor) -> Tensor:
    below, above = torch.special.ndtr((low - mean) / std), torch.special.ndtr((high - mean) / std)
    return mean + std * torch.special.ndtri(below + u * (above - below))


WRAPPED: dict[str, list[Point]] = {
    "ordinary": product([-2.5, -0.3, 1.0, 2.9], [0.2, 0.5, 1.0], most=12),
    "narrow: 0.06 and 0.006 deg": [(k * s, s) for s in (1e-3, 1e-4) for k in (-30.0, -3.0, -0.7, 1.2, 5.0)],
    "wide: to 50 rad": product([-3.0, -0.4, 1.7], [3.0, 6.0, 10.0, 50.0], most=12),
    "tail: the far side of a narrow law": product([-3.1, 2.0, 3.0], [0.01, 0.05, 0.1], most=9),
    "caustic: the seam at pi": product([-3.14159, 3.141, 3.1415926], [0.1, 0.5, 1.5], most=9),
    "switch: widths next to 1 and 2": product([-3.0, 0.4, 2.0], [0.999, 1.001, 1.999, 2.001], most=12),
}


def _naive_wrapped(x: Tensor, std: Tensor) -> Tensor:
    images = [torch.exp(-0.5 * ((x + 2 * math.pi * k) / std) ** 2) for k in (-1, 0, 1)]
    return torch.log(sum(images) / (std * math.sqrt(2 * math.pi)))


FUNCTIONS: list[Function] = [
    Function(
        "special.log_mills",
        ("a",),
        special.log_mills,
        _mills_twin,
        {
            "ordinary": [(x,) for x in (0.01, 0.3, 1.0, 2.5, 5.0)],
            "tail: to 1e12": [(x,) for x in (20.0, 40.0, 300.0, 1e4, 1e8, 1e12)],
            "switch: next to 8": [(x,) for x in (7.5, 7.9999, 8.0, 8.0001)],
        },
        naive=_naive_mills,
        logarithm=True,
        limits=FEW_ULPS,
        loose={
            "switch": within(3e-15, 2e-13, 2e-6, 4e-5),
        },
    ),
    Function(
        "special.log_window",
        ("a", "b"),
        special.log_window,
        _log_window_twin,
        _windows(),
        naive=_naive_log_window,
        logarithm=True,
        limits=FEW_ULPS,
        loose={
            "switch": within(3e-14, 3e-13, 6e-6, 2e-5),
        },
    ),
    Function(
        "special.log_normal_mass",
        ("a", "b"),
        special.log_normal_mass,
        lambda a, b: mp.log(twins.mass(a, b)),
        _windows(),
        naive=_naive_log_mass,
        logarithm=True,
        limits=FEW_ULPS,
        loose={
            "switch": within(2e-14, 3e-13, 5e-6, 2e-5),
        },
    ),
    Function(
        "special.normal_mass",
        ("a", "b"),
        special.normal_mass,
        twins.mass,
        {name: rows for name, rows in _windows().items() if "small" not in name},
        naive=_naive_mass,
        density=True,
        limits=FEW_ULPS,
        loose={
            "ordinary": within(7e-15, 1e-14, 3e-6, 1e-5),
            "wide": within(6e-15, 1e-14, 2e-6, 1e-5),
            "tail": within(5e-13, 6e-13, 6e-6, 1e-5),
            "switch": within(6e-14, 4e-14, 2e-5, 2e-5),
        },
    ),
    Function(
        "special.log_gauss",
        ("x", "std"),
        special.log_gauss,
        twins.log_gauss,
        {
            "ordinary": product([-0.6, -0.1, 0.2, 0.9], [0.05, 0.13, 0.5], most=12),
            "narrow: 0.0006 deg": [(k * 1e-5, 1e-5) for k in (-4.0, -0.6, 1.5, 7.0)],
            "wide: 100 rad": [(-1.5, 100.0), (0.7, 10.0), (1.2, 100.0)],
            "tail: to 1e5 widths": [(1.5, 1e-2), (-1.5, 1e-3), (1.0, 1e-5)],
        },
        naive=_naive_gauss,
        logarithm=True,
        limits=FEW_ULPS,
    ),
    Function(
        "special.truncated_normal_log_prob",
        ("x", "mean", "std", "low", "high"),
        special.truncated_normal_log_prob,
        _inside,
        {name: _at(thin(rows, 12)) for name, rows in _truncated_points().items()},
        naive=_naive_truncated,
        logarithm=True,
        limits=FEW_ULPS,
        loose={
            "narrow": within(6e-15, 1e-14, 8e-6, 1e-5),
            "wide": within(6e-15, 4e-12, 3e-6, 3e-3),
        },
    ),
    Function(
        "special.truncated_normal_icdf",
        ("u", "mean", "std", "low", "high"),
        special.truncated_normal_icdf,
        _quantile_twin,
        {name: thin(rows, 12) for name, rows in _quantile_points().items()},
        naive=_naive_quantile,
        scale=lambda u, mean, std, low, high, x: 0.1,
        limits=FEW_ULPS,
        loose={
            "ordinary": within(4e-15, 1e-13, 2e-6, 4e-5),
            "wide": within(3e-14, 4e-12, 3e-5, 6e-3),
            "tail": within(2e-15, 6e-11, 2e-6, 2e-2),
            "small": within(2e-15, 5e-12, 2e-6, 4e-3),
            "ends of u": within(4e-15, 4e-12, 2e-6, 3e-4),
        },
    ),
    Function(
        "special.wrapped_normal_log_prob",
        ("x", "std"),
        special.wrapped_normal_log_prob,
        lambda x, std: mp.log(twins.wrapped(x, std)),
        WRAPPED,
        naive=_naive_wrapped,
        logarithm=True,
        limits=FEW_ULPS,
        loose={
            "caustic": within(2e-15, 2e-10, 2e-6, 2e-1),
        },
    ),
]
