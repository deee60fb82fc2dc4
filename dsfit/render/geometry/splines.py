"""Curves of pbrt's `curve` shape: control points to Bezier spans to points."""

from __future__ import annotations

import math

import numpy as np

BASES = ("bezier", "bspline")
"""Allowed, the one that is meant if none is given first."""
DEGREES = (3.0, 2.0)
"""Likewise; numbers of a scene file are floats."""

_TO_BEZIER = {
    2: np.array([[1, 1, 0], [0, 2, 0], [0, 1, 1]]) / 2.0,
    3: np.array([[1, 4, 1, 0], [0, 4, 2, 0], [0, 2, 4, 0], [0, 1, 4, 1]]) / 6.0,
}
"""Control points of a uniform B-spline span to those of the same curve as a Bezier span."""


def spans(count: int, basis: str, degree: int) -> int:
    """Number of spans of a curve with `count` control points; 0 where there can be no such curve."""
    if basis == "bspline":
        return max(0, count - degree)
    return (count - 1) // degree if count > degree and (count - 1) % degree == 0 else 0


def evaluated(control: np.ndarray, basis: str, degree: int, pieces: int) -> np.ndarray:
    """Points on curves, at equal steps of the parameter.

    Args:
        control: `[C, n, d]` control points of curves, as many for each; n as `spans` wants it.
        basis: `bezier`: spans share their end points; `bspline`: uniform B-spline.
        degree: 2 or 3.
        pieces: steps per span.

    Returns:
        `[C, spans x pieces + 1, d]`; neighbouring spans share a point.
    """
    number = spans(control.shape[1], basis, degree)
    step = 1 if basis == "bspline" else degree
    index = step * np.arange(number)[:, None] + np.arange(degree + 1)
    local = control[:, index]  # [C, spans, degree + 1, d]
    t = np.arange(pieces + 1)[:, None] / pieces
    order = np.arange(degree + 1)
    weights = np.array([math.comb(degree, k) for k in order]) * t**order * (1.0 - t) ** (degree - order)
    if basis == "bspline":
        weights = weights @ _TO_BEZIER[degree]
    points = np.einsum("tk,cskd->cstd", weights, local)
    inner = points[:, :, :-1].reshape(len(control), number * pieces, -1)
    return np.concatenate([inner, points[:, -1, -1:]], axis=1)
