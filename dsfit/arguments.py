"""Checks of what is evaluated over and over, directions and uniforms: one pass over the numbers, and one clear error.

Under `torch.func` transforms the numbers cannot be asked for, and only shapes and dtypes are checked.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from contextvars import ContextVar

import torch
from torch import Tensor

from dsfit.errors import FLOATS, InputError, check_finite, check_range
from dsfit.special import is_wrapped


def all_finite(value: Tensor) -> bool:
    """Whether every element is finite; True where a transform hides them. By the sum, in one pass, in all but odd
    cases."""
    value = value.detach()
    if is_wrapped(value) or not value.numel():
        return True
    return bool(torch.isfinite(value.sum())) or bool(torch.isfinite(value).all())


def check_inside(field: str, value: Tensor, low: float, high: float) -> Tensor:
    """`check_range` in one pass; takes everything where a transform hides the numbers."""
    data = value.detach()
    if is_wrapped(data) or not data.numel():
        return value
    least, most = (float(x) for x in torch.aminmax(data))
    inside = low <= least and most <= high and -torch.inf < least and most < torch.inf
    return value if inside else check_range(field, value, low, high)


_CHECKED: ContextVar[Tensor | None] = ContextVar("checked", default=None)


@contextlib.contextmanager
def checked(value: Tensor) -> Iterator[None]:
    """Inside, this very tensor is taken as finite: a mixture looks at it once, not once for every component."""
    token = _CHECKED.set(value)
    try:
        yield
    finally:
        _CHECKED.reset(token)


def check_directions(omega: Tensor, batch: Sequence[int] = (), field: str = "omega") -> Tensor:
    """Return directions (theta, phi) `[*samples, *batch, 2]`.

    Raises:
        InputError: not a float64 or float32 tensor, another last dimension, leading dimensions that do not broadcast
            with the batch, or an angle that is not finite.
    """
    if not isinstance(omega, Tensor) or omega.dtype not in FLOATS:
        raise InputError(field, getattr(omega, "dtype", omega), "a float64 or float32 tensor")
    if omega.ndim == 0 or omega.shape[-1] != 2 or _broadcast(omega.shape[:-1], batch) is None:
        raise InputError(field, tuple(omega.shape), f"shape {_shape(batch, 2)}: (theta, phi) for each context")
    return omega if omega is _CHECKED.get() or all_finite(omega) else check_finite(field, omega)


def check_uniforms(u: Tensor, dimension: int, batch: Sequence[int] = (), field: str = "u") -> Tensor:
    """Return uniforms `[*samples, *batch, k]`, k >= dimension, with 0 and 1 themselves moved into the open interval.

    A generator may return an exact 0 (one in 2^24 of torch's float32 numbers is): it becomes eps / 4, and 1 becomes
    1 - eps / 2.

    Raises:
        InputError: not a float64 or float32 tensor, too few numbers per direction, dimensions before the last that do
            not end with those of the batch, or a number outside [0, 1].
    """
    if not isinstance(u, Tensor) or u.dtype not in FLOATS:
        raise InputError(field, getattr(u, "dtype", u), "a float64 or float32 tensor")
    if u.ndim == 0 or u.shape[-1] < dimension or _broadcast(u.shape[:-1], batch) != u.shape[:-1]:
        raise InputError(field, tuple(u.shape), f"shape {_shape(batch, dimension)}: {dimension} uniforms a direction")
    data = u.detach()
    if is_wrapped(data) or not data.numel():
        return u
    low, high = (float(x) for x in torch.aminmax(data))
    if not (low >= 0 and high <= 1):
        raise InputError(field, low if not low >= 0 else high, "numbers in (0, 1)")
    if low > 0 and high < 1:
        return u
    eps = torch.finfo(u.dtype).eps
    # Only these two: what the others become must not depend on the company they are drawn in.
    return torch.where(u == 0, eps / 4, torch.where(u == 1, 1 - eps / 2, u))


def _broadcast(a: Sequence[int], b: Sequence[int]) -> torch.Size | None:
    if not len(b) or tuple(a[-len(b) :]) == tuple(b):  # torch's own answer takes 40 microseconds
        return torch.Size(a)
    try:
        return torch.broadcast_shapes(a, b)
    except RuntimeError:
        return None


def _shape(batch: Sequence[int], last: int) -> str:
    return "[" + ", ".join(map(str, ["*samples", *batch, last])) + "]"
