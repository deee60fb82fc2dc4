"""What evaluation and density share at a direction: half and difference angle, cosines, the cell of the records."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from dsfit.frame import HALF_PI, TWO_PI
from dsfit.kernels.layout import Layout

_FLOOR = torch.finfo(torch.float32).eps ** 2


@dataclass(frozen=True)
class Direction:
    """Angles and cosines of `[S, B]` directions."""

    theta_h: Tensor
    diff: Tensor
    phi: Tensor
    cos_i: Tensor
    cos_diff: Tensor

    @staticmethod
    def at(theta_i: Tensor, phi: Tensor, theta_r: Tensor) -> Direction:
        """|theta_diff| and |phi|, the latter wrapped; cosines never 0 (as `frame.cos_inclination`)."""
        diff = ((theta_r - theta_i) * 0.5).abs()
        turned = (phi - TWO_PI * torch.round(phi * (1 / TWO_PI))).abs()
        cosines = (torch.cos(x).clamp_min(_FLOOR) for x in (theta_i, diff))
        return Direction((theta_i + theta_r) * 0.5, diff, turned, *cosines)


@dataclass(frozen=True)
class Cell:
    """Cell of a uniform grid over (|theta_diff|, |phi|): number of its first node and position inside, in [0, 1]."""

    first: Tensor
    across: Tensor
    along: Tensor

    @staticmethod
    def of(direction: Direction, rows: int, columns: int) -> Cell:
        """The cell that holds a direction."""
        x = (direction.diff * ((rows - 1) / HALF_PI)).clamp_max(rows - 1)
        y = (direction.phi * ((columns - 1) / math.pi)).clamp_max(columns - 1)
        i = x.to(torch.int32).clamp_max(rows - 2)
        j = y.to(torch.int32).clamp_max(columns - 2)
        return Cell((i * columns + j).to(torch.int64), x - i.to(x.dtype), y - j.to(y.dtype))


class Records:
    """Bilinear look-up in records `[rows * columns, width]`.

    The four corners are views of the same length, so that one index serves all of them.
    """

    def __init__(self, table: Tensor, cell: Cell, layout: Layout) -> None:
        self.cell = cell
        columns = layout.columns
        length = table.shape[0] - columns - 1
        self.corners = [table[k : k + length] for k in (0, 1, columns, columns + 1)]

    def __getitem__(self, column: int) -> Tensor:
        low, next_low, high, next_high = (take(x[:, column], self.cell.first) for x in self.corners)
        below = low + (next_low - low) * self.cell.along
        above = high + (next_high - high) * self.cell.along
        return below + (above - below) * self.cell.across


def take(column: Tensor, index: Tensor) -> Tensor:
    """`column[index]` of a one-dimensional view; indices are known to be inside."""
    return torch.ops.aten._unsafe_index(column, [index])
