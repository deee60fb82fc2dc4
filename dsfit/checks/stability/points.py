"""Points of regimes: angles in degrees, products of lists, and thinning to a number that 50-digit arithmetic can
afford."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from dsfit.checks.stability.function import Point

DEG = math.pi / 180


def deg(*angles: float) -> tuple[float, ...]:
    """Degrees to radians."""
    return tuple(angle * DEG for angle in angles)


def product(*lists: Iterable[float], most: int = 16) -> list[Point]:
    """All combinations, or `most` of them chosen once and for all."""
    return thin(list(itertools.product(*lists)), most)


def thin(points: Sequence[Point], most: int = 16) -> list[Point]:
    """At most that many of the points, chosen by a fixed seed, the first and the last among them."""
    if len(points) <= most:
        return list(points)
    inner = np.random.default_rng(len(points)).choice(np.arange(1, len(points) - 1), most - 2, replace=False)
    return [points[i] for i in (0, *sorted(inner.tolist()), len(points) - 1)]


def where(points: Iterable[Point], condition: Callable[..., bool]) -> list[Point]:
    """The points that satisfy a condition of the arguments."""
    return [point for point in points if condition(*point)]
