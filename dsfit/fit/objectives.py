"""What a fit minimises, as sums of squares over quadrature nodes.

Let `P* = |F| / int |F| dw` be the best density for a vector-valued integrand F, p the proposal's, both per steradian,
and `sum_q w_q f_q` the quadrature of `int f dw` (Lebesgue). With nodes, p sums to a mass `m = sum w p` near 1 rather
than to 1. Every objective here is a sum of *pointwise non-negative* terms that is zero only for p = P* at every node,
so that no fit can gain by hiding mass between nodes:

    excess:      sum w (P* - p)^2 / p            = (M / M* - 1) + (m - 1),   M = sum w |F|^2 / p,  M* = (sum w |F|)^2
    forward_kl:  sum w (P* log(P* / p) - P* + p) = KL(P* | p)   + (m - 1)

M / M* - 1 alone, by contrast, falls below zero when p crowds on the nodes. Each term has a smooth signed root, the
residual: for the excess `sqrt(w) (P* - p) / sqrt(p)`; for the divergence the deviance residual of Poisson regression.
So Gauss-Newton methods apply to both.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from dsfit.context import Context
from dsfit.errors import InputError, check_choice

LOG_FLOOR = -600.0
"""Smallest log density a residual is computed with: e^600 squared times a density is still finite, so values never
overflow."""


@dataclass(frozen=True)
class Target:
    """One context's quadrature nodes and what they say about the best density there, in float64.

    Attributes:
        context: a context of batch shape ().
        omega: nodes [Q, 2].
        weight: solid-angle weights [Q].
        log_best: log P* [Q], -inf where the integrand is zero.
        norm: `int |F| dw`.
        grey: `|int F dw|^2 / (int |F| dw)^2` in (0, 1]; 1 for one channel without sign changes.
        share: weight of this context in the mean over contexts.
    """

    context: Context
    omega: Tensor
    weight: Tensor
    log_best: Tensor
    norm: float
    grey: float
    share: float = 1.0

    @classmethod
    def from_nodes(cls, context: Context, omega: Tensor, weight: Tensor, value: Tensor, share: float = 1.0) -> Target:
        """From nodes [Q, 2], weights [Q] and integrand values [Q, C].

        Raises:
            InputError: shapes do not match, a value is not finite, a weight is not positive, or the integrand is zero
                at all nodes.
        """
        omega, weight, value = (x.detach().to(torch.float64) for x in (omega, weight, value))
        if omega.ndim != 2 or omega.shape[1] != 2 or weight.shape != omega.shape[:1] or value.shape[:1] != weight.shape:
            shapes = [tuple(x.shape) for x in (omega, weight, value)]
            raise InputError("nodes", shapes, "omega [Q, 2], weight [Q], value [Q, C]")
        bad = ~(
            torch.isfinite(value).reshape(len(value), -1).all(-1)
            & torch.isfinite(omega).all(-1)
            & torch.isfinite(weight)
        )
        if bool(bad.any()):
            where = int(bad.nonzero()[0, 0])
            raise InputError("nodes", f"{value[where].tolist()} at {omega[where].tolist()}", "finite values")
        if bool((weight < 0).any()):
            raise InputError("nodes.weight", float(weight.min()), "numbers >= 0")
        value = value.reshape(len(value), -1)
        # Scaled by the largest value first: its square must neither under- nor overflow.
        largest = float(value.abs().max())
        if not largest > 0:
            raise InputError("nodes.value", 0.0, "an integrand that is not zero at every node")
        length = (value / largest).norm(dim=-1)
        total = float((weight * length).sum())
        if not total > 0:
            raise InputError("nodes.value", 0.0, "an integrand that is not zero at every node of positive weight")
        mean = (weight[:, None] * value / largest).sum(0).norm()
        grey = min(float(mean / total), 1.0) ** 2  # rounding may take it above 1 for a single channel
        return cls(context, omega, weight, torch.log(length / total), total * largest, grey, share)


class Objective(ABC):
    """What a fit minimises: the mean over contexts of `factor * (sum_q residual_q^2 + offset)`.

    Attributes:
        name: the name under which a fit finds it.
        least_squares: whether `residuals` is available; if not, `loss` must be, and only solvers of scalars apply.
    """

    name: str
    least_squares: bool = True

    @abstractmethod
    def residuals(self, log_p: Tensor, weight: Tensor, log_best: Tensor) -> Tensor:
        """Residuals [...] at nodes, each a function of the log density at its own node only."""

    def loss(self, log_p: Tensor, weight: Tensor, log_best: Tensor) -> Tensor:
        """The sum over nodes (dimension 0), `[Q, *batch] -> [*batch]`."""
        return self.residuals(log_p, weight, log_best).square().sum(0)

    def slope(self, total: float) -> float:
        """Derivative of `loss` by the sum of squared residuals, `total`: 1 where they are the same."""
        return 1.0

    def factor(self, proposal: Any, target: Target) -> Tensor | float:
        """A positive factor per context that may depend on the proposal's parameters; differentiable."""
        return 1.0

    def offset(self, target: Target) -> float:
        """A constant per context, >= 0, inside the factor."""
        return 0.0


def excess_residuals(log_p: Tensor, weight: Tensor, log_best: Tensor) -> Tensor:
    """`sqrt(w) (P* - p) / sqrt(p)` from log densities; finite for any log p (floored at -600) and for P* = 0."""
    half = 0.5 * log_p.clamp_min(LOG_FLOOR)
    return torch.sqrt(weight) * (torch.exp(log_best - half) - torch.exp(half))


