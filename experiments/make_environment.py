"""A studio as an equirectangular map: a soft gradient and a few small, very bright lamps; the same bytes at every run.

The map's convention is that of `dsfit.scene.lights.environment`: y up, row 0 at the top, longitude falling from pi to
-pi along a row. Run as `python experiments/make_environment.py [PATH]`.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import torch
from torch import Tensor

from dsfit.scene import write_exr

WIDTH, HEIGHT, SUPER = 256, 128, 8
"""Texels, and how many points a side of each is averaged over."""
TARGET = Path(__file__).resolve().parent.parent / "configs" / "data" / "studio.exr"

# latitude and longitude of the centre, angular diameter in degrees, radiance (RGB)
LAMPS = (
    (38.0, 52.0, 5.0, (900.0, 800.0, 640.0)),  # key, warm, to the upper left of +z
    (24.0, -68.0, 3.0, (420.0, 620.0, 950.0)),  # rim, blue, on the other side
    (62.0, 165.0, 2.0, (2600.0, 2500.0, 2300.0)),  # back, white, high behind
    (5.0, -140.0, 1.5, (2600.0, 700.0, 260.0)),  # practical lamp, orange, behind at eye level
    (-14.0, 108.0, 1.0, (350.0, 1500.0, 800.0)),  # green, from below
)
# a soft box: latitudes and longitudes between which it lies, radiance
BOXES = (((10.0, 34.0), (-28.0, -4.0), (4.0, 4.2, 4.6)),)


def studio(width: int = WIDTH, height: int = HEIGHT) -> Tensor:
    """Radiances `[height, width, 3]`, float64; lamps are averaged over texels, so that their power does not depend on
    the grid."""
    rows = (torch.arange(height * SUPER, dtype=torch.float64) + 0.5) / (height * SUPER)
    columns = (torch.arange(width * SUPER, dtype=torch.float64) + 0.5) / (width * SUPER)
    latitude, longitude = torch.meshgrid(90 - 180 * rows, 180 - 360 * columns, indexing="ij")
    image = gradient(latitude, longitude)
    for (low, high), (right, left), radiance in BOXES:
        soft = smooth(latitude, low, high, 3.0) * smooth(longitude, right, left, 3.0)
        image = image + soft[..., None] * torch.tensor(radiance, dtype=torch.float64)
    for lat, lon, diameter, radiance in LAMPS:
        inside = angle(latitude, longitude, lat, lon) <= diameter / 2
        image = image + inside[..., None] * torch.tensor(radiance, dtype=torch.float64)
    # texels near a pole: the mean over solid angle, not over latitude
    weight = torch.cos(torch.deg2rad(latitude))[..., None]
    blocks = (weight * image).reshape(height, SUPER, width, SUPER, 3).sum((1, 3))
    return blocks / weight.reshape(height, SUPER, width, SUPER, 1).sum((1, 3))


def gradient(latitude: Tensor, longitude: Tensor) -> Tensor:
    """Dim walls, a darker floor, a ceiling that is lighter towards +z."""
    up = torch.sin(torch.deg2rad(latitude))
    front = torch.cos(torch.deg2rad(longitude)) * torch.cos(torch.deg2rad(latitude))
    level = 0.10 + 0.08 * up + 0.04 * front
    tint = torch.stack([1.05 - 0.10 * up, torch.ones_like(up), 0.95 + 0.15 * up], dim=-1)
    return level[..., None] * tint


def smooth(value: Tensor, low: float, high: float, width: float) -> Tensor:
    """1 between low and high, 0 outside, with soft edges of this width."""
    step = ((value - low) / width).clamp(0, 1) * ((high - value) / width).clamp(0, 1)
    return step * step * (3 - 2 * step)


def angle(latitude: Tensor, longitude: Tensor, lat: float, lon: float) -> Tensor:
    """Degrees between directions."""
    a, b = torch.deg2rad(latitude), math.radians(lat)
    cosine = torch.sin(a) * math.sin(b) + torch.cos(a) * math.cos(b) * torch.cos(torch.deg2rad(longitude - lon))
    return torch.rad2deg(torch.acos(cosine.clamp(-1, 1)))


def main(path: Path = TARGET) -> Path:
    """Write the map in half floats."""
    path.parent.mkdir(parents=True, exist_ok=True)
    return write_exr(path, {"RGB": studio().to(torch.float16)}, {"comment": "experiments/make_environment.py"})


if __name__ == "__main__":
    print(main(*(Path(argument) for argument in sys.argv[1:2])))
