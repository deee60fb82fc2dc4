"""What a stiff problem is: how to solve it, and how to judge a point without the code that the solver used."""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor, nn

from dsfit.context import Context
from dsfit.fit.fit import REACH, fit, make_targets
from dsfit.fit.objectives import Excess, ForwardKL, LogExcess, Objective, Target, VarianceCost
from dsfit.fit.problem import FunctionProblem, Problem
from dsfit.fit.proposal_problem import Parameters, ProposalProblem
from dsfit.fit.solvers import SOLVERS, minimise
from dsfit.fit.tracking import SolverResult
from dsfit.quality import Nodes

TOLERANCE = 1e-4
"""Relative tolerance of every solve here."""
MAX_STEPS = {"optimistix.bfgs": 150, "torch.lbfgs": 100, "torch.adam": 200, "optimistix.nelder_mead": 400}
"""Limits on steps that differ from the solvers' own, to keep the whole quick. Steps, not seconds, end most solves, so
that results do not depend on how busy the machine is."""
COSTS, BASE_COST = (1.0, 3.0), 1.0
"""Costs of the components and of every sample, for `variance_cost`."""


class Overrun(BaseException):
    """Raised inside a solver that goes on evaluating long after its time was up; no numerical failure, so that the
    library does not take it for one."""


@dataclass(frozen=True)
class Limits:
    """What a solver is allowed: seconds it is told of, seconds after which the guard ends it, and steps (`MAX_STEPS`
    or the solver's own limit if left out)."""

    seconds: float = 20.0
    guard_seconds: float = 60.0
    steps: int | None = None


@dataclass
class Solved:
    """What came back: the solver's result, and the proposal where there is one."""

    result: SolverResult
    proposal: nn.Module | None = None
    excess: float | None = None


@dataclass
class Case:
    """One problem with one objective.

    Attributes:
        name, objective: what is minimised; the objective is "" for toys.
        start: parameters at the start, [P].
        solve: (solver, limits) to what came back.
        value: parameters to the objective, by the plain formula and plain autograd; not the solver's code.
        model: residuals and Jacobian, from which trial steps are taken (the objective itself is used to judge them).
        optimum: least value where it is known.
        reach: longest trial step of one parameter.
        solvers: the only solvers to try it with, or None.
        refuses: field of the `InputError` that is the right answer, where there is nothing to minimise.
        mass: proposal to `int p`, None for toys.
    """

    name: str
    objective: str
    start: Tensor
    solve: Callable[[str, Limits], Solved]
    value: Callable[[Tensor], Tensor]
    model: Problem | None
    optimum: float | None = None
    reach: float = math.inf
    refuses: str | None = None
    solvers: tuple[str, ...] | None = None
    mass: Callable[[nn.Module], float] | None = None


def options_of(solver: str, limits: Limits) -> dict[str, Any]:
    """Limits as the keyword arguments of `minimise` and `fit`."""
    return {"max_steps": limit_of(solver, limits), "max_seconds": limits.seconds, "tolerance": TOLERANCE}


def limit_of(solver: str, limits: Limits) -> int:
    """Most steps that the solver may take."""
    return MAX_STEPS.get(solver, SOLVERS[solver].max_steps) if limits.steps is None else limits.steps


@dataclass
class Guard:
    """Raises `Overrun` once a solve has gone on for too long."""

    seconds: float
    started: float = field(default_factory=time.perf_counter)

    def __call__(self, *_: Any) -> None:
        if time.perf_counter() - self.started > self.seconds:
            raise Overrun(f"still evaluating after {self.seconds:g} s")


def toy_case(name: str, residuals: Callable[[Tensor], Tensor], start: Tensor, optimum: float) -> Case:
    """A least-squares problem with a known optimum, through `minimise`."""

    def value(y: Tensor) -> Tensor:
        return residuals(y).square().sum()

    def solve(solver: str, limits: Limits) -> Solved:
        guard = Guard(limits.guard_seconds)

        def guarded(y: Tensor) -> Tensor:
            guard()
            return residuals(y)

        return Solved(minimise(guarded, start, solver, **options_of(solver, limits)))

    return Case(name, "", start, solve, value, FunctionProblem(residuals, start), optimum)


