"""Learnable numbers behind bijections, for unconstrained optimisers and for fits that tell what sits at a bound.

    linear:  value = low + (high - low) sigmoid(4 raw / (high - low))            d value / d raw = 1 at the centre
    log:     log value = log low + R sigmoid(4 raw / R),  R = log(high / low)    d log value / d raw = 1 at the centre

so one unit of `raw` is one unit of the value (radians), or one e-fold, wherever the value is away from its bounds.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from dsfit.context import Context
from dsfit.errors import as_real, check_finite, check_range
from dsfit.frame import HALF_PI

STD_BOUNDS = (1e-5, 1e2)
"""Bounds of every longitudinal width, radians: far narrower and wider than any fibre (0.0006 to 5730 degrees)."""
AZIMUTH_STD_BOUNDS = (1e-4, 1e2)
"""Bounds of every azimuthal width, radians."""
MEAN_BOUNDS = (-HALF_PI, HALF_PI)
"""Bounds of every longitudinal centre, radians."""

Constrained = dict[str, tuple[Tensor, float, float]]
"""Name of a learnable value to (value, low, high)."""


def to_raw(field: str, value: Tensor, low: float, high: float, log: bool = False) -> Tensor:
    """The unconstrained number of `value`; `InputError` unless low < value < high."""
    check_range(field, value, low, high, open_low=True, open_high=True)
    if log:
        value, low, high = torch.log(value), math.log(low), math.log(high)
    return torch.logit((value - low) / (high - low)) * (high - low) / 4


def from_raw(raw: Tensor, low: float, high: float, log: bool = False) -> Tensor:
    """The value in [low, high] of an unconstrained number; see the module text."""
    if log:
        return torch.exp(from_raw(raw, math.log(low), math.log(high)))
    return low + (high - low) * torch.sigmoid(4 * raw / (high - low))


class Bounded(nn.Module):
    """A value in (low, high), of any shape that broadcasts against the context batch.

    Args:
        field: name used in errors.
        value: initial value.
        low, high: bounds.
        log: bijection on a log scale (widths) instead of a linear one (positions).
        learnable: a `nn.Parameter`, or a buffer that `parameters()` does not list.

    Raises:
        InputError: the initial value is not strictly between the bounds.
    """

    raw: Tensor

    def __init__(
        self, field: str, value: Any, low: float, high: float, *, log: bool = False, learnable: bool = True
    ) -> None:
        super().__init__()
        tensor = as_real(field, value).detach().clone()
        self.low, self.high, self.log, self.learnable = low, high, log, learnable
        raw = to_raw(field, tensor, low, high, log)
        if learnable:
            self.raw = nn.Parameter(raw)
        else:
            self.register_buffer("raw", raw)

    def forward(self, context: Context | None = None) -> Tensor:
        """The value, in the dtype of the context if one is given."""
        value = from_raw(self.raw, self.low, self.high, self.log)
        return value if context is None else value.to(context.dtype)

    def own_constrained(self) -> Constrained:
        """What this module adds to `constrained()`."""
        return {"": (self(), self.low, self.high)} if self.learnable else {}


def constrained_values(module: nn.Module) -> Constrained:
    """All learnable values of a module tree by dotted name, with their bounds.

    Any submodule that has a method `own_constrained() -> dict` takes part; its names are prefixed by the path of the
    submodule.
    """
    found: Constrained = {}
    for path, child in module.named_modules():
        own = getattr(child, "own_constrained", None)
        if own is not None:
            for name, entry in own().items():
                found[".".join(part for part in (path, name) if part)] = entry
    return found


class Given(nn.Module):
    """A value that is not learned: a number, a tensor, or a function of the context, detached from any graph."""

    value: Tensor

    def __init__(self, field: str, value: float | Tensor | Callable[[Context], Tensor]) -> None:
        super().__init__()
        self.function: Callable[[Context], Tensor] | None = None
        if isinstance(value, Tensor) or not callable(value):
            tensor = as_real(field, value, torch.float64).detach().clone()
            self.register_buffer("value", check_finite(field, tensor))
        else:
            self.function = value

    def forward(self, context: Context) -> Tensor:
        """The value for these contexts, in their dtype and on their device."""
        value = self.value if self.function is None else self.function(context)
        return value.detach().to(context.theta_r)
