"""Fibres into voxels: every segment is cut at the faces it passes, and each piece goes to its voxel."""

from __future__ import annotations

import torch
from torch import Tensor

from dsfit.render.strands import Strands

_AT_ONCE = 1 << 18  # segments

COMPONENTS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
"""Rows and columns of the six numbers of a symmetric tensor."""


def deposit(strands: Strands, low: Tensor, voxel: float, counts: tuple[int, int, int]) -> Tensor:
    """T = sum of 2 r l t t^T / V over the pieces of fibre in each voxel: `[X, Y, Z, 6]` float64, per unit length.

    Pieces are cut exactly at voxel faces; the radius runs linearly along a segment, so that the trace times the
    voxel's volume, summed over voxels, is the sum of length x mean diameter of all segments.
    """
    points = (strands.points.to(torch.float64) - low) / voxel
    radius = strands.radius.to(torch.float64)
    size = torch.tensor(counts)
    out = torch.zeros(counts[0] * counts[1] * counts[2], 6, dtype=torch.float64)
    for starts in strands.starts.split(_AT_ONCE):
        a, b = points[starts], points[starts + 1]
        segment, begin, end = _pieces(a, b)
        middle = (begin + end) / 2
        place = torch.lerp(a[segment], b[segment], middle[:, None])
        index = torch.minimum(place.long().clamp_min(0), size - 1)
        index = (index[:, 0] * size[1] + index[:, 1]) * size[2] + index[:, 2]
        along = b - a
        length = along.norm(dim=-1)
        tangent = along / torch.where(length > 0, length, 1.0)[:, None]
        outer = torch.stack([tangent[:, i] * tangent[:, j] for i, j in COMPONENTS], dim=-1)
        wide = torch.lerp(radius[starts][segment], radius[starts + 1][segment], middle)
        weight = 2 * wide * (end - begin) * length[segment] * (voxel / voxel**3)
        out.index_add_(0, index, weight[:, None] * outer[segment])
    return out.reshape(*counts, 6)


def _pieces(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Which segment `[Q]` each piece belongs to, and where it begins and ends on it, in [0, 1].

    a and b are in voxels: faces are the whole numbers.
    """
    count = len(a)
    own = torch.arange(count)
    cuts, owners = [a.new_zeros(count), a.new_ones(count)], [own, own]
    for axis in range(3):
        first, last = torch.minimum(a[:, axis], b[:, axis]), torch.maximum(a[:, axis], b[:, axis])
        low = torch.floor(first)
        passed = (torch.ceil(last) - low - 1).clamp_min(0).long()
        owner = own.repeat_interleave(passed)
        turn = torch.arange(len(owner)) - (passed.cumsum(0) - passed)[owner]
        face = low[owner] + 1 + turn
        cut = (face - a[owner, axis]) / (b[owner, axis] - a[owner, axis])
        cuts.append(cut.clamp(0.0, 1.0))
        owners.append(owner)
    cut, owner = torch.cat(cuts), torch.cat(owners)
    order = torch.argsort(cut)
    order = order[torch.argsort(owner[order], stable=True)]
    cut, owner = cut[order], owner[order]
    same = owner[1:] == owner[:-1]
    return owner[1:][same], cut[:-1][same], cut[1:][same]
