"""The block of hair: a cube filled with nearly parallel strands."""

from __future__ import annotations

import torch

from dsfit.errors import as_number
from dsfit.render.geometry.build import (
    along,
    check_length,
    check_share,
    check_size,
    normal,
    seeded,
    to_strands,
    uniform,
)
from dsfit.render.geometry.clumps import clumped
from dsfit.render.geometry.noise import Field, wander
from dsfit.render.strands import Strands


def block(
    seed: int = 0,
    strands: int = 6000,
    side: float = 5.0,
    radius: float = 1.0 / 120.0,
    points: int = 24,
    disorder: float = 1.0,
    flyaways: float = 0.01,
) -> Strands:
    """A cube of hanging strands, roots at the top face, centred at the origin.

    A line straight through, across the strands, meets on average n = strands x 2 radius / side of them: 5 for 1,500
    strands and 40 for 12,000 with the other defaults. Unit: centimetres; the fibres are then about twice as thick as
    human hair, so that these numbers of strands give the scatter counts of a head.

    Good camera: `suggested_view(strands, VIEWS["block"])`, from the right, above and in front.

    Args:
        seed: integer >= 0; the same seed gives the same strands.
        strands: how many, 1 to 1,000,000.
        side: of the cube.
        radius: mean fibre radius; strands vary by 10 percent, and do not taper (they are cut).
        points: per strand.
        disorder: 0 gives straight parallel strands at random places; 1 hair-like bends, tilts and locks; up to 5.
        flyaways: share of the strands with bends several times as strong.

    Raises:
        InputError: an argument outside its range.
    """
    generator = seeded("block", seed)
    strands, points = check_size("block", strands, points)
    side, radius = check_length("block.side", side), check_length("block.radius", radius)
    disorder = as_number("block.disorder", disorder, 0.0, 5.0)
    flyaways = check_share("block.flyaways", flyaways)
    roots = uniform((strands, 2), generator, -side / 2, side / 2)
    cut = side * uniform((strands, 1), generator, 0.97, 1.0)
    curves = torch.empty(strands, points, 3, dtype=torch.float64)
    s = along(points)
    curves[..., 0], curves[..., 2] = roots[:, :1], roots[:, 1:]
    curves[..., 1] = side / 2 - cut * s
    if disorder:
        bend = torch.tensor([1.0, 0.15, 1.0], dtype=torch.float64) * side * disorder
        stray = (uniform((strands, 1, 1), generator) < flyaways) * 4.0 + 1.0
        tilt = 0.010 * normal((strands, 1, 3), generator) * s[:, None]
        own = 0.006 * wander(strands, points, 1.5, generator)
        field = Field(1.4 * side, generator)
        shared = 0.018 * (field(curves) - field(curves[:, :1]))
        curves = clumped(curves, roots, max(1, strands // 60), min(1.0, 0.45 * disorder), generator)
        curves = curves + bend * (stray * (tilt + own) + shared)
    return to_strands(curves, radius, generator)
