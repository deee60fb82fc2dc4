"""Where to look at strands from."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from dsfit.errors import InputError, as_number, as_real, check_finite
from dsfit.render.strands import Strands

FIELD_OF_VIEW = 30.0
"""Degrees: a short telephoto lens, as for portraits."""

VIEWS: dict[str, tuple[float, float, float]] = {
    "block": (0.9, 0.6, 1.0),
    "double_block": (0.2, 0.3, 1.0),
    "straight_bundle": (0.0, 0.05, 1.0),
    "wavy_bundle": (0.0, 0.05, 1.0),
    "curly_wisp": (0.0, 0.05, 1.0),
    "ball": (0.0, 0.15, 1.0),
}
"""Where to look from at what each generator makes: directions towards the camera, for `suggested_view`."""


def suggested_view(
    strands: Strands,
    direction: Sequence[float] | Tensor = (0.35, 0.25, 1.0),
    fov_deg: float = FIELD_OF_VIEW,
    margin: float = 1.06,
    aspect: float = 1.0,
) -> tuple[Tensor, Tensor, Tensor, float]:
    """A camera that sees all strands.

    Args:
        direction: from the strands towards the camera `[3]`, not straight up or down; the default is from the front, a
            little from the right and from above; `VIEWS` has one for each generator.
        fov_deg: full vertical angle of view, in (1, 150) degrees.
        margin: free space around the strands, as a factor >= 1 on their size in the picture.
        aspect: width / height of the picture.

    Returns:
        position `[3]`, target `[3]`, up `[3]` = (0, 1, 0), fov_deg. The target is the middle of the box around the
        strands; the position is as close as possible with every point inside the picture.
    """
    fov_deg = as_number("suggested_view.fov_deg", fov_deg, 1.0, 150.0, open_low=True, open_high=True)
    margin = as_number("suggested_view.margin", margin, 1.0, 100.0)
    aspect = as_number("suggested_view.aspect", aspect, 0.01, 100.0)
    back = check_finite("suggested_view.direction", as_real("suggested_view.direction", direction, torch.float64))
    up = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    if back.shape != (3,) or float(torch.linalg.cross(up, back).norm()) <= 1e-6 * float(back.norm()):
        raise InputError("suggested_view.direction", direction, "three numbers, not straight up or down and not all 0")
    back = back / back.norm()
    right = torch.linalg.cross(up, back)
    right = right / right.norm()
    low, high = (corner.double() for corner in strands.bounds)
    target = (low + high) / 2
    points = strands.points.double() - target
    wide = strands.radius.double()
    aside, above = (points @ right).abs() + wide, (points @ torch.linalg.cross(back, right)).abs() + wide
    reach = margin * torch.maximum(aside / aspect, above)
    # a point is inside if reach <= tan(fov / 2) (distance - depth towards the camera)
    distance = float((reach / math.tan(math.radians(fov_deg) / 2) + points @ back).max())
    return target + distance * back, target, up, fov_deg
