"""The studio of configs/data: a dim room with four lamps, small and bright, as an equirectangular map.

    python experiments/studio_map.py configs/data/studio.exr

Rows go from straight up to straight down; column x looks towards longitude pi - 2 pi (x + 0.5) / width, measured from
+z towards +x, as `dsfit.EnvironmentLight` reads it.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import torch
from torch import Tensor

from dsfit.scene.exr import write_exr

HEIGHT, WIDTH = 128, 256
EDGE = 0.15
"""Part of a lamp's half width over which it fades."""
LAMPS = {
    "key, front right": (38.0, 24.0, 6.0, 9.0, (70.0, 66.0, 60.0)),
    "fill, left": (-65.0, 12.0, 9.0, 12.0, (10.0, 11.0, 13.0)),
    "rim, from behind": (160.0, 35.0, 5.0, 8.0, (60.0, 60.0, 64.0)),
    "top": (0.0, 80.0, 14.0, 14.0, (8.0, 8.0, 8.0)),
}
"""Azimuth from +z towards +x, elevation, half width and half height in degrees, and radiance."""


def directions() -> Tensor:
    """Unit vectors `[HEIGHT, WIDTH, 3]` of the pixels' middles."""
    latitude = (0.5 - (torch.arange(HEIGHT, dtype=torch.float64) + 0.5) / HEIGHT) * math.pi
    longitude = math.pi - (torch.arange(WIDTH, dtype=torch.float64) + 0.5) * (2 * math.pi / WIDTH)
    a, b = torch.meshgrid(latitude, longitude, indexing="ij")
    return torch.stack([a.cos() * b.sin(), a.sin(), a.cos() * b.cos()], -1)


def room(v: Tensor) -> Tensor:
    """A bluish grey, brighter above."""
    return (0.10 + 0.06 * v[..., 1:2]) * torch.tensor([0.95, 1.0, 1.08], dtype=v.dtype)


def lamp(v: Tensor, azimuth: float, elevation: float, wide: float, high: float, radiance: tuple[float, ...]) -> Tensor:
    """A softbox: a rectangle in angles around its middle."""
    azimuth, elevation = math.radians(azimuth), math.radians(elevation)
    flat = math.cos(elevation)
    middle = torch.tensor([flat * math.sin(azimuth), math.sin(elevation), flat * math.cos(azimuth)], dtype=v.dtype)
    right = torch.linalg.cross(torch.tensor([0.0, 1.0, 0.0], dtype=v.dtype), middle)
    right = right / right.norm()
    above, ahead = torch.linalg.cross(middle, right), v @ middle
    inside = (ahead > 0).to(v.dtype)
    for axis, half in ((right, wide), (above, high)):
        place = torch.atan2(v @ axis, ahead).abs() / math.radians(half)
        inside = inside * ((1 - place) / EDGE).clamp(0.0, 1.0)
    return inside.unsqueeze(-1) * torch.tensor(radiance, dtype=v.dtype)


def studio() -> Tensor:
    """Radiance `[HEIGHT, WIDTH, 3]`."""
    v = directions()
    return room(v) + sum(lamp(v, *numbers) for numbers in LAMPS.values())


if __name__ == "__main__":
    target = Path(sys.argv[1] if len(sys.argv) > 1 else "configs/data/studio.exr")
    target.parent.mkdir(parents=True, exist_ok=True)
    write_exr(target, {"RGB": studio().to(torch.float32)}, {"about": "a dim room with four lamps"})
