"""Partitions of the sphere into rings and wedges, and quadrature nodes that never straddle their edges."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from dsfit.context import Context
from dsfit.cubature import Cells, nodes_of
from dsfit.errors import InputError
from dsfit.frame import HALF_PI, cos_inclination, wrap
from dsfit.quadrature import merge_breaks

IntegrandLike = Callable[[Tensor, Context], Tensor]
"""`f(omega_i [..., 2], context) -> [..., C]`, F cos(theta_i) L per steradian. If it offers `theta_breaks(context)` and
`azimuth_edges(context, theta_i)`, as `dsfit.Integrand` does, quadrature follows its peaks and edges; if `is_even`, only
half of the azimuths are evaluated."""

_FINE, _COARSE, _AT_ONCE = 6, 4, 512


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


@dataclass(frozen=True)
class Rule:
    """Nodes of a rule: omega `[Q, 2]`, weights per steradian `[Q]`, integrand values `[Q, C]`, cells `[Q]`."""

    omega: Tensor
    weight: Tensor
    value: Tensor
    cell: Tensor

    def integrals(self, columns: Tensor, cells: int) -> Tensor:
        """Integrals of the functions whose values `[Q, K]` are given, over every cell of the partition `[cells, K]`."""
        weighted = columns * self.weight[:, None]
        return torch.zeros(cells, columns.shape[-1], dtype=weighted.dtype).index_add_(0, self.cell, weighted)


@dataclass(frozen=True)
class PartitionNodes:
    """Quadrature of one context over a partition.

    Attributes:
        partition: the cells.
        fine, coarse: tensor Gauss rules of 6 x 6 and 4 x 4 points on the same panels; their difference bounds the error
            of the fine one.
        converged: whether the integrand's total met the tolerance.
    """

    partition: Partition
    fine: Rule
    coarse: Rule
    converged: bool

    def integrate(self, function: Callable[[Rule], Tensor]) -> tuple[Tensor, Tensor]:
        """Integrals `[cells, K]` of `function(rule) -> [Q, K]` and their error bounds."""
        fine, coarse = (rule.integrals(function(rule), self.partition.count) for rule in (self.fine, self.coarse))
        return fine, (fine - coarse).abs()

    def with_density(self, log_prob: Callable[[Tensor], Tensor]) -> NodeDensity:
        """A proposal's density at the nodes, for everything that is asked about it."""
        with torch.no_grad():
            log_p = [torch.cat([log_prob(x) for x in r.omega.split(16384)]) for r in (self.fine, self.coarse)]
        return NodeDensity(self, log_p[0], log_p[1])


@dataclass(frozen=True)
class NodeDensity:
    """Log density of a proposal per steradian at the nodes of both rules."""

    nodes: PartitionNodes
    fine: Tensor
    coarse: Tensor

    def integrate(self, function: Callable[[Rule, Tensor], Tensor]) -> tuple[Tensor, Tensor]:
        """Integrals `[cells, K]` of `function(rule, p) -> [Q, K]`, p the density at its nodes, and error bounds."""
        count = self.nodes.partition.count
        fine = self.nodes.fine.integrals(function(self.nodes.fine, torch.exp(self.fine)), count)
        coarse = self.nodes.coarse.integrals(function(self.nodes.coarse, torch.exp(self.coarse)), count)
        return fine, (fine - coarse).abs()

    def largest_weight(self) -> float:
        """sup |f| / p over the nodes in units of int |f|; inf where p leaves out what the integrand needs."""
        rule = self.nodes.fine
        norm = torch.linalg.vector_norm(rule.value, dim=-1)
        total = float((norm * rule.weight).sum())
        if total == 0:
            return 0.0
        return float(torch.where(norm > 1e-12 * norm.max(), norm * torch.exp(-self.fine), 0.0).max()) / total


