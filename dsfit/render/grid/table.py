"""n in many directions at the points of a coarse lattice, computed once and looked up."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from dsfit.errors import InputError, as_number, check_choice, check_finite

if TYPE_CHECKING:
    from dsfit.render.grid.density import DensityGrid

LATTICE = 24
"""Points along the longest side."""

ROWS, COLUMNS = 8, 16


def directions(rows: int, columns: int) -> Tensor:
    """Unit vectors `[rows, columns, 3]` at the middles of cells of equal area: rows of equal height in y (from -1 to
    1), columns of equal azimuth atan2(x, z) (from -pi to pi)."""
    height = (torch.arange(rows, dtype=torch.float64) + 0.5) * (2 / rows) - 1
    azimuth = (torch.arange(columns, dtype=torch.float64) + 0.5) * (2 * math.pi / columns) - math.pi
    wide = torch.sqrt(1 - height * height)[:, None]
    parts = (wide * torch.sin(azimuth), height[:, None].expand(rows, columns), wide * torch.cos(azimuth))
    return torch.stack(parts, dim=-1)


@dataclass(frozen=True)
class DirectionalTable:
    """n at lattice points x directions, of rays as from fibres of no width. An approximation, to guide sampling; not
    what an image should be made of.

    Attributes:
        n: `[X, Y, Z, rows, columns]` float32; points on the corners of the box and evenly between, directions as in
            `directions`.
        low, high: `[3]`, corners of the box; points beyond are looked up at its border.
    """

    n: Tensor
    low: Tensor
    high: Tensor
    _fields: dict[str | float, tuple[Tensor, Tensor]] = field(default_factory=dict, init=False, repr=False)

    @classmethod
    def of(
        cls, grid: DensityGrid, *, lattice: int = LATTICE, rows: int = ROWS, columns: int = COLUMNS
    ) -> DirectionalTable:
        """The table of a grid, `lattice` >= 2 points along its longest side and rows x columns directions."""
        for name, value, least in (("lattice", lattice, 2), ("rows", rows, 1), ("columns", columns, 1)):
            if isinstance(value, bool) or not isinstance(value, int) or value < least:
                raise InputError(name, value, f"a whole number >= {least}")
        gap = max(grid.shape) / (lattice - 1)
        counts = [max(2, round(size / gap) + 1) for size in grid.shape]
        axes = [
            torch.linspace(a, b, count, dtype=torch.float64)
            for a, b, count in zip(grid.low.tolist(), grid.high.tolist(), counts, strict=True)
        ]
        points = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1)
        with torch.no_grad():
            n = grid.crossings(points[..., None, None, :].float(), directions(rows, columns).float(), 0.0)
        return cls(n, grid.low, grid.high)

    @property
    def memory(self) -> int:
        """Bytes."""
        return self.n.numel() * self.n.element_size()

    def at(self, position: Tensor) -> Tensor:
        """n in all directions, `[*, rows, columns]`, interpolated trilinearly between the lattice's points."""
        return self._between(self.n, position).to(position)

    def crossings(self, origin: Tensor, direction: Tensor) -> Tensor:
        """n `[*]` in single directions `[*, 3]`: trilinear in the point, bilinear on the sphere."""
        rows, columns = self.n.shape[-2:]
        d = direction / direction.norm(dim=-1, keepdim=True)
        row = ((d[..., 1] + 1) * (rows / 2) - 0.5).clamp(0.0, rows - 1.0)
        column = (torch.atan2(d[..., 0], d[..., 2]) + math.pi) * (columns / (2 * math.pi)) - 0.5
        n = 0.0
        for i, weight_i in _pair(row, rows - 1):
            for j, weight_j in _pair(column, None):
                cell = i * columns + j % columns
                n = n + weight_i * weight_j * self._between(self.n.flatten(-2), origin, cell)
        return n.to(direction)

    def hints(self, position: Tensor, v: str | float = "poisson") -> tuple[Tensor, Tensor]:
        """Representative n and mean v `[*]` at points `[*, 3]`; see `DensityGrid.hints`."""
        check_finite("position", position)
        rule = check_choice("v", v, ("poisson", "threshold")) if isinstance(v, str) else as_number("v", v, 0.0, 1.0)
        if rule not in self._fields:
            self._fields[rule] = self._representative(rule)
        n, lit = (self._between(x.unsqueeze(-1), position).squeeze(-1).to(position) for x in self._fields[rule])
        return n, torch.where(n == 0, 1.0, lit.clamp(0.0, 1.0))

    def _representative(self, rule: str | float) -> tuple[Tensor, Tensor]:
        """n and v at the lattice's points, `[X, Y, Z]`."""
        from dsfit.scene.scattering import THRESHOLD

        n = self.n.flatten(-2).to(torch.float64)
        transmitted = (math.log(n.shape[-1]) - torch.logsumexp(-n, dim=-1)).clamp_min(0.0)
        transmitted = torch.where((n == 0).all(-1), 0.0, transmitted)
        if rule == "poisson":
            return transmitted, torch.exp(-transmitted)
        lit = n <= THRESHOLD if rule == "threshold" else torch.where(n == 0, 1.0, rule)
        return transmitted, lit.to(n).mean(-1)

    def _between(self, values: Tensor, position: Tensor, cell: Tensor | None = None) -> Tensor:
        """Trilinear in `values` `[X, Y, Z, ...]`; with `cell` `[*]`, only that entry of the last dimension."""
        sizes = values.shape[:3]
        last = torch.tensor([size - 1 for size in sizes], dtype=position.dtype)
        low, high = self.low.to(position), self.high.to(position)
        place = torch.minimum(((position - low) / (high - low) * last).clamp_min(0.0), last)
        result: Any = 0.0
        x, y, z = ([*_pair(place[..., a], sizes[a] - 1)] for a in range(3))
        for i, weight_i in x:
            for j, weight_j in y:
                for k, weight_k in z:
                    found = values[i, j, k] if cell is None else values[i, j, k, cell]
                    weight = weight_i * weight_j * weight_k
                    result = result + found * weight.reshape(*weight.shape, *[1] * (found.ndim - weight.ndim))
        return result


def _pair(place: Tensor, last: int | None) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
    """The two whole numbers around a place, not beyond `last`, and their weights."""
    lower = torch.floor(place)
    lower = lower if last is None else lower.clamp_max(max(last - 1, 0))
    part = place - lower
    upper = lower + 1 if last is None else (lower + 1).clamp_max(last)
    return (lower.long(), 1 - part), (upper.long(), part)
