"""Points of longitudinal lobes: widths from 1e-5 rad to 100 rad, views to 90 degrees, lobes reached only by their
tails."""

from __future__ import annotations

import math

from dsfit.checks.stability.function import Point
from dsfit.checks.stability.points import DEG, deg, product, thin, where

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


def densities() -> dict[str, list[Point]]:
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


def samples() -> dict[str, list[Point]]:
    """(u, mean, std, theta_r)."""
    regimes = {name: thin([(u, *law) for law in laws for u in MIDDLES], 12) for name, laws in lobe_laws().items()}
    ends = [(-7.5 * DEG, 7.5 * DEG, 0.7 * DEG), (3.75 * DEG, 0.01 * DEG, 0.6), (0.1, 1.0, -1.0)]
    regimes["ends of u"] = [(u, *law) for u in ENDS for law in ends]
    regimes["ends of u: 1e-300"] = [(1e-300, 3.75 * DEG, 0.5 * DEG, 0.6)]
    return regimes


def with_second_width(regimes: dict[str, list[Point]]) -> dict[str, list[Point]]:
    """For the two-piece law, whose other width is 0.6 of the first."""
    return {name: [(x, mean, std, 0.6 * std, r) for x, mean, std, r in rows] for name, rows in regimes.items()}
