"""Cells of (theta_i, phi) that partition the sphere, and the probability that a density puts into each."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dsfit.context import Context
from dsfit.cubature import integrate
from dsfit.frame import HALF_PI, cos_inclination, wrap
from dsfit.proposals.base import Distribution

_NARROWEST = 1e-7  # radians; a law that is narrower than this has all its mass in one cell
_RINGS, _SECTORS = 24, 9  # quantiles in theta and in phi where the integration starts
_GROWTH = 3.0


@dataclass(frozen=True)
class CellGrid:
    """Cells between ascending edges in theta_i `[T + 1]`, from -pi/2 to pi/2, and in the relative azimuth phi
    `[P + 1]`, from -pi to pi; radians, float64."""

    theta: Tensor
    phi: Tensor

    @property
    def shape(self) -> tuple[int, int]:
        """Number of cells in theta and in phi."""
        return len(self.theta) - 1, len(self.phi) - 1

    def index(self, theta: Tensor, phi: Tensor) -> Tensor:
        """Row-major number of the cell that each direction lies in."""
        row = torch.bucketize(theta.contiguous(), self.theta[1:-1].to(theta), right=True)
        column = torch.bucketize(phi.contiguous(), self.phi[1:-1].to(phi), right=True)
        return row * self.shape[1] + column

    def count(self, theta: Tensor, phi: Tensor) -> Tensor:
        """Number of directions in every cell, `[T, P]`."""
        return torch.bincount(self.index(theta, phi), minlength=math.prod(self.shape)).reshape(self.shape)


@dataclass(frozen=True)
class CellMasses:
    """Probability of every cell `[T, P]` and its error bound; `converged` says whether the tolerance was met."""

    mass: Tensor
    error: Tensor
    converged: bool


def adapted_grid(theta: Tensor, phi: Tensor, cells: tuple[int, int]) -> CellGrid:
    """A grid for a law that sent these directions: half of the edges even, half at quantiles, so that the cells resolve
    a narrow lobe and still cover the rest of the sphere.

    Use directions that are not tested afterwards.
    """
    return CellGrid(_edges(theta, -HALF_PI, HALF_PI, cells[0]), _edges(phi, -math.pi, math.pi, cells[1]))


def _edges(values: Tensor, low: float, high: float, cells: int) -> Tensor:
    even = torch.linspace(low, high, cells - cells // 2 + 1, dtype=torch.float64)
    probabilities = torch.arange(1, cells // 2 + 1, dtype=torch.float64) / (cells // 2 + 1)
    return _distinct(torch.cat([even, _quantiles(values, probabilities)]), low, high)


def _quantiles(values: Tensor, probabilities: Tensor) -> Tensor:
    ordered = torch.sort(values.detach().double().flatten()).values
    return ordered[(probabilities * (len(ordered) - 1)).long()]


def _distinct(edges: Tensor, low: float, high: float) -> Tensor:
    """Ascending edges from low to high, none closer than `_NARROWEST` to the one before."""
    inner = torch.unique(edges[(edges > low + _NARROWEST) & (edges < high - _NARROWEST)])
    kept = [low]
    for edge in inner.tolist():
        if edge - kept[-1] > _NARROWEST:
            kept.append(edge)
    return torch.tensor([*kept, high], dtype=torch.float64)


def cell_masses(
    distribution: Distribution,
    context: Context,
    grid: CellGrid,
    pilots: Sequence[Tensor],
    *,
    rtol: float = 1e-6,
    max_evaluations: int = 4_000_000,
) -> CellMasses:
    """Integral of `exp(log_prob)` over every cell, by adaptive cubature; the sum is the mass over the sphere.

    The pole of a density per steradian at theta_i = +-pi/2 is cancelled against the cosine of the measure before the
    exponential is taken.

    Args:
        distribution: for a single context.
        context: that context.
        grid: the cells.
        pilots: directions `[N, 2]`, first of the same law, then of parts of it that are too rare to be found among the
            first: they tell the integration where to look.
        rtol: wanted error of the total mass.
        max_evaluations: of log_prob; beyond it the error bounds say what was reached.
    """
    breaks = _panels(grid.theta, [x[:, 0] for x in pilots], _RINGS)
    columns = _panels(grid.phi, [wrap(context.phi_r - x[:, 1]) for x in pilots], _SECTORS)

    def density(theta: Tensor, phi: Tensor) -> Tensor:
        omega = torch.stack([theta, wrap(context.phi_r - phi)], dim=-1).reshape(-1, 2).to(context.dtype)
        log = distribution.log_prob(omega).double() + torch.log(cos_inclination(omega[:, 0])).double()
        return torch.exp(log).reshape(*theta.shape, 1)

    found = integrate(density, breaks, lambda t: columns.expand(*t.shape, -1), rtol, max_evaluations)
    middle = (found.cells.theta_low + found.cells.theta_high) / 2
    index = grid.index(middle, ((columns[1:] + columns[:-1]) / 2)[found.cells.segment])
    sums = [torch.zeros(math.prod(grid.shape), dtype=torch.float64) for _ in range(2)]
    for total, part in zip(sums, (found.parts, found.part_errors), strict=True):
        total.index_add_(0, index, part[:, 0])
    return CellMasses(sums[0].reshape(grid.shape), sums[1].reshape(grid.shape), found.converged)


def _panels(edges: Tensor, pilots: Sequence[Tensor], count: int) -> Tensor:
    """Where the integration starts: the cells' edges, quantiles of the pilots, and panels that grow away from where
    they are dense, so that the tails beyond the last pilot sample are seen too."""
    starts = []
    for k, pilot in enumerate(pilots):
        inner = torch.linspace(0, 1, count if k == 0 else 5, dtype=torch.float64)
        # the first and last order statistics tell how abruptly the law ends
        ends = 4.0 ** torch.arange(0, 4 if k == 0 else 0, dtype=torch.float64) / len(pilot)
        starts.append(_quantiles(pilot, torch.cat([inner, ends, 1 - ends])))
    start = torch.cat(starts)
    apart = (start[:, None] - edges).abs().min(dim=1).values > _NARROWEST
    # edges keep their distance from each other and from these quantiles: `_distinct` drops quantiles only
    return _graded(_distinct(torch.cat([start[apart], edges]), float(edges[0]), float(edges[-1])))


def _graded(edges: Tensor) -> Tensor:
    """The edges, and more, so that no panel is more than `_GROWTH` times as wide as its neighbour."""
    edges_list = edges.tolist()
    for _ in range(2):  # from the left, then from the right
        found = edges_list[:2]
        for edge in edges_list[2:]:
            step = found[-1] - found[-2]
            while edge - found[-1] > _GROWTH * step:
                step *= _GROWTH
                found.append(found[-1] + step)
            if edge > found[-1]:
                found.append(edge)
        edges_list = [-x for x in reversed(found)]
    return torch.tensor(edges_list, dtype=torch.float64)


__all__ = ["CellGrid", "CellMasses", "adapted_grid", "cell_masses"]
