"""A lock of straight hair."""

from __future__ import annotations

import math

import torch

from dsfit.render.geometry.build import (
    along,
    check_length,
    check_share,
    check_size,
    normal,
    seeded,
    smoothstep,
    to_strands,
    uniform,
)
from dsfit.render.geometry.clumps import clumped
from dsfit.render.geometry.noise import Field, wander
from dsfit.render.strands import Strands


def straight_bundle(
    seed: int = 0,
    strands: int = 4000,
    length: float = 12.0,
    width: float = 2.6,
    radius: float = 0.005,
    points: int = 48,
    flyaways: float = 0.025,
) -> Strands:
    """A hanging lock of straight hair that widens a little below its roots and runs to a pointed end.

    Centred in x and z, roots at y = length / 2. Unit: centimetres.

    Good camera: `suggested_view(strands, VIEWS["straight_bundle"])`, from the front.

    Args:
        seed: integer >= 0; the same seed gives the same strands.
        strands: how many, 1 to 1,000,000.
        length: of the lock.
        width: at the roots; the thickness is 0.4 of it.
        radius: mean fibre radius; strands vary by 10 percent and taper to a quarter at the tip.
        points: per strand.
        flyaways: share of the strands that stand off.

    Raises:
        InputError: an argument outside its range.
    """
    generator = seeded("straight_bundle", seed)
    strands, points = check_size("straight_bundle", strands, points)
    length = check_length("straight_bundle.length", length)
    width, radius = check_length("straight_bundle.width", width), check_length("straight_bundle.radius", radius)
    flyaways = check_share("straight_bundle.flyaways", flyaways)
    s = along(points)
    angle, out = uniform((strands, 1), generator, 0.0, 2.0 * math.pi), uniform((strands, 1), generator).sqrt()
    roots = torch.cat([width / 2 * out * angle.cos(), 0.2 * width * out * angle.sin()], -1)
    stray = uniform((strands, 1), generator) < flyaways
    # strands outside are cut shorter: that makes the end a point
    cut = length * (1.0 - 0.16 * out**2 - 0.30 * uniform((strands, 1), generator) ** 3)
    spread = 1.0 + 0.10 * smoothstep(s, 0.0, 0.4) - 0.62 * smoothstep(s, 0.45, 1.1)
    curves = torch.stack([roots[:, :1] * spread, length / 2 - cut * s, roots[:, 1:] * spread], -1)
    curves = clumped(curves, roots, max(1, strands // 45), 0.75, generator)
    # the whole lock swings a little, and its end turns up
    sway = 0.022 * length * torch.sin(1.5 * math.pi * s) - 0.03 * length * smoothstep(s, 0.6, 1.1)
    curves[..., 0] += sway
    curves[..., 2] += 0.02 * length * torch.sin(math.pi * s)
    field = Field(0.8 * length, generator)
    shared = 0.008 * length * (field(curves) - field(curves[:, :1]))
    loose = torch.where(stray, 5.0, 1.0)[..., None]
    own = 0.0024 * length * wander(strands, points, 1.2, generator) * loose
    tilt = 0.003 * length * normal((strands, 1, 3), generator) * s[:, None] * loose
    return to_strands(curves + shared + own + tilt, radius, generator, tip=0.25)
