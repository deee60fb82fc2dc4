"""A curtain of wavy hair."""

from __future__ import annotations

import math

import torch

from dsfit.errors import as_number
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
from dsfit.render.geometry.clumps import clumped, nearest_centre
from dsfit.render.geometry.noise import Field, wander
from dsfit.render.strands import Strands


def wavy_bundle(
    seed: int = 0,
    strands: int = 8000,
    length: float = 14.0,
    width: float = 6.0,
    radius: float = 0.006,
    points: int = 90,
    waves: float = 3.5,
    flyaways: float = 0.02,
) -> Strands:
    """A hanging bundle, wide from left to right, whose locks wave together, each with its own phase.

    The waves set in below the straight roots at the top. Centred in x and z, roots at y = length / 2. Unit:
    centimetres.

    Good camera: `suggested_view(strands, VIEWS["wavy_bundle"])`, from the front.

    Args:
        seed: integer >= 0; the same seed gives the same strands.
        strands: how many, 1 to 1,000,000.
        length: of the bundle.
        width: at the roots; the thickness is 0.35 of it.
        radius: mean fibre radius; strands vary by 10 percent and taper to a quarter at the tip.
        points: per strand; take 20 or more per wave.
        waves: from root to tip, 0 to 50.
        flyaways: share of the strands that stand off.

    Raises:
        InputError: an argument outside its range.
    """
    generator = seeded("wavy_bundle", seed)
    strands, points = check_size("wavy_bundle", strands, points)
    length, width = check_length("wavy_bundle.length", length), check_length("wavy_bundle.width", width)
    radius = check_length("wavy_bundle.radius", radius)
    waves = as_number("wavy_bundle.waves", waves, 0.0, 50.0)
    flyaways = check_share("wavy_bundle.flyaways", flyaways)
    s = along(points)
    # roots in an ellipse
    angle, out = uniform((strands, 1), generator, 0.0, 2.0 * math.pi), uniform((strands, 1), generator).sqrt()
    roots = torch.cat([width / 2 * out * angle.cos(), 0.175 * width * out * angle.sin()], -1)
    stray = uniform((strands, 1), generator) < flyaways
    cut = length * (1.0 - 0.22 * uniform((strands, 1), generator) ** 2 - 0.08 * out**2)
    spread = 1.0 + 0.18 * smoothstep(s, 0.1, 0.7) - 0.38 * smoothstep(s, 0.65, 1.05)
    curves = torch.stack([roots[:, :1] * spread, length / 2 - cut * s, roots[:, 1:] * spread], -1)
    # locks wave with a phase that changes slowly from lock to lock, and strands with that of their lock, nearly
    locks = max(1, min(strands, 28))
    middle = roots[torch.randperm(strands, generator=generator)[:locks]]
    lock = nearest_centre(roots, middle)
    slow = Field(1.2 * width, generator)(torch.cat([middle, torch.zeros(locks, 1, dtype=middle.dtype)], -1))
    phase = 2.2 * slow[lock, :1] + 0.7 * normal((locks, 1), generator)[lock] + 0.22 * normal((strands, 1), generator)
    rate = waves * (1.0 + 0.06 * normal((locks, 1), generator)[lock] + 0.02 * normal((strands, 1), generator))
    turn = 2.0 * math.pi * rate * (s + 0.12 * s**2) + phase
    size = 0.055 * width * (1.0 + 0.25 * normal((locks, 1), generator)[lock] + 0.12 * normal((strands, 1), generator))
    grown = size * smoothstep(s, 0.02, 0.45) * (1.0 + 0.3 * s)
    swing = torch.stack([turn.sin(), 0.10 * (2.0 * turn).sin(), 0.8 * (turn + 1.3).sin()], -1)
    curves = clumped(curves, roots, max(1, strands // 70), 0.7, generator)
    curves = curves + grown[..., None] * swing
    field = Field(0.8 * length, generator)
    shared = 0.012 * length * (field(curves) - field(curves[:, :1]))
    own = 0.0028 * length * wander(strands, points, 2.5, generator) * torch.where(stray, 4.5, 1.0)[..., None]
    return to_strands(curves + shared + own, radius, generator, tip=0.25)
