"""A pinhole camera."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from dsfit.errors import InputError, as_number, as_real, check_finite

_PARALLEL = 1e-6
"""Least sine of the angle between `up` and the view: below it the image's vertical is not determined."""


class Camera:
    """Pinhole camera; the world is right-handed, the image's rows go down and its columns to the right.

    Args:
        position: `[3]`, of the pinhole.
        target: `[3]`, a point in the middle of the image.
        up: `[3]`, a direction that shows upwards in the image; any but that of the view.
        fov_deg: vertical field of view in degrees, in (0, 180): from the upper edge of the image to the lower one.
        width, height: of the image, in pixels; pixels are square.

    Everything is computed in float64.

    Raises:
        InputError: not three finite numbers, target = position, up parallel to the view, fov_deg or a size out of
            range.
    """

    def __init__(
        self, position: Sequence[float] | Tensor, target: Sequence[float] | Tensor,
        up: Sequence[float] | Tensor = (0.0, 1.0, 0.0), *, fov_deg: float = 30.0, width: int = 256, height: int = 256,
    ) -> None:  # fmt: skip
        self.position = _point("camera.position", position)
        target, up = _point("camera.target", target), _point("camera.up", up)
        view = target - self.position
        if not bool(view.abs().max() > 0):
            raise InputError("camera.target", target.tolist(), "a point other than camera.position")
        if not bool(up.abs().max() > 0):
            raise InputError("camera.up", up.tolist(), "a direction, not the zero vector")
        view, up = _unit(view), _unit(up)
        right = torch.linalg.cross(view, up)
        if not float(right.norm()) > _PARALLEL:
            raise InputError("camera.up", up.tolist(), "a direction that is not parallel to the view")
        right = _unit(right)
        self.axes = torch.stack([right, torch.linalg.cross(right, view), view])
        """Rows: right, up and forward, unit vectors `[3, 3]`; a point in camera axes is `axes @ (point - position)`."""
        self.fov_deg = as_number("camera.fov_deg", fov_deg, 0.0, 180.0, open_low=True, open_high=True)
        self.width, self.height = _size("camera.width", width), _size("camera.height", height)
        self._half = math.tan(math.radians(self.fov_deg) / 2)

    def rays(self, pixels: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """Origins and unit directions, both `[*batch, 3]` float64, of rays through given places of given pixels.

        Args:
            pixels: `[*batch]` integers, row * width + column, the upper left pixel first.
            u: `[*batch, 2]` in [0, 1]^2, place within the pixel: to the right, and downwards.

        Raises:
            InputError: pixels that the image does not have, or places outside the pixel.
        """
        if pixels.is_floating_point() or pixels.is_complex():
            raise InputError("pixels", pixels.dtype, "integers")
        if pixels.numel() and not (0 <= int(pixels.min()) and int(pixels.max()) < self.width * self.height):
            raise InputError("pixels", [int(pixels.min()), int(pixels.max())], f"0 to {self.width * self.height - 1}")
        if u.shape[-1:] != (2,) or u.shape[:-1] != pixels.shape:
            raise InputError("u", tuple(u.shape), f"shape {(*pixels.shape, 2)}")
        if u.numel() and not (0 <= float(u.min()) and float(u.max()) <= 1):
            raise InputError("u", [float(u.min()), float(u.max())], "numbers in [0, 1]")
        x = (pixels % self.width + u[..., 0]) * (2 / self.height) - self.width / self.height
        y = 1 - (pixels // self.width + u[..., 1]) * (2 / self.height)
        right, up, view = self.axes
        direction = view + self._half * (x.unsqueeze(-1) * right + y.unsqueeze(-1) * up)
        return self.position.expand(direction.shape), direction / direction.norm(dim=-1, keepdim=True)

    def solid_angle(self, pixels: Tensor) -> Tensor:
        """Solid angle `[*batch]` in steradian of pixels, by the value in their middle: `A cos^3(angle to the view)`."""
        middle = torch.full((*pixels.shape, 2), 0.5, dtype=torch.float64)
        cosine = self.rays(pixels, middle)[1] @ self.axes[2]
        return (2 * self._half / self.height) ** 2 * cosine**3


def _point(field: str, value: Any) -> Tensor:
    point = as_real(field, value, torch.float64, torch.device("cpu"))
    if point.shape != (3,):
        raise InputError(field, tuple(point.shape), "three numbers")
    return check_finite(field, point).detach().clone()


def _unit(vector: Tensor) -> Tensor:
    vector = vector / vector.abs().max()  # squares of very large or small components would leave the range
    return vector / vector.norm()


def _size(field: str, value: object) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or value < 1:
        raise InputError(field, value, "a whole number of pixels >= 1")
    return value
