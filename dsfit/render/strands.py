"""Strands of hair as polylines."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dsfit.errors import InputError, check_finite


@dataclass(frozen=True)
class Strands:
    """Strands of hair: polylines of at least two points, root first.

    Attributes:
        points: `[P, 3]`, all strands one after another, in the scene's unit of length.
        first: `[S + 1]` int64; strand s has the points `first[s]` to `first[s + 1] - 1`.
        radius: `[P]`, of the fibre at each point, > 0.

    Raises:
        InputError: shapes that do not fit, no strand, a strand of one point, values that are not finite, radii <= 0.
    """

    points: Tensor
    first: Tensor
    radius: Tensor

    def __post_init__(self) -> None:
        check_finite("strands.points", self.points)
        check_finite("strands.radius", self.radius)
        if self.points.ndim != 2 or self.points.shape[1] != 3:
            raise InputError("strands.points", tuple(self.points.shape), "shape [P, 3]")
        if self.radius.shape != self.points.shape[:1]:
            raise InputError("strands.radius", tuple(self.radius.shape), f"shape [{len(self.points)}]")
        if not bool((self.radius > 0).all()):
            raise InputError("strands.radius", float(self.radius.min()), "radii > 0")
        ends = self.first
        if ends.ndim != 1 or len(ends) < 2 or ends[0] != 0 or ends[-1] != len(self.points):
            raise InputError("strands.first", tuple(ends.shape), "[0, ..., P], one more than strands, at least two")
        if not bool((ends.diff() >= 2).all()):
            raise InputError("strands.first", int(ends.diff().min()), "strands of at least two points")

    def __len__(self) -> int:
        return len(self.first) - 1

    @property
    def starts(self) -> Tensor:
        """Index `[M]` of the first point of every segment; its second point is the next one."""
        keep = torch.ones(len(self.points), dtype=torch.bool)
        keep[self.first[1:] - 1] = False
        return torch.nonzero(keep).flatten()

    @property
    def strand_of_point(self) -> Tensor:
        """Index `[P]` of the strand that each point belongs to."""
        return torch.repeat_interleave(torch.arange(len(self)), self.first.diff())

    @property
    def bounds(self) -> tuple[Tensor, Tensor]:
        """Lowest and highest corner `[3]` of a box around all fibres, radii included."""
        wide = self.radius.unsqueeze(-1)
        return (self.points - wide).amin(0), (self.points + wide).amax(0)
