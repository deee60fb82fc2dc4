"""How a function approaches a limit: distances, their bound, and the order of their decay."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

_ROUNDING = 1e-13


@dataclass(frozen=True)
class Approach:
    """How a function approaches its limit.

    Attributes:
        name: of the limit.
        parameters: decreasing to 0, `[K]`.
        distances: from the limit at each of them, relative to its size.
        bounds: what each distance may be; stated, not measured.
        order: least order that the theory gives; 0: no order, as where the decay is exponential.
        law: the bound, in words.
    """

    name: str
    parameters: tuple[float, ...]
    distances: tuple[float, ...]
    bounds: tuple[float, ...]
    order: float
    law: str

    @property
    def excess(self) -> float:
        """Largest distance / bound; at most 1 if the bound holds."""
        pairs = zip(self.distances, self.bounds, strict=True)
        ratios = [d / (b + _ROUNDING) if math.isfinite(d) else math.inf for d, b in pairs]
        return max(ratios)

    @property
    def measured_order(self) -> float:
        """Slope of log distance over log parameter through the last three distances above rounding; inf if fewer."""
        pairs = [(p, d) for p, d in zip(self.parameters, self.distances, strict=True) if d > 100 * _ROUNDING]
        if len(pairs) < 3:
            return math.inf
        x, y = np.log(np.array(pairs[-3:])).T
        return float(np.polyfit(x, y, 1)[0])

    @property
    def shortfall(self) -> float:
        """By how much the measured order is below the theory's."""
        return 0.0 if self.order == 0 else self.order - self.measured_order


def approach(
    name: str,
    function: Callable[[float], Tensor],
    limit: Tensor,
    parameters: Sequence[float],
    bound: Callable[[float], float],
    order: float,
    law: str,
) -> Approach:
    """Evaluate `function` along the parameters; distances are largest differences relative to the largest value of the
    limit (absolute where that is 0)."""
    scale = float(limit.abs().max()) or 1.0
    with torch.no_grad():
        distances = [_distance(function(x), limit, scale) for x in parameters]
    bounds = tuple(bound(x) for x in parameters)
    return Approach(name, tuple(parameters), tuple(distances), bounds, order, law)


def _distance(value: Tensor, limit: Tensor, scale: float) -> float:
    return float((value - limit).abs().max()) / scale if bool(value.isfinite().all()) else math.inf


STEPS = (1e-1, 1e-2, 1e-3, 1e-4)


def slope_at_zero(function: Callable[[float], Tensor], step: float = 1e-4) -> float:
    """Largest slope just above 0, from two values of the function itself: the limit takes no part in it."""
    with torch.no_grad():
        return float((function(step) - function(step / 2)).abs().max()) / (step / 2)


def linear_approach(name: str, function: Callable[[float], Tensor], limit: Tensor, law: str) -> Approach:
    """A limit that is approached linearly: the distance may be twice what the slope near 0 gives."""
    slope = slope_at_zero(function) / (float(limit.abs().max()) or 1.0)
    return approach(name, function, limit, STEPS, lambda x: 2 * slope * x, 0.9, law)
