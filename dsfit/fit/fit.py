"""`fit(proposal, integrand, context)`: the proposal of its family whose variance is least."""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor, nn

from dsfit.context import Context
from dsfit.errors import InputError, as_number, as_real, check_choice
from dsfit.fit.objectives import LOG_FLOOR, Objective, Target, excess_residuals, objective_named
from dsfit.fit.proposal_problem import Parameters, ProposalProblem
from dsfit.fit.solvers import minimise, solver_named
from dsfit.fit.tracking import HistoryEntry, SolverResult

AT_BOUND = 1e-3
"""Share of its range (of the logarithmic range, where both bounds are positive and a factor 100 apart) within which a
value is at a bound."""


REACH = 2.0
"""Longest step of a parameter in a fit, where one unit is one radian, one e-fold or one unit of a logit: longer steps
kill components of a mixture by throwing them where no derivative brings them back."""

NATURAL = {"floor": 0.1, "damping": 0.1}
"""Solver options of a fit. The parameters already have units of their own, so that their scales may differ by a factor
of 10 only: a component with a small share has small derivatives at the start, and in scales of its own it would be
thrown far away by the first steps."""


@dataclass(frozen=True)
class Fit:
    """A fitted proposal and how good it is, on the quadrature nodes.

    Attributes:
        proposal: the fitted copy, in the dtype of the one given; that one is unchanged.
        excess: `M / M* - 1` with the mass correction of `objectives`, never negative; mean over contexts. inf where the
            density vanishes at a node and the integrand does not; such a fit has not converged.
        largest_weight: `sup |F| / (p int |F|)` over nodes and contexts: the largest sample in units of the mean.
        mass: `int p` as the nodes see it, furthest from 1 over contexts; a fit whose mass is off hides lobes between
            the nodes.
        excesses: excess per context, of the shape of the context batch.
        at_bounds: dotted names of the learnable values within `AT_BOUND` of a bound, from the proposal's
            `constrained()`.
        result: the solver's result for the best start; `history` is its history.
        starts: results of all starts, the one as given first.
        seconds: wall time of everything but the quadrature nodes.
    """

    proposal: nn.Module
    excess: float
    largest_weight: float
    mass: float
    excesses: Tensor = field(repr=False)
    at_bounds: list[str]
    result: SolverResult = field(repr=False)
    starts: list[SolverResult] = field(repr=False)
    seconds: float

    @property
    def history(self) -> list[HistoryEntry]:
        """Best value after each step of the best start."""
        return self.result.history

    @property
    def converged(self) -> bool:
        """Whether the best start met a convergence criterion; `result.reason` says which, or why not."""
        return self.result.converged


