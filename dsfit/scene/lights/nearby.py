"""What lights at a finite distance share: where they are seen from, and the fibre frame there."""

from __future__ import annotations

from typing import Any, Self

import torch
from torch import Tensor

from dsfit.arguments import check_inside
from dsfit.errors import InputError, as_real, check_range
from dsfit.scene.lights.base import Light, check_rotation

MAX_LENGTH = 1e12
"""Coordinates and sizes of lights lie within this, sizes above its inverse: squares and quotients stay in range."""


def check_radiance(radiance: Any, field: str = "radiance") -> Tensor:
    """A radiance as a vector `[C]`; `InputError` unless it is finite and >= 0."""
    value = check_range(field, torch.atleast_1d(as_real(field, radiance)), 0.0)
    if value.dim() != 1 or value.numel() == 0:
        raise InputError(field, tuple(value.shape), "a number or a vector [C]")
    return value


def check_vector(field: str, vector: Any) -> Tensor:
    """Three coordinates `[3]` within +- MAX_LENGTH, else `InputError`."""
    value = check_range(field, as_real(field, vector), -MAX_LENGTH, MAX_LENGTH)
    if value.shape != (3,):
        raise InputError(field, tuple(value.shape), "three coordinates [x, y, z]")
    return value


def check_length(field: str, length: Any) -> Tensor:
    """One length in [1 / MAX_LENGTH, MAX_LENGTH], else `InputError`."""
    value = check_range(field, as_real(field, length), 1 / MAX_LENGTH, MAX_LENGTH)
    if value.dim():
        raise InputError(field, tuple(value.shape), "a single number")
    return value


class NearbyLight(Light):
    """A light that looks different from different points.

    Args:
        position: the points it is seen from, `[3]` or `[*batch, 3]`, in world coordinates within +- 1e12. None: the
            origin.
        rotation: see `Light`.
    """

    position: Tensor | None
    batched = {"rotation": 2, "position": 1}

    def __init__(self, rotation: Any = None, position: Any = None) -> None:
        super().__init__(rotation)
        self.register_buffer("position", _check_position(position))

    def placed(self, position: Tensor, rotation: Tensor) -> Self:
        return self._with_buffers(position=_check_position(position), rotation=check_rotation(rotation))

    def seen(self, point: Tensor) -> Tensor:
        """The vector from where the light is seen to a point of the world `[3]`, in the fibre frame: `[*batch, 3]`."""
        return self.to_fibre(point if self.position is None else point - self.position)

    def single_frame(self) -> None:
        super().single_frame()
        if self.position is not None and self.position.dim() > 1:
            raise InputError("position", tuple(self.position.shape), "one point to ask a light for its breakpoints")


def _check_position(position: Any) -> Tensor | None:
    if position is None:
        return None
    value = as_real("position", position)
    if value.shape[-1:] != (3,):
        raise InputError("position", tuple(value.shape), "shape [..., 3]")
    return check_inside("position", value, -MAX_LENGTH, MAX_LENGTH)
