"""One clear error for bad input: it names the field, the value and what is allowed."""

from __future__ import annotations

import torch
from torch import Tensor


class InputError(ValueError):
    """Raised for input outside its domain.

    Args:
        field: the name of the offending argument or config key.
        value: the offending value (its `repr` is shown, shortened to 120 characters).
        allowed: what would have been accepted, in words.
    """

    def __init__(self, field: str, value: object, allowed: str) -> None:
        self.field, self.value, self.allowed = field, value, allowed
        shown = repr(value)
        shown = shown if len(shown) <= 120 else shown[:117] + "..."
        super().__init__(f"{field}: got {shown}; allowed: {allowed}")


def _first_bad(value: Tensor, bad: Tensor) -> float:
    return value.detach()[bad].flatten()[0].item()


def check_finite(field: str, value: Tensor) -> Tensor:
    """Return `value` if every element is finite, else raise `InputError`."""
    bad = ~torch.isfinite(value.detach())
    if bool(bad.any()):
        raise InputError(field, _first_bad(value, bad), "finite numbers")
    return value


def check_range(
    field: str,
    value: Tensor,
    low: float = -float("inf"),
    high: float = float("inf"),
    *,
    open_low: bool = False,
    open_high: bool = False,
) -> Tensor:
    """Return `value` if every element is finite and in [low, high] (ends excluded as asked), else raise `InputError`.
    """
    check_finite(field, value)
    data = value.detach()
    bad = (data <= low) if open_low else (data < low)
    bad = bad | ((data >= high) if open_high else (data > high))
    if bool(bad.any()):
        interval = f"{'(' if open_low else '['}{low:g}, {high:g}{')' if open_high else ']'}"
        raise InputError(field, _first_bad(value, bad), f"numbers in {interval}")
    return value


def check_choice(field: str, value: object, allowed: tuple[str, ...] | list[str]) -> str:
    """Return `value` if it is one of the allowed words, else raise `InputError`."""
    if value not in tuple(allowed):
        raise InputError(field, value, "one of " + ", ".join(map(repr, allowed)))
    return str(value)
