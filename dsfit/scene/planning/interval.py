"""Intervals of real numbers, elementwise, and functions tabulated as enclosures."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

ROUNDING = 1e-9
"""Relative widening of every final bound: sums of at most 10^5 positive numbers of float64, each good to 10^-13, are
good to 10^-10."""


@dataclass(frozen=True)
class Interval:
    """Numbers known to lie in [low, high], tensors of one shape. Operations enclose all results (up to rounding)."""

    low: Tensor
    high: Tensor

    @staticmethod
    def exactly(value: Tensor) -> Interval:
        """The interval of one number."""
        return Interval(value, value)

    def __add__(self, other: Interval | Tensor | float) -> Interval:
        low, high = _ends(other)
        return Interval(self.low + low, self.high + high)

    def __sub__(self, other: Interval | Tensor | float) -> Interval:
        low, high = _ends(other)
        return Interval(self.low - high, self.high - low)

    def __mul__(self, other: Interval | Tensor | float) -> Interval:
        low, high = _ends(other)
        products = [self.low * low, self.low * high, self.high * low, self.high * high]
        return Interval(_fold(torch.minimum, products), _fold(torch.maximum, products))

    def __truediv__(self, other: Interval) -> Interval:
        """Quotient by an interval of positive numbers; by 0, unbounded."""
        return self * Interval(1 / other.high, 1 / other.low)

    def map(self, rising: Callable[[Tensor], Tensor]) -> Interval:
        """Image under a function that does not fall."""
        return Interval(rising(self.low), rising(self.high))

    def falling(self, function: Callable[[Tensor], Tensor]) -> Interval:
        """Image under a function that does not rise."""
        return Interval(function(self.high), function(self.low))

    def square(self) -> Interval:
        """x^2."""
        size = self.abs()
        return Interval(size.low**2, size.high**2)

    def abs(self) -> Interval:
        """|x|."""
        crosses = (self.low <= 0) & (self.high >= 0)
        a, b = self.low.abs(), self.high.abs()
        return Interval(torch.where(crosses, 0.0, torch.minimum(a, b)), torch.maximum(a, b))

    def clamp(self, low: float = -math.inf, high: float = math.inf) -> Interval:
        """Intersection with what is known otherwise: [low, high]."""
        return Interval(self.low.clamp(low, high), self.high.clamp(low, high))

    def reshape(self, function: Callable[[Tensor], Tensor]) -> Interval:
        """Both ends reshaped, indexed or summed alike."""
        return Interval(function(self.low), function(self.high))


def _ends(x: Interval | Tensor | float) -> tuple[Tensor | float, Tensor | float]:
    return (x.low, x.high) if isinstance(x, Interval) else (x, x)


def _fold(function: Callable[[Tensor, Tensor], Tensor], values: list[Tensor]) -> Tensor:
    values = list(torch.broadcast_tensors(*values))
    total = values[0]
    for value in values[1:]:
        total = function(total, value)
    return total


def cosine(x: Interval) -> Interval:
    """cos x for x in [-pi, pi]."""
    size = x.abs()
    return Interval(torch.cos(size.high.clamp_max(math.pi)), torch.cos(size.low.clamp_max(math.pi)))


class RangeTable:
    """Enclosures of a function on cells, joined over any interval in constant time (a table of ranges of 2^k cells).

    Args:
        breaks: ends of the cells `[G + 1]`, increasing.
        values: enclosures on the cells, `[G, ...]`.
    """

    def __init__(self, breaks: Tensor, values: Interval) -> None:
        self.breaks = breaks
        low, high = [values.low], [values.high]
        step = 1
        while 2 * step <= len(values.low):
            low.append(torch.minimum(low[-1][:-step], low[-1][step:]))
            high.append(torch.maximum(high[-1][:-step], high[-1][step:]))
            step *= 2
        count = len(values.low)
        self._low = torch.stack([_padded(x, count) for x in low])
        self._high = torch.stack([_padded(x, count) for x in high])

    def over(self, x: Interval) -> Interval:
        """What the function can be for arguments in the intervals `[...]`; `[..., *values]`. Clipped to the table."""
        inner = self.breaks[1:-1]
        first = torch.searchsorted(inner, x.low.contiguous(), right=False)
        last = torch.searchsorted(inner, x.high.contiguous(), right=True)
        level = torch.log2((last - first + 1).to(torch.float64)).floor().to(torch.int64)
        other = last - torch.bitwise_left_shift(torch.ones_like(level), level) + 1
        return Interval(
            torch.minimum(self._low[level, first], self._low[level, other]),
            torch.maximum(self._high[level, first], self._high[level, other]),
        )


def _padded(x: Tensor, count: int) -> Tensor:
    return torch.cat([x, x[-1:].expand(count - len(x), *x.shape[1:])]) if len(x) < count else x
