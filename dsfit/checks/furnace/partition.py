"""Partitions of the sphere of directions into rings and wedges."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from dsfit.context import Context
from dsfit.errors import InputError
from dsfit.frame import HALF_PI, wrap


@dataclass(frozen=True)
class Partition:
    """Cells of the sphere: theta_i between consecutive edges, times relative azimuth phi between consecutive edges.

    Attributes:
        theta: increasing edges `[R + 1]` from -pi/2 to pi/2, radians: rings perpendicular to the fibre.
        phi: increasing edges `[W + 1]` from -pi to pi, radians: azimuthal wedges. Cell = ring * W + wedge.
    """

    theta: Tensor
    phi: Tensor

    def __post_init__(self) -> None:
        for name, limit in (("theta", HALF_PI), ("phi", math.pi)):
            edges = getattr(self, name)
            ends = len(edges) > 1 and abs(float(edges[0]) + limit) < 1e-12 and abs(float(edges[-1]) - limit) < 1e-12
            if edges.ndim != 1 or not ends or not bool((edges.diff() > 0).all()):
                raise InputError(f"partition.{name}", edges.tolist(), f"increasing edges from -{limit} to {limit}")

    @staticmethod
    def even(rings: int, wedges: int = 1) -> Partition:
        """Rings of equal width in theta_i, and wedges of equal width in phi."""
        return Partition(
            torch.linspace(-HALF_PI, HALF_PI, rings + 1, dtype=torch.float64),
            torch.linspace(-math.pi, math.pi, wedges + 1, dtype=torch.float64),
        )

    @staticmethod
    def ring(theta: float, half_width: float) -> Partition:
        """The ring |theta_i - theta| < half_width (cut at the poles), and what is on both sides of it."""
        edges = [-HALF_PI, theta - half_width, theta + half_width, HALF_PI]
        kept = sorted({min(max(x, -HALF_PI), HALF_PI) for x in edges})
        return Partition(torch.tensor(kept, dtype=torch.float64), Partition.even(1).phi)

    @property
    def shape(self) -> tuple[int, int]:
        """Number of rings and of wedges."""
        return len(self.theta) - 1, len(self.phi) - 1

    @property
    def count(self) -> int:
        """Number of cells."""
        return self.shape[0] * self.shape[1]

    def cell(self, omega: Tensor, context: Context) -> Tensor:
        """Cell number `[...]` of directions `[..., 2]`; edges belong to the cell above."""
        phi = wrap(context.phi_r - omega[..., 1])
        ring = (torch.searchsorted(self.theta, omega[..., 0].contiguous(), right=True) - 1).clamp(0, self.shape[0] - 1)
        wedge = (torch.searchsorted(self.phi, phi.contiguous(), right=True) - 1).clamp(0, self.shape[1] - 1)
        return ring * self.shape[1] + wedge

    def rings(self) -> Tensor:
        """For every cell its ring, `[cells]`: the grouping that tests rings."""
        return torch.arange(self.count) // self.shape[1]

    def wedges(self) -> Tensor:
        """For every cell its wedge, `[cells]`."""
        return torch.arange(self.count) % self.shape[1]