def fit(
    proposal: nn.Module,
    integrand: Callable[[Tensor, Context], Tensor] | None,
    context: Context,
    objective: str | Objective = "excess",
    solver: str = "optimistix.lm",
    *,
    starts: int = 1,
    jitter: float = 0.3,
    seed: int = 0,
    nodes: Any = None,
    rtol: float = 1e-4,
    weights: Tensor | Sequence[float] | None = None,
    max_steps: int | None = None,
    tolerance: float = 1e-4,
    max_seconds: float = math.inf,
    reach: float = REACH,
    jacobian: str = "auto",
    **options: Any,
) -> Fit:
    """Fit a proposal's learnable parameters to an integrand.

    Args:
        proposal: module whose `proposal(context).log_prob(omega)` is differentiable in the parameters that require
            grad. Its defensive share is part of the density and stays. The fit runs in float64 on a copy, whatever the
            dtype of the proposal.
        integrand: `integrand(omega, context) -> [..., C]`; may be None if `nodes` are given.
        context: one context, or a batch [*batch] that one set of parameters is fitted to, by the mean of the objective.
        objective: name or `Objective`: "excess", "log_excess", "forward_kl", "variance_cost".
        solver: name in `SOLVERS`.
        starts: number of starts: the parameters as given, and copies moved by normal noise of std `jitter`; the best
            result wins.
        seed: seed of that noise.
        nodes: quadrature nodes with fields omega [Q, 2], weight [Q], value [Q, C], or such a triple; a list of them,
            in the order of the flattened batch, for a batch of contexts. Left out,
            `dsfit.quality.quadrature_nodes(integrand, context, rtol=rtol)` makes them.
        weights: positive weights of the contexts in the mean, of the batch's shape.
        max_steps, tolerance, reach: see `minimise`.
        max_seconds: wall time for all starts together.
        jacobian: "auto", "own", "reverse" or "forward"; see `ProposalProblem`.
        options: further options of the solver.

    Raises:
        InputError: unknown objective, solver or option; a proposal without learnable parameters or that cannot be
            copied; an integrand that is zero or not finite on the nodes; a start whose objective is not finite.

    Example:
        >>> import torch
        >>> import dsfit
        >>> from dsfit.proposals import GaussianLobe, Mixture, Product, UniformAzimuth
        >>> ridge = dsfit.FunctionIntegrand(lambda omega, context: torch.exp(-50 * (omega[..., :1] - 0.2) ** 2))
        >>> start = Mixture([Product(GaussianLobe(0.0, 0.2), UniformAzimuth())])
        >>> found = dsfit.fit(start, ridge, dsfit.Context(0.0), solver="torch.lbfgs")
        >>> [f"{float(dsfit.excess(ridge, p, dsfit.Context(0.0)).value):.2g}" for p in (start, found.proposal)]
        ['2.3', '0.035']
    """
    began = time.perf_counter()
    if isinstance(starts, bool) or not isinstance(starts, int) or starts < 1:
        raise InputError("starts", starts, "integers >= 1")
    if isinstance(seed, bool) or not isinstance(seed, int) or not 0 <= seed < 2**63:
        raise InputError("seed", seed, "integers in [0, 2^63)")
    jitter, max_seconds = as_number("jitter", jitter, 0.0), _seconds(max_seconds)
    methods = ("auto", "reverse", "forward", *(["own"] if hasattr(proposal, "log_prob_with_jacobian") else []))
    check_choice("jacobian", jacobian, methods)
    objective = objective_named(objective)
    defaults = {
        key: value for key, value in NATURAL.items() if key in solver_named(solver, objective.least_squares).options
    }
    options = {**defaults, **options}
    work = copied(proposal).double()
    parameters = Parameters(work)
    before = time.perf_counter()
    targets = make_targets(integrand, context, nodes, rtol, weights, parameters.device)
    began += time.perf_counter() - before
    problem = ProposalProblem(work, targets, objective, jacobian=jacobian)
    y0 = parameters.vector(work)
    generator = torch.Generator().manual_seed(seed)
    results: list[SolverResult] = []
    for number in range(starts):
        left = max_seconds - sum(result.seconds for result in results)
        if results and left <= 0:
            break
        noise = torch.randn(len(y0), generator=generator, dtype=torch.float64)
        start = y0 if number == 0 else y0 + jitter * noise
        try:
            limits = {"max_steps": max_steps, "tolerance": tolerance, "max_seconds": left, "reach": reach}
            results.append(minimise(problem, start, solver, **limits, **options))
        except InputError as error:
            # A moved start may have no finite value; the given one must.
            if number == 0 or error.field != "y0":
                raise
    best = min(results, key=lambda result: result.value)
    fitted = copied(proposal)
    parameters.assign(fitted, best.y)
    # What is reported is what is returned: after rounding to the proposal's own dtype.
    parameters.assign(work, parameters.vector(fitted))
    excesses, masses, largest, bare = quality(work, targets)
    if bare:
        best = replace(
            best,
            converged=False,
            reason=f"{best.reason}; yet the density vanishes at {bare} nodes where the integrand does not",
        )
    shares = torch.tensor([target.share for target in targets], dtype=torch.float64)
    return Fit(
        proposal=fitted,
        excess=float((shares * excesses).sum()),
        largest_weight=float(largest.max()),
        mass=float(masses[(masses - 1).abs().argmax()]),
        excesses=excesses.reshape(context.batch_shape),
        at_bounds=values_at_bounds(work),
        result=best,
        starts=results,
        seconds=time.perf_counter() - began,
    )


def copied(proposal: nn.Module) -> nn.Module:
    """A deep copy; `InputError` if the module cannot be copied or has no parameters to learn."""
    if not isinstance(proposal, nn.Module):
        raise InputError("proposal", type(proposal).__name__, "a torch module")
    try:
        return copy.deepcopy(proposal)
    except (RuntimeError, TypeError) as error:
        raise InputError("proposal", str(error), "a module that copy.deepcopy can copy") from error


