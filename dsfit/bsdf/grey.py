"""One channel that stands for all of a fibre whose channels are equal."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from dsfit.bsdf.fiber import Fiber
from dsfit.errors import InputError
from dsfit.special import is_differentiated


def is_grey(fiber: Fiber) -> bool:
    """Whether all channels of sigma_a are equal, and nobody asks how they differ."""
    sigma_a = fiber.sigma_a
    return not is_differentiated(sigma_a) and bool((sigma_a == sigma_a[..., :1]).all())


def first_channel(fiber: Fiber) -> Fiber:
    """The fibre with its first channel alone.

    Raises:
        InputError: channels differ, or a derivative in one of them is asked for.
    """
    if not is_grey(fiber):
        raise InputError("terms.grey", True, "False where channels of sigma_a differ or are differentiated")
    return fiber.replace(sigma_a=fiber.sigma_a[..., :1])


def one_channel(method: Callable[..., Any]) -> Callable[..., Any]:
    """Of a BSDF's method with results `[..., C]`: asked of its one-channel form, if it has one, and expanded."""

    @functools.wraps(method)
    def wrapped(self: Any, *args: Any, **kwargs: Any) -> Any:
        grey = getattr(self, "_grey", None)
        if grey is None:
            return method(self, *args, **kwargs)
        return _expanded(getattr(grey, method.__name__)(*args, **kwargs), self.channels)

    return wrapped


def _expanded(value: Any, channels: int) -> Any:
    if isinstance(value, torch.Tensor):
        return value.expand(*value.shape[:-1], channels)
    if isinstance(value, tuple):
        return tuple(_expanded(part, channels) for part in value)
    parts: dict[str, Tensor] = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    return type(value)(**{name: _expanded(part, channels) for name, part in parts.items()})
