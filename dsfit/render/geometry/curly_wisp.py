"""A wisp of curly hair."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from dsfit.errors import as_number
from dsfit.render.geometry.build import (
    along,
    check_count,
    check_length,
    check_share,
    check_size,
    normal,
    seeded,
    smoothstep,
    to_strands,
    uniform,
)
from dsfit.render.geometry.noise import wander
from dsfit.render.strands import Strands


def curly_wisp(
    seed: int = 0,
    strands: int = 2500,
    length: float = 10.0,
    curl: float = 0.55,
    radius: float = 0.005,
    points: int = 160,
    turns: float = 6.0,
    ringlets: int = 9,
    flyaways: float = 0.03,
) -> Strands:
    """A few hanging ringlets: the strands of each wind together around its axis, some to the left, some to the right.

    Centred in x and z, roots at y = length / 2. Unit: centimetres.

    Good camera: `suggested_view(strands, VIEWS["curly_wisp"])`, from the front.

    Args:
        seed: integer >= 0; the same seed gives the same strands.
        strands: how many, 1 to 1,000,000, shared out evenly.
        length: of the wisp.
        curl: radius of the curls.
        radius: mean fibre radius; strands vary by 10 percent and taper to a quarter at the tip.
        points: per strand; take 20 or more per turn.
        turns: of a curl from root to tip, 0 to 40.
        ringlets: how many, 1 to 1,000.
        flyaways: share of the strands that stand off.

    Raises:
        InputError: an argument outside its range.
    """
    generator = seeded("curly_wisp", seed)
    strands, points = check_size("curly_wisp", strands, points)
    length, curl = check_length("curly_wisp.length", length), check_length("curly_wisp.curl", curl)
    radius = check_length("curly_wisp.radius", radius)
    turns = as_number("curly_wisp.turns", turns, 0.0, 40.0)
    ringlets = check_count("curly_wisp.ringlets", ringlets, 1, 1_000)
    flyaways = check_share("curly_wisp.flyaways", flyaways)
    s = along(points)
    ringlet = torch.arange(strands) % ringlets
    stray = uniform((strands, 1), generator) < flyaways
    axis = _axes(ringlets, points, length, curl, generator)[ringlet]
    reach = 1.0 - 0.25 * uniform((ringlets, 1), generator)[ringlet] - 0.15 * uniform((strands, 1), generator) ** 2
    axis[..., 1] = length / 2 - length * reach * s
    # the curl of the ringlet, wider in the middle and tighter at the tip, and each strand's own departure from it
    side = torch.where(uniform((ringlets, 1), generator) < 0.5, -1.0, 1.0).double()[ringlet]
    start = uniform((ringlets, 1), generator, 0.0, 2.0 * math.pi)[ringlet] + 0.16 * normal((strands, 1), generator)
    rate = turns * (1.0 + 0.08 * normal((ringlets, 1), generator)[ringlet] + 0.008 * normal((strands, 1), generator))
    own = 1.0 + 0.12 * normal((strands, 1), generator)
    size = curl * own * (1.0 + 0.2 * normal((ringlets, 1), generator)[ringlet]) * smoothstep(s, 0.0, 0.25)
    size = size * (1.0 - 0.35 * smoothstep(s, 0.6, 1.0))
    turn = side * 2.0 * math.pi * rate * (s + 0.15 * s**2) + start
    helix = torch.stack([size * turn.cos(), torch.zeros_like(turn), size * turn.sin()], -1)
    # within the ringlet strands lie side by side in a band
    band = 0.14 * curl * normal((strands, 1, 3), generator) * (1.0 - 0.5 * s[:, None])
    band[..., 1] *= smoothstep(s, 0.0, 0.2)  # roots all at one height
    loose = 0.03 * curl * wander(strands, points, turns / 2, generator) * torch.where(stray, 7.0, 1.0)[..., None]
    return to_strands(axis + helix + band + loose, radius, generator, tip=0.25)


def _axes(ringlets: int, points: int, length: float, curl: float, generator: torch.Generator) -> Tensor:
    """The axes of the ringlets `[ringlets, points, 3]`: close together at the roots, apart below; heights are 0."""
    s = along(points)
    # evenly around the middle, by the golden angle, so that no two ringlets coincide
    order = torch.arange(ringlets, dtype=torch.float64)
    angle = order * math.pi * (3.0 - math.sqrt(5.0)) + uniform((1,), generator, 0.0, 2.0 * math.pi)
    out = curl * (order + 0.5).sqrt()
    spread = (0.35 + 0.65 * smoothstep(s, 0.0, 0.35)) * (1.0 - 0.15 * smoothstep(s, 0.6, 1.0))
    flat = torch.stack([1.1 * out * angle.cos(), torch.zeros_like(out), 0.7 * out * angle.sin()], -1)
    return flat[:, None] * spread[:, None] + 0.015 * length * wander(ringlets, points, 1.0, generator, waves=2)