def _seconds(limit: Any) -> float:
    return math.inf if isinstance(limit, float) and limit == math.inf else as_number("max_seconds", limit)


def _node_fields(nodes: Any) -> tuple[Tensor, Tensor, Tensor]:
    names = ("omega", "weight", "value")
    fields = nodes[:3] if isinstance(nodes, tuple | list) else [getattr(nodes, name, None) for name in names]
    if len(fields) != 3 or not all(isinstance(x, Tensor) for x in fields):
        raise InputError("nodes", nodes, "Nodes, or tensors omega [Q, 2], weight [Q], value [Q, C]")
    return tuple(fields)


def make_targets(
    integrand: Any, context: Context, nodes: Any, rtol: float, weights: Any, device: torch.device | None = None
) -> list[Target]:
    """One `Target` per context of the flattened batch; see `fit` for the arguments."""
    contexts = context.to(torch.float64).reshape(-1)
    if device is not None:
        contexts = contexts.to(device=device)
    count = len(contexts)
    if count == 0:
        raise InputError("context", tuple(context.batch_shape), "at least one context")
    if nodes is None:
        if integrand is None:
            raise InputError("integrand", None, "an integrand, or nodes")
        from dsfit.quality import quadrature_nodes

        each: Iterable[Any] = [quadrature_nodes(integrand, contexts[i], rtol=rtol) for i in range(count)]
    elif context.batch_shape == () and not (isinstance(nodes, list) and nodes and not isinstance(nodes[0], Tensor)):
        each = [nodes]
    elif not isinstance(nodes, Sequence):
        raise InputError("nodes", nodes, f"a list of one set for each of {count} contexts")
    else:
        each = list(nodes)
        if len(nodes) != count:
            raise InputError("nodes", f"{len(nodes)} sets", f"one set for each of {count} contexts")
    share = torch.full((count,), 1.0 / count, dtype=torch.float64)
    if weights is not None:
        given = as_real("weights", weights, torch.float64).reshape(-1)
        if len(given) != count or not bool(((given > 0) & torch.isfinite(given)).all()):
            raise InputError("weights", given.tolist(), f"{count} positive numbers")
        share = given / given.sum()
    targets = []
    for i, one in enumerate(each):
        fields = (x.to(contexts.device) for x in _node_fields(one))
        targets.append(Target.from_nodes(contexts[i], *fields, share=float(share[i])))
    return targets


@torch.no_grad()
def quality(proposal: nn.Module, targets: Sequence[Target]) -> tuple[Tensor, Tensor, Tensor, int]:
    """Excess, mass `int p` and largest weight `sup P* / p` of a float64 proposal, per target [B]; and the number of
    nodes where the integrand is not zero but the density is, or all but (below `LOG_FLOOR`): the excess is inf there.
    """
    rows, bare = [], 0
    for target in targets:
        log_p = proposal(target.context).log_prob(target.omega)
        residuals = excess_residuals(log_p, target.weight, target.log_best)
        seen = (target.weight > 0) & (target.log_best > -math.inf)
        largest = torch.exp((target.log_best - log_p)[seen].max())
        missed = int((seen & ~(log_p >= LOG_FLOOR)).sum())
        excess = math.inf if missed else float(residuals.square().sum())
        bare += missed
        rows.append([excess, float((target.weight * log_p.exp()).sum()), float(largest)])
    excess, mass, largest = torch.tensor(rows, dtype=torch.float64).unbind(-1)
    return excess, mass, largest, bare


@torch.no_grad()
def values_at_bounds(proposal: nn.Module) -> list[str]:
    """Names from `proposal.constrained() -> {name: (value, low, high)}` whose value, or an element of it, is at a
    bound; [] without."""
    constrained = getattr(proposal, "constrained", None)
    if constrained is None:
        return []
    names = []
    for name, (value, low, high) in constrained().items():
        value, low, high = (torch.as_tensor(x, dtype=torch.float64) for x in (value, low, high))
        if float(low) > 0 and float(high) >= 100 * float(low):
            value, low, high = value.log(), low.log(), high.log()
        place = (value - low) / (high - low)
        near = (place <= AT_BOUND) | (place >= 1 - AT_BOUND)
        if near.ndim == 0:
            names += [name] if bool(near) else []
        else:
            names += [f"{name}{index}" for index in near.nonzero().tolist()]
    return names
