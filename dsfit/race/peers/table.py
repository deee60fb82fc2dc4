"""Tabulated 2-D inversion: a table for each context, or tables made once for a grid of contexts."""

from __future__ import annotations

from typing import ClassVar

from dsfit.context import Context
from dsfit.errors import as_number, check_choice
from dsfit.proposals.table_2d import Table2D, check_count, check_resolution
from dsfit.proposals.table_2d_grid import BLENDS, GridOfTables
from dsfit.race.density import DensitySampler
from dsfit.race.peer import Peer, Problem, Sampler

_ENDS = {"open_low": True, "open_high": True}


class OwnTable(Peer):
    """A table of |f| cos(theta_i) for every context (`Table2D`): rows x columns x samples^2 evaluations each.

    Args:
        resolution: rows in theta_i, columns in phi (half the circle, where the integrand is even).
        samples: midpoints per cell and axis.
        defensive: share that is uniform over the grid.
    """

    name: ClassVar[str] = "table_2d"
    per_context: ClassVar[bool] = True

    def __init__(self, resolution: tuple[int, int] = (64, 64), samples: int = 1, defensive: float = 0.005) -> None:
        self.resolution = check_resolution("table_2d.resolution", resolution)
        self.samples = check_count("table_2d.samples", samples)
        self.defensive = as_number("table_2d.defensive", defensive, 0.0, 1.0, **_ENDS)

    def prepare(self, problem: Problem) -> None:
        """Nothing is shared by contexts."""
        self.problem = problem
        self.proposal = Table2D(problem.integrand, self.resolution, self.samples, self.defensive)

    def at(self, contexts: Context) -> Sampler:
        """The tables."""
        return DensitySampler(self.problem, self.proposal(contexts), contexts)


class SharedTables(Peer):
    """Tables over theta_r and n made once (`GridOfTables`), looked up at every context: what a renderer would ship.

    Args:
        views: values of theta_r.
        depths: number of values of n, quadratically spaced from 0 to the stream's largest.
        resolution, samples, defensive: as for `OwnTable`.
        blend: "nearest" table, or "linear": one of the tables around the context, the density that of their mixture.
    """

    name: ClassVar[str] = "table_grid"

    def __init__(
        self,
        views: int = 48,
        depths: int = 14,
        resolution: tuple[int, int] = (64, 64),
        samples: int = 1,
        defensive: float = 0.005,
        blend: str = "linear",
    ) -> None:
        self.views, self.depths = check_count("table_grid.views", views, 2), check_count("table_grid.depths", depths, 2)
        self.resolution = check_resolution("table_grid.resolution", resolution)
        self.samples = check_count("table_grid.samples", samples)
        self.defensive = as_number("table_grid.defensive", defensive, 0.0, 1.0, **_ENDS)
        self.blend = check_choice("table_grid.blend", blend, BLENDS)

    def prepare(self, problem: Problem) -> None:
        """All tables."""
        self.problem = problem
        last = self.depths - 1
        depths = tuple(problem.stream.n_max * (k / last) ** 2 for k in range(self.depths))
        options = (self.views, depths, self.resolution, self.samples, self.defensive, self.blend, problem.dtype)
        self.proposal = GridOfTables(problem.integrand, *options)

    def at(self, contexts: Context) -> Sampler:
        """Which tables, and their shares."""
        return DensitySampler(self.problem, self.proposal(contexts), contexts)
