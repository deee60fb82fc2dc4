"""One-dimensional nodes: Gauss-Legendre, and piecewise Chebyshev interpolation that refines itself."""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

_RESOLVED = 1e-8  # relative tail below which a panel counts as resolved


@functools.lru_cache(maxsize=64)
def _legendre(count: int) -> tuple[np.ndarray, np.ndarray]:
    return np.polynomial.legendre.leggauss(count)


def gauss_legendre(
    count: int, dtype: torch.dtype = torch.float64, device: torch.device | None = None
) -> tuple[Tensor, Tensor]:
    """Nodes in (-1, 1) and weights (summing to 2) of the Gauss-Legendre rule."""
    x, w = _legendre(count)
    return torch.as_tensor(x, dtype=dtype, device=device), torch.as_tensor(w, dtype=dtype, device=device)


@functools.lru_cache(maxsize=8)
def _chebyshev(degree: int) -> tuple[np.ndarray, np.ndarray]:
    """First-kind nodes and the matrix from values at them to Chebyshev coefficients."""
    k = np.arange(degree + 1)
    angle = (k + 0.5) * np.pi / (degree + 1)
    matrix = np.cos(np.outer(k, angle)) * (2.0 / (degree + 1))
    matrix[0] /= 2
    return np.cos(angle), matrix


class PiecewiseChebyshev:
    """Interpolant of a vector function on an interval: Chebyshev series of one degree on each of many panels.

    Args:
        function: maps `[M]` points to values `[M, ...]`.
        breaks: increasing panel ends to start from.
        tolerance: panels whose two last coefficients exceed `tolerance` times the panel's largest value (of any
            component, and at least 1e-3 of the largest seen anywhere) are halved.
        degree: degree of the series.
        max_depth: how often a panel may be halved.

    Values keep their autograd graph, so the interpolant is differentiable in whatever `function` closes over and in
    the argument.
    """

    def __init__(
        self,
        function: Callable[[Tensor], Tensor],
        breaks: Tensor,
        tolerance: float = 1e-12,
        degree: int = 16,
        max_depth: int = 12,
    ) -> None:
        low, high = breaks[:-1], breaks[1:]
        nodes, matrix = _chebyshev(degree)
        nodes = torch.as_tensor(nodes, dtype=breaks.dtype, device=breaks.device)
        matrix = torch.as_tensor(matrix, dtype=breaks.dtype, device=breaks.device)
        done: list[tuple[Tensor, Tensor, Tensor]] = []
        largest, parent = 0.0, torch.full_like(low, float("inf"))
        for depth in range(max_depth + 1):
            x = (low + high)[:, None] / 2 + (high - low)[:, None] / 2 * nodes
            values = function(x.reshape(-1))
            values = values.reshape(len(low), degree + 1, -1)
            coefficients = torch.einsum("jk,pkv->pjv", matrix, values)
            tail = coefficients[:, -2:].detach().abs().amax(1)
            scale = values.detach().abs().amax((1, 2))
            largest = max(largest, float(scale.max()))
            scale = scale.clamp_min(max(1e-3 * largest, torch.finfo(values.dtype).tiny))
            error = (tail / scale[:, None]).amax(-1)
            # once resolved, halving cuts the tail by far more than 4; where it does not, rounding is all that is left
            improving = (error > _RESOLVED) | (error < 0.25 * parent)
            bad = (error > tolerance) & improving & (depth < max_depth)
            done.append((low[~bad], high[~bad], coefficients[~bad]))
            if not bool(bad.any()):
                break
            middle = (low[bad] + high[bad]) / 2
            low, high = torch.cat([low[bad], middle]), torch.cat([middle, high[bad]])
            parent = error[bad].repeat(2)
        low = torch.cat([d[0] for d in done])
        order = torch.argsort(low)
        self.low = low[order]
        self.high = torch.cat([d[1] for d in done])[order]
        self.coefficients = torch.cat([d[2] for d in done])[order].transpose(0, 1).contiguous()

    @property
    def panels(self) -> int:
        """Number of panels."""
        return len(self.low)

    def select(self, choose: Callable[[Tensor], Tensor]) -> PiecewiseChebyshev:
        """The interpolant of some of the components: `choose` maps `[..., V]` to the components kept."""
        part = copy.copy(self)
        part.coefficients = choose(self.coefficients)
        return part

    def __call__(self, x: Tensor) -> Tensor:
        """Values `[..., V]` at points `[...]`; points outside the interval are moved to its nearer end."""
        low, high = self.low.to(x.dtype), self.high.to(x.dtype)
        x = x.clamp(float(self.low[0]), float(self.high[-1]))
        index = (torch.searchsorted(low, x.detach().contiguous(), right=True) - 1).clamp(0, self.panels - 1)
        width = (high[index] - low[index]).clamp_min(torch.finfo(x.dtype).eps)  # the last panel is empty in float32
        t = ((2 * x - low[index] - high[index]) / width).unsqueeze(-1)
        coefficients = self.coefficients.to(x.dtype)
        ahead: Tensor | float = 0.0
        current: Tensor = coefficients[-1][index]
        for k in range(coefficients.shape[0] - 2, 0, -1):
            current, ahead = coefficients[k][index] + 2 * t * current - ahead, current
        return coefficients[0][index] + t * current - ahead


def merge_breaks(points: Tensor, low: float, high: float, smallest: float = 1e-9) -> Tensor:
    """Sorted panel ends in [low, high], both ends included, closer pairs than `smallest` merged."""
    inside = points[(points > low + smallest) & (points < high - smallest)]
    ends = torch.tensor([low, high], dtype=points.dtype, device=points.device)
    ordered = torch.sort(torch.cat([ends, inside])).values
    keep = torch.ones_like(ordered, dtype=torch.bool)
    keep[1:] = ordered[1:] - ordered[:-1] > smallest
    keep[-1] = True
    merged = ordered[keep]
    return merged


def graded_ends(low: float, high: float, levels: int = 30, ratio: float = 0.5) -> list[float]:
    """Break points that pile up geometrically at both ends of an interval, for functions like x log x there."""
    half = (high - low) / 2
    steps = [half * ratio**k for k in range(1, levels + 1)]
    return [low + s for s in steps] + [high - s for s in steps] + [low + half]


def panel_points(breaks: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Composite Gauss-Legendre nodes and weights on consecutive panels `breaks[..., k], breaks[..., k + 1]`; `[...,
    panels * count]`.

    Panels of zero width contribute nothing, so callers may clamp breaks into a moving interval.
    """
    x, w = gauss_legendre(count, breaks.dtype, breaks.device)
    half = (breaks[..., 1:] - breaks[..., :-1]).unsqueeze(-1) / 2
    nodes = breaks[..., :-1].unsqueeze(-1) + half * (1 + x)
    weights = half * w
    return nodes.flatten(-2), weights.expand_as(nodes).flatten(-2)
