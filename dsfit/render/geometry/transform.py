"""Strands moved, scaled, thickened, thinned out, joined."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from dsfit.errors import InputError, as_number, as_real, check_finite
from dsfit.render.geometry.build import check_count, check_length
from dsfit.render.strands import Strands


def _vector(field: str, value: Sequence[float] | Tensor, like: Tensor) -> Tensor:
    vector = check_finite(field, as_real(field, value, like.dtype))
    if vector.shape != (3,):
        raise InputError(field, tuple(vector.shape), "three numbers")
    return vector


def translated(strands: Strands, by: Sequence[float] | Tensor) -> Strands:
    """The strands moved by a vector `[3]`."""
    return replace(strands, points=strands.points + _vector("translated.by", by, strands.points))


def scaled(strands: Strands, factor: float) -> Strands:
    """Points and radii times a factor > 0, about the origin: the scatter counts stay as they are."""
    factor = as_number("scaled.factor", factor, 0.0, open_low=True)
    return replace(strands, points=strands.points * factor, radius=strands.radius * factor)


def fitted_into(strands: Strands, size: float | Sequence[float]) -> Strands:
    """The strands scaled and moved so that their box, radii included, is centred at the origin and just fits.

    Args:
        size: of the box to fill, > 0: one number for a cube, or three. One factor scales all axes and the radii.
    """
    low, high = strands.bounds
    box = as_real("fitted_into.size", size, strands.points.dtype).expand(3) if _is_number(size) else _vector(
        "fitted_into.size", size, strands.points
    )
    if not bool((box > 0).all()) or not bool(torch.isfinite(box).all()):
        raise InputError("fitted_into.size", size, "one number or three, > 0")
    factor = float((box / (high - low)).min())
    return scaled(translated(strands, -(low + high) / 2), factor)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) or (isinstance(value, Tensor) and value.ndim == 0)


def with_radius(strands: Strands, radius: float) -> Strands:
    """The strands with this radius at every point."""
    return replace(strands, radius=torch.full_like(strands.radius, check_length("with_radius.radius", radius)))


def subsampled(strands: Strands, every: int, *, keep: str = "counts") -> Strands:
    """Every k-th strand, the first included.

    Args:
        every: k >= 1.
        keep: what the change of radius keeps: `counts`: radii times k, so the expected number of fibres that a line
            crosses, length density x 2 radius x sin(angle), stays; `volume`: radii times sqrt(k); `radius`: as it is.
    """
    every = check_count("subsampled.every", every, 1, max(1, len(strands)))
    factors = {"counts": float(every), "volume": math.sqrt(every), "radius": 1.0}
    if keep not in factors:
        raise InputError("subsampled.keep", keep, "one of " + ", ".join(map(repr, factors)))
    counts = strands.first.diff()
    taken = torch.arange(len(strands)) % every == 0
    points = torch.repeat_interleave(taken, counts)
    first = torch.cat([strands.first[:1], counts[taken].cumsum(0)])
    return Strands(strands.points[points], first, strands.radius[points] * factors[keep])


def turned_up(strands: Strands, up: str) -> Strands:
    """Strands from a world in which the axis `up` ("x", "y" or "z", or "-x", ...) points up, rotated to y up.

    The rotation permutes the axes cyclically (and, for a negative axis, turns by half about x first), so that
    right-handed worlds stay right-handed.
    """
    allowed = ("x", "y", "z", "-x", "-y", "-z")
    if up not in allowed:
        raise InputError("up", up, "one of " + ", ".join(map(repr, allowed)))
    axis = "xyz".index(up[-1])
    order = [(axis + 2) % 3, axis, (axis + 1) % 3]
    points = strands.points[:, order]
    if up[0] == "-":
        points = points * torch.tensor([1.0, -1.0, -1.0], dtype=points.dtype)
    return replace(strands, points=points.contiguous())


def joined(parts: Sequence[Strands]) -> Strands:
    """All strands of several sets, one set after another."""
    if not parts:
        raise InputError("joined.parts", [], "at least one set of strands")
    counts = torch.cat([part.first.diff() for part in parts])
    first = torch.cat([torch.zeros(1, dtype=torch.int64), counts.cumsum(0)])
    return Strands(torch.cat([p.points for p in parts]), first, torch.cat([p.radius for p in parts]))
