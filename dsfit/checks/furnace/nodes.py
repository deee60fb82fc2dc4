"""Quadrature nodes that never straddle the edges of a partition, for an integrand and for densities beside it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from dsfit.checks.furnace.partition import Partition
from dsfit.context import Context
from dsfit.cubature import Cells, nodes_of
from dsfit.errors import InputError
from dsfit.frame import HALF_PI, cos_inclination, wrap
from dsfit.quadrature import merge_breaks

IntegrandLike = Callable[[Tensor, Context], Tensor]
"""`f(omega_i [..., 2], context) -> [..., C]`, F cos(theta_i) L per steradian. If it offers `theta_breaks(context)` and
`azimuth_edges(context, theta_i)`, as `dsfit.Integrand` does, quadrature follows its peaks and edges; if `is_even`, only
half of the azimuths are evaluated."""

CAP = 40.0
"""Largest weight of the ring test, in units of the mean."""

_FINE, _COARSE, _AT_ONCE = 6, 4, 512
_MOMENTS = 0.03  # bound on the error of a density's mass and of its weights' second moment
_ROUNDS = 8


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
class _Source:
    """What is integrated: the integrand at a context, over a partition, on half of the azimuths if all is even."""

    integrand: IntegrandLike
    context: Context
    partition: Partition
    even: bool

    @staticmethod
    def of(integrand: IntegrandLike, context: Context, partition: Partition) -> _Source:
        symmetric = bool(torch.allclose(partition.phi, -partition.phi.flip(0), atol=1e-12))
        even = bool(getattr(integrand, "is_even", False)) and symmetric
        return _Source(integrand, context, partition, even)

    def edges(self, theta: Tensor) -> Tensor:
        """Sorted azimuths `[..., J]`: those of the integrand and those of the wedges."""
        fixed = self.partition.phi.expand(*theta.shape, -1)
        if hasattr(self.integrand, "azimuth_edges"):
            fixed = torch.cat([self.integrand.azimuth_edges(self.context, theta, coarse=True), fixed], dim=-1)
        return torch.sort(fixed.clamp_min(0.0) if self.even else fixed, dim=-1).values

    def panels(self) -> _Panels:
        """The first panels: between all breaks in theta and all edges in phi, without those of no width."""
        own = [self.integrand.theta_breaks(self.context)] if hasattr(self.integrand, "theta_breaks") else []
        breaks = merge_breaks(torch.cat([*own, self.partition.theta]), -HALF_PI, HALF_PI, 1e-9)
        cells = Cells.grid(breaks, self.edges(breaks[:1]).shape[-1] - 1)
        x = torch.linspace(0.0, 1.0, 7, dtype=breaks.dtype)
        bounds = self.edges(cells.theta_low[:, None] + (cells.theta_high - cells.theta_low)[:, None] * x)
        at = cells.segment[:, None].expand(-1, 7)[..., None]
        width = (bounds.gather(-1, at + 1) - bounds.gather(-1, at)).squeeze(-1)
        return self.evaluate(cells[(width > 1e-12).any(-1)])

    def evaluate(self, cells: Cells) -> _Panels:
        found: dict[int, tuple[Tensor, Tensor, Tensor]] = {}
        for count in (_FINE, _COARSE):
            parts = []
            for start in range(0, len(cells), _AT_ONCE):
                theta, phi, weight = nodes_of(cells[start : start + _AT_ONCE], self.edges, count)
                omega = torch.stack([theta, wrap(self.context.phi_r - phi)], dim=-1).flatten(1, 2)
                value = self.integrand(omega.flatten(0, 1), self.context)
                weight = (weight * cos_inclination(theta)).flatten(1)
                parts.append((omega, weight, value.reshape(*weight.shape, -1)))
            found[count] = tuple(torch.cat(x) for x in zip(*parts, strict=True))  # type: ignore[assignment]
        return _Panels(self, cells, found)


@dataclass(frozen=True)
class _Panels:
    """Panels, and for both rules omega `[M, count^2, 2]`, weights `[M, count^2]` and values `[M, count^2, C]`."""

    source: _Source
    cells: Cells
    nodes: dict[int, tuple[Tensor, Tensor, Tensor]]

    def norms(self, count: int) -> Tensor:
        """Integral of the norm over each panel `[M]`."""
        _, weight, value = self.nodes[count]
        return (torch.linalg.vector_norm(value, dim=-1) * weight).sum(-1)

    def refined(self, chosen: Tensor) -> _Panels:
        """The chosen panels cut into four."""
        halves = self.cells[chosen].split(torch.ones(len(chosen), dtype=torch.bool))
        new = self.source.evaluate(halves.split(torch.zeros(len(halves), dtype=torch.bool)))
        keep = torch.ones(len(self.cells), dtype=torch.bool)
        keep[chosen] = False
        nodes = {
            count: tuple(torch.cat([x[keep], y]) for x, y in zip(self.nodes[count], new.nodes[count], strict=True))
            for count in self.nodes
        }
        return _Panels(self.source, Cells.join([self.cells[keep], new.cells]), nodes)  # type: ignore[arg-type]

    def rule(self, count: int) -> Rule:
        """All nodes; those mirrored in phi come after the others."""
        omega, weight, value = (x.flatten(0, 1) for x in self.nodes[count])
        if self.source.even:
            phi_r = self.source.context.phi_r
            mirrored = torch.stack([omega[:, 0], wrap(2 * phi_r - omega[:, 1])], dim=-1)
            omega, weight, value = torch.cat([omega, mirrored]), weight.repeat(2), value.repeat(2, 1)
        return Rule(omega, weight, value, self.source.partition.cell(omega, self.source.context))

    def per_panel(self, values: Tensor, count: int) -> Tensor:
        """Sums `[M, K]` over the nodes of each panel of what is given at the nodes of `rule(count)`, `[Q, K]`."""
        copies = 2 if self.source.even else 1
        return values.reshape(copies, len(self.cells), count * count, -1).sum((0, 2))


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
    panels: _Panels

    @staticmethod
    def of(panels: _Panels, converged: bool) -> PartitionNodes:
        """The nodes of these panels."""
        return PartitionNodes(panels.source.partition, panels.rule(_FINE), panels.rule(_COARSE), converged, panels)

    def integrate(self, function: Callable[[Rule], Tensor]) -> tuple[Tensor, Tensor]:
        """Integrals `[cells, K]` of `function(rule) -> [Q, K]` and their error bounds."""
        fine, coarse = (rule.integrals(function(rule), self.partition.count) for rule in (self.fine, self.coarse))
        return fine, (fine - coarse).abs()

    def total(self) -> float:
        """int |f| domega."""
        return float((torch.linalg.vector_norm(self.fine.value, dim=-1) * self.fine.weight).sum())

    def with_density(self, log_prob: Callable[[Tensor], Tensor]) -> NodeDensity:
        """A proposal's density at the nodes, for everything that is asked about it.

        Panels are cut further until its mass and the second moment of its weights are known to 3 %, as a density may be
        narrow where the integrand is not. What no node comes near stays unseen.
        """
        nodes = self
        with torch.no_grad():
            for _ in range(_ROUNDS):
                log_p = [torch.cat([log_prob(x) for x in r.omega.split(16384)]) for r in (nodes.fine, nodes.coarse)]
                density = NodeDensity(nodes, log_p[0], log_p[1])
                chosen = density.coarse_panels()
                if len(chosen) == 0:
                    break
                nodes = PartitionNodes.of(nodes.panels.refined(chosen), self.converged)
        return density


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
        norm, total = torch.linalg.vector_norm(self.nodes.fine.value, dim=-1), self.nodes.total()
        if total == 0:
            return 0.0
        return float(torch.where(norm > 1e-12 * norm.max(), norm * torch.exp(-self.fine), 0.0).max()) / total

    def coarse_panels(self) -> Tensor:
        """Panels that have to be cut before mass and second moment (of weights capped at 40 means) are known."""
        largest, panels = CAP * self.nodes.total(), self.nodes.panels
        sums = []
        for rule, log_p, count in ((self.nodes.fine, self.fine, _FINE), (self.nodes.coarse, self.coarse, _COARSE)):
            p, norm = torch.exp(log_p), torch.linalg.vector_norm(rule.value, dim=-1)
            capped = torch.where(norm < largest * p, norm * norm / p.clamp_min(1e-300), largest * largest * p)
            sums.append(panels.per_panel(torch.stack([p, capped], dim=-1) * rule.weight[:, None], count))
        error = (sums[0] - sums[1]).abs() / sums[0].sum(0).clamp_min(1e-300)
        error = torch.where(error.isfinite(), error, 0.0).amax(-1)
        if float(error.sum()) <= _MOMENTS:
            return torch.zeros(0, dtype=torch.int64)
        order = torch.argsort(error, descending=True)
        left = error.sum() - torch.cumsum(error[order], 0)
        return order[: int((left > 0.5 * _MOMENTS).sum()) + 1]


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
    with torch.no_grad():
        panels = _Source.of(integrand, context.to(torch.float64), partition).panels()
        spent = len(panels.cells)
        while True:
            error = (panels.norms(_FINE) - panels.norms(_COARSE)).abs()
            total = float(panels.norms(_FINE).sum())
            if float(error.sum()) <= rtol * total:
                return PartitionNodes.of(panels, True)
            order = torch.argsort(error, descending=True)
            left = error.sum() - torch.cumsum(error[order], 0)
            chosen = order[: int((left > 0.5 * rtol * total).sum()) + 1]
            spent += 4 * len(chosen)
            if spent * (_FINE**2 + _COARSE**2) > max_evaluations:
                return PartitionNodes.of(panels, False)
            panels = panels.refined(chosen)
