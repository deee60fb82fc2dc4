"""The hair ball: a round head of hair, combed down from a crown."""

from __future__ import annotations

import math

import torch
from torch import Tensor

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
from dsfit.render.geometry.clumps import clumped
from dsfit.render.geometry.noise import Field, wander
from dsfit.render.strands import Strands


def ball(
    seed: int = 0,
    strands: int = 16000,
    size: float = 5.0,
    radius: float = 0.005,
    points: int = 40,
    swirl: float = 0.35,
    flyaways: float = 0.02,
) -> Strands:
    """Strands rooted all over a sphere and combed around it, from a crown on top, tilted forward, to the bottom.

    Strands rooted near the crown lie over those rooted below, in a coat whose outer diameter is about `size`; it shows
    the ring of highlights that combed hair has under a light from above. Centred at the origin. Unit: centimetres.

    Good camera: `suggested_view(strands, VIEWS["ball"])`, from straight ahead, a little from above.

    Args:
        seed: integer >= 0; the same seed gives the same strands.
        strands: how many, 1 to 1,000,000.
        size: outer diameter of the coat; the sphere of the roots has 0.72 of it.
        radius: mean fibre radius; strands vary by 10 percent and taper to a quarter at the tip.
        points: per strand.
        swirl: turns around the axis that a strand makes on its way from crown to bottom, -3 to 3.
        flyaways: share of the strands that leave the coat.

    Raises:
        InputError: an argument outside its range.
    """
    generator = seeded("ball", seed)
    strands, points = check_size("ball", strands, points)
    size, radius = check_length("ball.size", size), check_length("ball.radius", radius)
    swirl = as_number("ball.swirl", swirl, -3.0, 3.0)
    flyaways = check_share("ball.flyaways", flyaways)
    s = along(points)
    inner, outer = 0.36 * size, 0.5 * size
    # roots uniform on the sphere: polar angle from the crown, azimuth
    polar = torch.acos(uniform((strands, 1), generator, -0.97, 1.0))
    azimuth = uniform((strands, 1), generator, 0.0, 2.0 * math.pi)
    roots = _on_sphere(polar, azimuth)[:, 0]
    stray = uniform((strands, 1), generator) < flyaways
    arc = uniform((strands, 1), generator, 0.75, 1.15) * (0.9 + 0.25 * math.pi - 0.15 * polar)
    arc = torch.minimum(arc, 0.97 * math.pi - polar + 0.25)  # none gathers beyond the bottom
    arc = torch.where(stray, 0.6 * arc, arc)
    theta = polar + arc * s
    phi = azimuth + 2.0 * math.pi * swirl * arc / math.pi * s
    # The coat: thickest for strands that have come furthest, each in its own layer.
    layer = uniform((strands, 1), generator, 0.15, 1.0).sqrt()
    lift = layer * smoothstep(s, 0.0, 0.5) * (0.55 + 0.45 * smoothstep(arc, 0.2, 1.2))
    lift = lift + stray * 0.9 * s**2 * uniform((strands, 1), generator, 0.1, 0.5)
    distance = inner + (outer - inner) * 0.95 * lift
    curves = distance[..., None] * _on_sphere(theta, phi)
    field = Field(0.5 * size, generator)
    curves = curves + 0.018 * size * (field(curves) - field(curves[:, :1])) * s[:, None]
    curves = clumped(curves, roots, max(1, strands // 50), 0.6, generator)
    own = 0.006 * size * wander(strands, points, 1.2, generator)
    curves = curves + own * torch.where(stray, 3.0, 1.0)[..., None]
    tilt = 0.12 * normal((1,), generator).item()
    return to_strands(_tilted(curves, 0.45, tilt), radius, generator, tip=0.25)


def _on_sphere(polar: Tensor, azimuth: Tensor) -> Tensor:
    """Unit vectors `[..., 3]` at polar angles from the crown (0, 1, 0)."""
    return torch.stack([polar.sin() * azimuth.cos(), polar.cos(), polar.sin() * azimuth.sin()], -1)


def _tilted(curves: Tensor, forward: float, sideways: float) -> Tensor:
    """Curves turned about x by `forward`, then about z by `sideways` (radians): the crown is then seen from ahead."""
    c, s = math.cos(forward), math.sin(forward)
    d, t = math.cos(sideways), math.sin(sideways)
    about_x = torch.tensor([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]], dtype=curves.dtype)
    about_z = torch.tensor([[d, -t, 0.0], [t, d, 0.0], [0.0, 0.0, 1.0]], dtype=curves.dtype)
    return curves @ (about_z @ about_x).T