def divergence_residuals(log_p: Tensor, weight: Tensor, log_best: Tensor) -> Tensor:
    """Signed root of `w (P* log(P* / p) - P* + p)`; finite for any log p (floored at -600) and for P* = 0.

    With a = log(P* / p) the term is `w p k(a)`, `k(a) = 1 + e^a (a - 1) = a^2/2 + a^3/3 + ...`; near a = 0 the root is
    taken of the series.
    """
    log_p = log_p.clamp_min(LOG_FLOOR)
    a = log_best - log_p
    near, above = a.abs() < 0.05, a > 0
    x = torch.where(near, a, 0.0)
    # sqrt(k) / (a / sqrt 2) = sqrt(sum_j 2 a^j / (j! (j + 2)))
    series = 1 + x * (2 / 3 + x * (1 / 4 + x * (1 / 15 + x * (1 / 72 + x * (1 / 420 + x / 2880)))))
    middle = torch.exp(0.5 * log_p) * x * torch.sqrt(0.5 * series)
    # Above: sqrt(P* (a + e^-a - 1)); below: -sqrt(p (1 + e^a (a - 1))).
    up = torch.where(above & ~near, a, 1.0)
    high = torch.exp(0.5 * torch.where(above, log_best, 0.0)) * torch.sqrt(up + torch.expm1(-up))
    down = torch.where(above | near, -1.0, a).clamp_min(-745.0)
    low = -torch.exp(0.5 * log_p) * torch.sqrt(1 + torch.exp(down) * (down - 1))
    return torch.sqrt(weight) * torch.where(near, middle, torch.where(above, high, low))


class Excess(Objective):
    """The excess of second moment `M(p) / M* - 1`, also the chi-square divergence of P* from p."""

    name = "excess"

    def residuals(self, log_p: Tensor, weight: Tensor, log_best: Tensor) -> Tensor:
        return excess_residuals(log_p, weight, log_best)


class LogExcess(Objective):
    """`log(1 + excess) = log(M / M*)`: its mean over contexts is a geometric mean of second moments, which a few bad
    contexts do not dominate. For fits of one proposal to many contexts; not a sum of squares, but a function of one, so
    that a Gauss-Newton model can still judge where a fit ended."""

    name = "log_excess"
    least_squares = False

    def residuals(self, log_p: Tensor, weight: Tensor, log_best: Tensor) -> Tensor:
        return excess_residuals(log_p, weight, log_best)

    def slope(self, total: float) -> float:
        return 1.0 / (1.0 + total)

    def loss(self, log_p: Tensor, weight: Tensor, log_best: Tensor) -> Tensor:
        return torch.log1p(excess_residuals(log_p, weight, log_best).square().sum(0))


class ForwardKL(Objective):
    """The divergence `KL(P* | p)`: the cross entropy of maximum-likelihood fits. Milder than the excess on missing
    tails."""

    name = "forward_kl"

    def residuals(self, log_p: Tensor, weight: Tensor, log_best: Tensor) -> Tensor:
        return divergence_residuals(log_p, weight, log_best)


class VarianceCost(Objective):
    """Relative variance of one sample times its cost: what decides the time to a given error.

    `(M / |I|^2 - 1) * cost = cost / grey * (excess + 1 - grey)` with `grey = |I|^2 / M*`: a sum of squares too.

    Args:
        cost: cost of one sample, e.g. in microseconds: a positive number, or a function (proposal, context) -> scalar
            that may depend on the proposal's parameters, differentiably; or a sequence of costs, one per component of
            a mixture (the defensive share, its last component, costs nothing if left out), weighted by
            `proposal(context).log_weights`.
        base: cost to add for what every sample needs (evaluating integrand and visibility).
    """

    name = "variance_cost"

    def __init__(
        self, cost: float | Callable[[Any, Context], Tensor | float] | Sequence[float] = 1.0, base: float = 0.0
    ):
        if not callable(cost):
            costs = torch.as_tensor(cost, dtype=torch.float64)
            if not bool((costs >= 0).all()) or not bool(torch.isfinite(costs).all()) or base + float(costs.sum()) <= 0:
                raise InputError("cost", cost, "positive numbers or a function of (proposal, context)")
        self.cost, self.base = cost, base

    def residuals(self, log_p: Tensor, weight: Tensor, log_best: Tensor) -> Tensor:
        return excess_residuals(log_p, weight, log_best)

    def cost_of(self, proposal: Any, context: Context) -> Tensor | float:
        """Cost of one sample of this proposal."""
        if callable(self.cost):
            return self.base + self.cost(proposal, context)
        costs = torch.as_tensor(self.cost, dtype=torch.float64)
        if costs.ndim == 0:
            return self.base + float(costs)
        log_shares = getattr(proposal(context), "log_weights", None)
        if log_shares is None:
            raise InputError("cost", self.cost, "a number or a function, since the proposal is no mixture")
        if log_shares.shape[-1] not in (len(costs), len(costs) + 1):
            raise InputError(
                "cost", self.cost, f"one number for each component, {log_shares.shape[-1]} with the defensive one"
            )
        return self.base + (log_shares.exp()[..., : len(costs)] * costs.to(log_shares)).sum(-1)

    def factor(self, proposal: Any, target: Target) -> Tensor | float:
        return self.cost_of(proposal, target.context) / target.grey

    def offset(self, target: Target) -> float:
        return 1.0 - target.grey


OBJECTIVES: dict[str, Callable[[], Objective]] = {cls.name: cls for cls in (Excess, LogExcess, ForwardKL, VarianceCost)}
"""Objectives by name, as made without arguments."""


def objective_named(objective: str | Objective) -> Objective:
    """The objective itself, or the one of that name."""
    if isinstance(objective, Objective):
        return objective
    return OBJECTIVES[check_choice("objective", objective, tuple(OBJECTIVES))]()
