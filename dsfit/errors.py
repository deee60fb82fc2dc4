"""One clear error for bad input: it names the field, the value and what is allowed."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

FLOATS = (torch.float64, torch.float32)
"""The dtypes that everything is computed in."""


class InputError(ValueError):
    """Raised for input outside its domain.

    Args:
        field: the name of the offending argument or config key.
        value: the offending value (its `repr` is shown, shortened to 120 characters).
        allowed: what would have been accepted, in words.

    Example:
        >>> import dsfit
        >>> dsfit.Context(2.0)
        Traceback (most recent call last):
            ...
        dsfit.errors.InputError: context.theta_r: got 2.0; allowed: numbers in [-1.5708, 1.5708]
    """

    def __init__(self, field: str, value: object, allowed: str) -> None:
        self.field, self.value, self.allowed = field, value, allowed
        try:
            shown = repr(value)
        except (ValueError, RecursionError):  # an integer of thousands of digits, a table nested without end
            shown = "a value too long to show"
        shown = shown if len(shown) <= 120 else shown[:117] + "..."
        super().__init__(f"{field}: got {shown}; allowed: {allowed}")


def _first_bad(value: Tensor, bad: Tensor) -> float:
    return value.detach()[bad].flatten()[0].item()


def check_dtype(field: str, dtype: object) -> torch.dtype:
    """Return `dtype` if it is float64 or float32, else raise `InputError`."""
    if not isinstance(dtype, torch.dtype) or dtype not in FLOATS:
        raise InputError(field, dtype, "torch.float64 or torch.float32")
    return dtype


def common_dtype(field: str, dtype: object, values: tuple[Any, ...]) -> tuple[torch.dtype, torch.device | None]:
    """The dtype asked for or, left out, that of the first floating-point tensor, else float64; and that tensor's
    device."""
    given = [x for x in values if isinstance(x, Tensor) and x.is_floating_point()]
    if dtype is None:
        dtype = given[0].dtype if given else torch.float64
    return check_dtype(field, dtype), given[0].device if given else None


def as_real(
    field: str, value: Any, dtype: torch.dtype | None = None, device: torch.device | str | None = None
) -> Tensor:
    """`value` as a tensor of `dtype`; left out, tensors keep float64 and float32 and everything else becomes float64.

    Raises:
        InputError: no numbers, complex numbers, lists of unequal lengths, numbers beyond the range of floats.
    """
    if dtype is None:
        dtype = value.dtype if isinstance(value, Tensor) and value.dtype in FLOATS else torch.float64
    kind = getattr(getattr(value, "dtype", None), "kind", "f")  # of numpy arrays
    if (isinstance(value, Tensor) and value.is_complex()) or kind not in "biuf" or isinstance(value, str | bytes):
        raise InputError(field, value, "real numbers, a rectangular list of real numbers, or a tensor of them")
    try:
        return torch.as_tensor(value, dtype=dtype, device=device)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        allowed = "real numbers, a rectangular list of real numbers, or a tensor of them"
        raise InputError(field, value, allowed) from None


def as_number(field: str, value: Any, low: float = -float("inf"), high: float = float("inf"), **ends: bool) -> float:
    """A single number in a range, as a float; `ends` as for `check_range`."""
    number = check_range(field, as_real(field, value, torch.float64), low, high, **ends)
    if number.ndim:
        raise InputError(field, tuple(number.shape), "a single number")
    return float(number)


def check_broadcast(**values: Tensor) -> torch.Size:
    """The shape that the tensors broadcast to; `InputError` with all their shapes if they do not."""
    shapes = {value.shape for value in values.values() if value.ndim}
    if len(shapes) <= 1:  # nearly always; torch's own answer takes 40 microseconds
        return shapes.pop() if shapes else torch.Size()
    try:
        return torch.broadcast_shapes(*shapes)
    except RuntimeError:
        given = {name: tuple(value.shape) for name, value in values.items()}
        raise InputError(", ".join(values), given, "shapes that broadcast") from None


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
        raise InputError(field, _first_bad(value, bad), _interval(low, high, open_low, open_high))
    return value


def _interval(low: float, high: float, open_low: bool, open_high: bool) -> str:
    """The numbers of a range, in words."""
    if high == float("inf"):
        return f"numbers {'>' if open_low else '>='} {low:g}"
    if low == -float("inf"):
        return f"numbers {'<' if open_high else '<='} {high:g}"
    return f"numbers in {'(' if open_low else '['}{low:g}, {high:g}{')' if open_high else ']'}"


def check_choice(field: str, value: object, allowed: tuple[str, ...] | list[str]) -> str:
    """Return `value` if it is one of the allowed words, else raise `InputError`."""
    if not isinstance(value, str) or value not in allowed:
        raise InputError(field, value, "one of " + ", ".join(map(repr, allowed)))
    return str(value)