def partition_nodes(
    integrand: IntegrandLike,
    context: Context,
    partition: Partition,
    rtol: float = 1e-4,
    *,
    max_evaluations: int = 2_000_000,
) -> PartitionNodes:
    """Nodes that integrate the integrand's norm over every cell of the partition, refined until the summed bounds are
    below `rtol` of the total.

    The bound is |6-point - 4-point| per panel, hundreds of times the error of the 6-point rule for smooth integrands.

    Raises:
        InputError: the context is a batch, or rtol is not in (0, 1).
    """
    if context.batch_shape != ():
        raise InputError("context", tuple(context.batch_shape), "a single context, of batch shape ()")
    if not 0 < rtol < 1:
        raise InputError("rtol", rtol, "a number in (0, 1)")
    context = context.to(torch.float64)
    symmetric = bool(torch.allclose(partition.phi, -partition.phi.flip(0), atol=1e-12))
    even = bool(getattr(integrand, "is_even", False)) and symmetric

    def edges(theta: Tensor) -> Tensor:
        fixed = partition.phi.expand(*theta.shape, -1)
        if hasattr(integrand, "azimuth_edges"):
            fixed = torch.cat([integrand.azimuth_edges(context, theta, coarse=True), fixed], dim=-1)
        fixed = fixed.clamp_min(0.0) if even else fixed
        return torch.sort(fixed, dim=-1).values

    own = [integrand.theta_breaks(context)] if hasattr(integrand, "theta_breaks") else []
    breaks = merge_breaks(torch.cat([*own, partition.theta]), -HALF_PI, HALF_PI, 1e-9)
    panels = _Panels.grid(breaks, edges)
    with torch.no_grad():
        done = panels.evaluate(integrand, context, edges)
        spent = len(done.cells)
        while True:
            error = (done.norms(_FINE) - done.norms(_COARSE)).abs()
            total = float(done.norms(_FINE).sum())
            if float(error.sum()) <= rtol * total:
                converged = True
                break
            order = torch.argsort(error, descending=True)
            left = error.sum() - torch.cumsum(error[order], 0)
            chosen = order[: int((left > 0.5 * rtol * total).sum()) + 1]
            spent += 4 * len(chosen)
            if spent * (_FINE**2 + _COARSE**2) > max_evaluations:
                converged = False
                break
            done = done.refine(chosen, integrand, context, edges)
        rules = [done.rule(context, partition, count, even) for count in (_FINE, _COARSE)]
    return PartitionNodes(partition, rules[0], rules[1], converged)


@dataclass(frozen=True)
class _Panels:
    """Panels of the quadrature, and for both rules omega, weight per steradian and integrand `[M, count^2, ...]`."""

    cells: Cells
    nodes: dict[int, tuple[Tensor, Tensor, Tensor]]

    @staticmethod
    def grid(breaks: Tensor, edges: Callable[[Tensor], Tensor]) -> _Panels:
        cells = Cells.grid(breaks, edges(breaks[:1]).shape[-1] - 1)
        x = torch.linspace(0.0, 1.0, 7, dtype=breaks.dtype)
        theta = cells.theta_low[:, None] + (cells.theta_high - cells.theta_low)[:, None] * x
        bounds = edges(theta)
        at = cells.segment[:, None].expand_as(theta)[..., None]
        width = (bounds.gather(-1, at + 1) - bounds.gather(-1, at)).squeeze(-1)
        return _Panels(cells[(width > 1e-12).any(-1)], {})  # segments of no width anywhere are left out

    def evaluate(self, integrand: IntegrandLike, context: Context, edges: Callable[[Tensor], Tensor]) -> _Panels:
        found: dict[int, tuple[Tensor, Tensor, Tensor]] = {}
        for count in (_FINE, _COARSE):
            parts = []
            for start in range(0, len(self.cells), _AT_ONCE):
                theta, phi, weight = nodes_of(self.cells[start : start + _AT_ONCE], edges, count)
                omega = torch.stack([theta, wrap(context.phi_r - phi)], dim=-1).flatten(1, 2)
                value = integrand(omega.flatten(0, 1), context)
                weight = (weight * cos_inclination(theta)).flatten(1)
                parts.append((omega, weight, value.reshape(*weight.shape, -1)))
            found[count] = tuple(torch.cat(x) for x in zip(*parts, strict=True))  # type: ignore[assignment]
        return _Panels(self.cells, found)

    def norms(self, count: int) -> Tensor:
        """Integral of the norm over each panel `[M]`."""
        _, weight, value = self.nodes[count]
        return (torch.linalg.vector_norm(value, dim=-1) * weight).sum(-1)

    def refine(
        self, chosen: Tensor, integrand: IntegrandLike, context: Context, edges: Callable[[Tensor], Tensor]
    ) -> _Panels:
        """The chosen panels cut into four."""
        halves = self.cells[chosen].split(torch.ones(len(chosen), dtype=torch.bool))
        new = _Panels(halves.split(torch.zeros(len(halves), dtype=torch.bool)), {})
        new = new.evaluate(integrand, context, edges)
        keep = torch.ones(len(self.cells), dtype=torch.bool)
        keep[chosen] = False
        nodes = {
            count: tuple(torch.cat([x[keep], y]) for x, y in zip(self.nodes[count], new.nodes[count], strict=True))
            for count in self.nodes
        }
        return _Panels(Cells.join([self.cells[keep], new.cells]), nodes)  # type: ignore[arg-type]

    def rule(self, context: Context, partition: Partition, count: int, even: bool) -> Rule:
        omega, weight, value = (x.flatten(0, 1) for x in self.nodes[count])
        used = weight > 0
        omega, weight, value = omega[used], weight[used], value[used]
        if even:
            phi = wrap(context.phi_r - omega[:, 1])
            mirrored = torch.stack([omega[:, 0], wrap(context.phi_r + phi)], dim=-1)
            omega, weight, value = torch.cat([omega, mirrored]), weight.repeat(2), value.repeat(2, 1)
        return Rule(omega, weight, value, partition.cell(omega, context))