def objective_of(name: str, components: int = 2) -> Objective:
    """The objective, with costs that make `variance_cost` depend on the weights of the mixture."""
    if name == "variance_cost":
        return VarianceCost(COSTS[:components], BASE_COST)
    return {"excess": Excess, "log_excess": LogExcess, "forward_kl": ForwardKL}[name]()


def plain_objective(name: str, proposal: nn.Module, target: Target, components: int) -> Tensor:
    """The objective from densities by its definition (module text of `dsfit.fit.objectives`), no residuals."""
    p, best, w = proposal(target.context).log_prob(target.omega).exp(), target.log_best.exp(), target.weight
    if name == "forward_kl":
        ratio = torch.where(best > 0, best / p, 1.0)
        return (w * (best * torch.log(ratio) - best + p)).sum()
    excess = (w * (best - p) ** 2 / p).sum()
    if name == "log_excess":
        return torch.log1p(excess)
    if name == "variance_cost":
        shares = proposal(target.context).log_weights.exp()
        costs = torch.tensor(COSTS[:components], dtype=torch.float64)  # the defensive share costs nothing
        cost = BASE_COST + (shares[:components] * costs).sum()
        return cost * (excess + 1 - target.grey) / target.grey
    return excess


def fit_case(
    name: str,
    objective: str,
    proposal: nn.Module,
    integrand: Callable[[Tensor, Context], Tensor] | None,
    context: Context,
    nodes: Nodes,
    mass: Callable[[nn.Module], float],
    optimum: float | None = None,
    components: int = 2,
) -> Case:
    """A fit of a proposal, through `fit`, judged on the same nodes."""
    wanted = objective_of(objective, components)
    (target,) = make_targets(integrand, context, nodes, 1e-3, None)
    scratch = copy.deepcopy(proposal).double()
    parameters = Parameters(scratch)
    start = parameters.vector(scratch)

    def value(y: Tensor) -> Tensor:
        class Evaluate(nn.Module):
            def __init__(self) -> None:
                super().__init__()
                self.proposal = scratch

            def forward(self) -> Tensor:
                return plain_objective(objective, self.proposal, target, components)

        named = {f"proposal.{key}": part for key, part in parameters.split(y).items()}
        return torch.func.functional_call(Evaluate(), named, ())

    def solve(solver: str, limits: Limits) -> Solved:
        watched = copy.deepcopy(proposal)
        hook = watched.register_forward_pre_hook(Guard(limits.guard_seconds))
        found = fit(watched, integrand, context, wanted, solver, nodes=nodes, **options_of(solver, limits))
        hook.remove()
        return Solved(found.result, found.proposal, found.excess)

    model = ProposalProblem(scratch, [target], Excess() if objective == "log_excess" else wanted)
    return Case(name, objective, start, solve, value, model, optimum, REACH, mass=mass)


def refused_case(name: str, field: str, solve: Callable[[str, Limits], Solved]) -> Case:
    """A problem that has no answer, which has to be refused by an `InputError` naming `field`."""
    nothing = torch.zeros(1, dtype=torch.float64)
    return Case(name, "excess", nothing, solve, lambda y: y.sum(), None, refuses=field)


def theta_panels(proposal: nn.Module, context: Context, extra: Sequence[float] = ()) -> Tensor:
    """Increasing inclinations between which every component of a mixture is smooth: quantiles of its own samples."""
    u = torch.linspace(0, 1, 33, dtype=torch.float64).clamp(1e-9, 1 - 1e-9)
    edges = [torch.tensor([-math.pi / 2, math.pi / 2, *extra], dtype=torch.float64)]
    with torch.no_grad():
        for component in getattr(proposal, "components", [proposal]):
            law = component.longitudinal(context)
            edges.append(law.sample(u).reshape(-1))
    found = torch.cat(edges).clamp(-math.pi / 2, math.pi / 2)
    return torch.unique(found)
