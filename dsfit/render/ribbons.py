"""Strips as wide as the fibres that turn their flat side to a point, as triangles."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dsfit.render.strand_frames import perpendicular, unit
from dsfit.render.strands import Strands

CORNERS = torch.tensor([[0, 1, 3], [0, 3, 2]])
"""The two triangles of a segment; its corners are left and right at its first point, left and right at its second."""
_OFFSET = torch.tensor([-1.0, 1.0, -1.0, 1.0], dtype=torch.float64)
_ALONG = torch.tensor([0.0, 0.0, 1.0, 1.0], dtype=torch.float64)


@dataclass(frozen=True)
class Ribbons:
    """One strip per strand, seen from `center`; float64.

    A segment's strip lies along `m`, the normal of the plane through its axis and the center, so a ray from the center
    that meets the strip h radii from the axis passes the axis at h radii, and the strips of neighbouring segments share
    their corners (mitred). Where a strand doubles back as seen from the center the strip folds over instead of turning.

    Attributes:
        axis: `[P, 3]`, the strands' points less the center.
        side: `[P, 3]`, from the axis to the right-hand corner.
        starts: `[M]` int64, first point of every segment.
    """

    axis: Tensor
    side: Tensor
    starts: Tensor

    @staticmethod
    def facing(strands: Strands, center: Tensor) -> Ribbons:
        """The strips of all strands that face a point `[3]`."""
        axis = strands.points.to(torch.float64) - center
        starts = strands.starts
        chord = axis[starts + 1] - axis[starts]
        across = torch.linalg.cross(axis[starts] / _scale(axis[starts]), chord / _scale(chord))
        across = unit(across, torch.zeros_like(across))
        joined = torch.nonzero(starts.diff() == 1).flatten()
        turn = torch.ones(len(starts), dtype=torch.float64)
        turn[joined + 1] = torch.where((across[joined] * across[joined + 1]).sum(-1) < 0, -1.0, 1.0).to(turn)
        across = across * turn.cumprod(0).unsqueeze(-1)
        seen = across.any(-1, keepdim=True).to(torch.float64)
        total, count = (
            torch.zeros(len(axis), values.shape[1], dtype=torch.float64)
            .index_add(0, starts, values)
            .index_add(0, starts + 1, values)
            for values in (across, seen)
        )
        to_center = unit(-axis, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
        side = unit(total, perpendicular(to_center))
        length = total.norm(dim=-1, keepdim=True)
        mitre = torch.where(length > 0, count / torch.where(length > 0, length, 1.0), 1.0)  # 1 / cos(half the bend)
        wide = strands.radius.to(torch.float64).unsqueeze(-1) * mitre
        return Ribbons(axis, side * wide, starts)

    def vertices(self) -> Tensor:
        """Corners `[2 P, 3]`, left and right of every point in turn."""
        return torch.stack([self.axis - self.side, self.axis + self.side], dim=1).flatten(0, 1)

    def triangles(self) -> Tensor:
        """Indices `[2 M, 3]` of the corners of every segment's two triangles."""
        return (2 * self.starts.view(-1, 1, 1) + CORNERS).flatten(0, 1)

    def place(self, triangle: Tensor, direction: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Where rays from the center with unit directions `[H, 3]` meet given triangles `[H]`.

        Returns share along the segment in [0, 1], place across the strip in [-1, 1] (right-hand corners at 1) and the
        distance from the center. Rays that miss by the rounding of float32 are moved to the nearest edge.
        """
        start = self.starts[triangle // 2]
        axis, side = self.axis[torch.stack([start, start + 1], 1)], self.side[torch.stack([start, start + 1], 1)]
        quad = torch.stack([axis - side, axis + side], dim=2).flatten(1, 2)
        corner = CORNERS[triangle % 2]
        point = quad.gather(1, corner.unsqueeze(-1).expand(-1, -1, 3))
        far = (point * direction.unsqueeze(1)).sum(-1)
        flat = point - far.unsqueeze(-1) * direction.unsqueeze(1)
        area = (torch.linalg.cross(flat.roll(-1, 1), flat.roll(-2, 1)) * direction.unsqueeze(1)).sum(-1)
        share = (area * area.sum(-1, keepdim=True).sign()).clamp_min(0)
        total = share.sum(-1, keepdim=True)
        share = torch.where(total > 0, share / torch.where(total > 0, total, 1.0), 1 / 3)
        along, across = (share * _ALONG[corner]).sum(-1), (share * _OFFSET[corner]).sum(-1)
        return along.clamp(0, 1), across.clamp(-1, 1), (share * far).sum(-1)


def _scale(vector: Tensor) -> Tensor:
    """Length `[..., 1]`, 1 where it is 0."""
    length = vector.norm(dim=-1, keepdim=True)
    return torch.where(length > 0, length, 1.0)
