"""Tangents at the points of strands, and normals carried along them."""

from __future__ import annotations

import torch
from torch import Tensor

from dsfit.render.strands import Strands

_TURNED = 1e-9
"""Least length of a sum of unit vectors that still has a direction: below it they are opposite."""


def unit(vector: Tensor, other: Tensor) -> Tensor:
    """`vector / |vector|` over the last axis; `other` where the vector has no direction."""
    length = vector.norm(dim=-1, keepdim=True)
    return torch.where(length > _TURNED, vector / length.clamp_min(_TURNED), other)


def perpendicular(tangent: Tensor) -> Tensor:
    """A unit vector `[..., 3]` perpendicular to each unit tangent: towards the coordinate axis farthest from it."""
    axis = torch.nn.functional.one_hot(tangent.abs().argmin(-1), 3).to(tangent.dtype)
    rest = axis - (axis * tangent).sum(-1, keepdim=True) * tangent
    return rest / rest.norm(dim=-1, keepdim=True)


def point_tangents(strands: Strands) -> Tensor:
    """Unit tangents `[P, 3]` from root to tip: those of the parabola through a point and its two neighbours.

    The error falls with the square of the spacing, at the ends of strands too. Where points coincide the direction of
    the segment before carries on.
    """
    points, first, starts = strands.points, strands.first, strands.starts
    chord = points[starts + 1] - points[starts]
    length = chord.norm(dim=-1, keepdim=True)
    direction = _filled(chord / torch.where(length > 0, length, 1.0), (length > 0).squeeze(-1), strands)
    tangent = torch.zeros_like(points)
    inner = starts[:-1][starts.diff() == 1] + 1  # points between two segments of the same strand
    before = torch.nonzero(starts.diff() == 1).flatten()
    share = length[before] / (length[before] + length[before + 1]).clamp_min(torch.finfo(points.dtype).tiny)
    middle = direction[before] * (1 - share) + direction[before + 1] * share
    tangent[inner] = unit(middle, direction[before])
    segment = torch.zeros(len(points), dtype=torch.long)
    segment[starts] = torch.arange(len(starts))
    for end, near, own in (
        (first[:-1], first[:-1] + 1, segment[first[:-1]]),
        (first[1:] - 1, first[1:] - 2, segment[first[1:] - 2]),
    ):
        single = (first.diff() == 2).unsqueeze(-1)
        there = torch.where(single, direction[own], tangent[near])
        mirrored = 2 * (direction[own] * there).sum(-1, keepdim=True) * direction[own] - there
        tangent[end] = unit(mirrored, direction[own])
    return tangent


def _filled(direction: Tensor, known: Tensor, strands: Strands) -> Tensor:
    """Directions of segments without length: of the last one before in the strand that has some, else of the next."""
    if bool(known.all()):
        return direction
    count = torch.arange(len(direction))
    begin = strands.first[:-1] - torch.arange(len(strands))  # a strand's first segment
    strand = torch.repeat_interleave(torch.arange(len(strands)), strands.first.diff() - 1)
    last = torch.where(known, count, -1).cummax(0).values
    following = torch.where(known, count, len(count)).flip(0).cummin(0).values.flip(0)
    end = (begin + strands.first.diff() - 1)[strand]
    source = torch.where(last >= begin[strand], last, torch.where(following < end, following, -1))
    anywhere = torch.tensor([0.0, 1.0, 0.0], dtype=direction.dtype)
    return torch.where((source >= 0).unsqueeze(-1), direction[source.clamp_min(0)], anywhere)


def carried_normals(strands: Strands, tangent: Tensor) -> Tensor:
    """Unit normals `[P, 3]`: any at the root, then turned by the least rotation from each tangent to the next.

    This is parallel transport, so the axes of a fibre whose section is not round do not spin about it.
    """
    order = strands.first.diff().argsort(descending=True)
    first, count = strands.first[:-1][order], strands.first.diff()[order]
    normal = torch.empty_like(tangent)
    normal[first] = perpendicular(tangent[first])
    still = [int(x) for x in (count.unsqueeze(0) > torch.arange(1, int(count[0])).unsqueeze(-1)).sum(-1)]
    for step, left in enumerate(still):
        here = first[:left] + step
        normal[here + 1] = turned(normal[here], tangent[here], tangent[here + 1])
    return normal


def turned(normal: Tensor, source: Tensor, target: Tensor) -> Tensor:
    """A normal of unit tangent `source`, turned by the least rotation that brings `source` to `target`.

    `n - (target.n) / (1 + source.target) (source + target)`; between opposite tangents it stays as it is.
    """
    both = 1 + (source * target).sum(-1, keepdim=True)
    rotated = normal - (target * normal).sum(-1, keepdim=True) / both.clamp_min(_TURNED) * (source + target)
    return upright(torch.where(both > _TURNED, rotated, normal), target)


def upright(normal: Tensor, tangent: Tensor) -> Tensor:
    """Unit vectors: the part of `normal` perpendicular to the unit tangent, orthogonal to rounding."""
    for _ in range(2):  # the second pass removes what the first left by rounding
        normal = normal - (normal * tangent).sum(-1, keepdim=True) * tangent
        length = normal.norm(dim=-1, keepdim=True)
        if bool((length > _TURNED).all()):
            normal = normal / length
        else:
            normal = unit(normal, perpendicular(tangent))
    return normal
