"""Judging what a solver says by what can be shown.

A claim of convergence is tested by demonstration: from the point returned, a handful of damped Gauss-Newton and
gradient steps are taken and the objective, evaluated by its plain formula, says by how much each lowers it. What a
step brings counts up to what the slope there promises, `-g . s`, so that a leap over a ridge into a better valley is
not held against a solver that stands at a point of first order. If more than `FALSE_CLAIM` of the value remains, the
solver had not converged, whatever its criterion said. A step that is not found proves nothing: a pass means "no
first-order gain was found".
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from dsfit.checks.stiff_fits.cases import TOLERANCE, Case, Limits, Overrun, Solved, limit_of
from dsfit.errors import InputError
from dsfit.fit.problem import Problem
from dsfit.fit.solvers import SOLVERS

FALSE_CLAIM = 3 * TOLERANCE**0.5
"""Relative decrease by a single step that disproves convergence: three times what the library's own criterion lets
the linear model promise."""
NEGLIGIBLE = 1e-9
"""Share of the value at the start below which nothing is left to gain."""
MASS_ERROR = 1e-3
"""How far `int p` of a fitted proposal may be from 1; the cubature is good to 1e-5."""
AGREES = 1e-6
"""How far the value that is claimed may be from the plain formula at the same point, relative."""
SOLVED = 1e-3
"""Share of the way from the start to the optimum that may be left for a problem to count as solved."""


_WARM: set[tuple[str, int, bool]] = set()


@dataclass
class Examination:
    """What a solver did with a case.

    Attributes:
        faults: what is wrong, in words; empty is a pass.
        objective: best value, by the plain formula; NaN if nothing came back.
        start: value at the start.
        shown: relative decrease that one step from the result was shown to bring.
        gradient: norm of the gradient over the value, per unit of the parameters.
        reason, converged, steps, evaluations, seconds: what the solver says, and what it took.
        mass: `int p` of the fitted proposal.
        refused: whether an `InputError` said that there is nothing to solve.
        compared: whether `optimum` is only the best that any solver found.
    """

    case: str
    kind: str
    solver: str
    faults: list[str] = field(default_factory=list)
    objective: float = math.nan
    start: float = math.nan
    optimum: float | None = None
    shown: float = math.nan
    gradient: float = math.nan
    reason: str = ""
    converged: bool = False
    steps: int = 0
    evaluations: int = 0
    seconds: float = 0.0
    compile_seconds: float = 0.0
    mass: float = math.nan
    refused: bool = False
    compared: bool = False

    @property
    def solved(self) -> bool:
        """Whether the optimum was reached, or the refusal that was due."""
        if self.refused:
            return not self.faults
        if self.optimum is None or self.faults:
            return False
        return self.objective - self.optimum <= SOLVED * max(self.start - self.optimum, 0.0) + 1e-12

    def data(self) -> dict[str, Any]:
        """Plain numbers for tables."""
        return {**{k: v for k, v in self.__dict__.items() if k != "faults"}, "solved": self.solved}


def able(solver: str, case: Case) -> bool:
    """Whether a solver can take the case: least-squares solvers need residuals."""
    chosen = case.solvers is None or solver in case.solvers
    return chosen and not (case.objective == "log_excess" and SOLVERS[solver].least_squares)


def warm_up(case: Case, solver: str) -> None:
    """Compile the solver's programs for this case, one step, so that they count neither as its time nor against it."""
    key = (solver, len(case.start), case.objective == "log_excess")
    if key in _WARM or case.refuses is not None or not solver.startswith("optimistix."):
        return
    _WARM.add(key)
    try:
        case.solve(solver, Limits(math.inf, 600.0, 1))
    except Exception:  # it will do so again, where it is looked at
        return


def examine(case: Case, solver: str, limits: Limits) -> Examination:
    """Solve the case and judge what comes back."""
    warm_up(case, solver)
    seen = Examination(case.name, case.objective, solver, optimum=case.optimum)
    try:
        solved = case.solve(solver, limits)
    except InputError as error:
        seen.refused, seen.reason = True, str(error)
        if case.refuses is None or error.field != case.refuses:
            seen.faults.append(f"refused: {error}")
        return seen
    except Overrun as error:
        seen.faults.append(f"hangs: {error}")
        return seen
    except Exception as error:  # whatever a solver raises is what is looked for
        seen.faults.append(f"raised {type(error).__name__}: {error}")
        return seen
    if case.refuses is not None:
        seen.faults.append(f"{case.refuses} should have been refused")
        return seen
    judge_result(case, solver, solved, limits, seen)
    return seen


def judge_result(case: Case, solver: str, solved: Solved, limits: Limits, seen: Examination) -> None:
    """Compare everything a result says with what can be recomputed; fills `seen`."""
    result = solved.result
    seen.reason, seen.converged = result.reason, result.converged
    seen.steps, seen.evaluations = result.steps, result.evaluations
    seen.seconds, seen.compile_seconds = result.seconds, result.compile_seconds
    with torch.no_grad():
        seen.start = float(case.value(case.start))
    if not (bool(torch.isfinite(result.y).all()) and math.isfinite(result.value)):
        seen.faults.append("parameters or value not finite")
        return
    with torch.no_grad():
        seen.objective = float(case.value(result.y))
    uncovered = math.isinf(seen.start)
    if not uncovered and not abs(seen.objective - result.value) <= AGREES * abs(seen.objective) + 1e-13 * seen.start:
        seen.faults.append(f"claims the value {result.value:.6g}, which is {seen.objective:.6g}")
    if not seen.objective <= seen.start * (1 + 1e-9) + 1e-300:
        seen.faults.append(f"ends at {seen.objective:.6g}, worse than its start {seen.start:.6g}")
    if result.steps > limit_of(solver, limits):
        seen.faults.append(f"took {result.steps} steps, allowed were {limit_of(solver, limits)}")
    if result.seconds - result.compile_seconds > limits.guard_seconds:
        seen.faults.append(f"took {result.seconds:.1f} s, allowed were {limits.seconds:g}")
    seen.faults += _reason_faults(case, solver, result, limits)
    if math.isinf(seen.objective):
        if result.converged or "vanishes" not in result.reason:
            seen.faults.append("the objective is infinite, and the reason does not say so")
    else:
        _judge_convergence(case, result.y, result.converged, seen)
    _judge_proposal(case, solved, seen)


def _reason_faults(case: Case, solver: str, result: Any, limits: Limits) -> list[str]:
    reason, faults = result.reason, []
    if not reason.strip():
        return ["gives no reason"]
    if reason.startswith("max_steps") and result.steps != limit_of(solver, limits):
        faults.append(f"says max_steps after {result.steps} of {limit_of(solver, limits)} steps")
    if reason.startswith("max_seconds") and result.seconds < limits.seconds:
        faults.append(f"says max_seconds after {result.seconds:.2g} s")
    if reason.startswith("the value is zero") and not result.value <= 1e-13:
        faults.append(f"says the value is zero where it is {result.value:.3g}")
    if reason.startswith("the gradient is zero"):
        gradient = gradient_of(case.value, result.y)
        reach = case.reach if math.isfinite(case.reach) else 1.0
        if float(gradient.abs().sum()) * reach > 1e-6 * abs(result.value):
            faults.append(f"says the gradient is zero where its norm is {float(gradient.norm()):.3g}")
    return faults


def _judge_convergence(case: Case, y: Tensor, converged: bool, seen: Examination) -> None:
    gradient = gradient_of(case.value, y)
    seen.gradient = float(gradient.norm()) / max(abs(seen.objective), 1e-300)
    floor = NEGLIGIBLE * seen.start
    if seen.objective <= floor or case.model is None:
        seen.shown = 0.0
        return
    seen.shown = shown_gain(case.value, case.model, y, gradient, case.reach) / seen.objective
    if converged and seen.shown > FALSE_CLAIM:
        seen.faults.append(f"claims to have converged, but one step lowers the value by {seen.shown:.1%}")


def _judge_proposal(case: Case, solved: Solved, seen: Examination) -> None:
    if case.mass is None or solved.proposal is None:
        return
    finite = all(bool(torch.isfinite(p).all()) for p in solved.proposal.parameters())
    if not finite or solved.excess is None or math.isnan(solved.excess):
        seen.faults.append("the fitted proposal has parameters or an excess that are not numbers")
        return
    seen.mass = case.mass(solved.proposal)
    if not abs(seen.mass - 1) <= MASS_ERROR:
        seen.faults.append(f"the fitted proposal has mass {seen.mass:.6g}")


def gradient_of(value: Callable[[Tensor], Tensor], y: Tensor) -> Tensor:
    """Gradient by reverse mode through the plain formula; zeros where it does not depend on y or is not finite."""
    y = y.detach().clone().requires_grad_()
    with torch.enable_grad():
        out = value(y)
        if not out.requires_grad:
            return torch.zeros_like(y)
        (gradient,) = torch.autograd.grad(out, y, allow_unused=True)
    return torch.zeros_like(y) if gradient is None else torch.nan_to_num(gradient, 0.0, 0.0, 0.0).detach()


def shown_gain(value: Callable[[Tensor], Tensor], model: Problem, y: Tensor, gradient: Tensor, reach: float) -> float:
    """The most by which one step from `y` lowers the value, each step counting up to the promise of the slope."""
    most = 0.0
    with torch.no_grad():
        here = float(value(y))
        for step in _trial_steps(model, y, gradient, reach):
            promise = -float(gradient @ step)
            if promise > most:
                there = float(value(y + step))
                most = max(most, min(promise, here - there)) if math.isfinite(there) else most
    return most


def _trial_steps(model: Problem, y: Tensor, gradient: Tensor, reach: float) -> list[Tensor]:
    steps: list[Tensor] = []
    residuals, jacobian = model.linearise(y)
    if bool(torch.isfinite(residuals).all() & torch.isfinite(jacobian).all()) and bool((jacobian != 0).any()):
        length = jacobian.norm(dim=0)
        for scale in (torch.full_like(length, float(length.max())), length.clamp_min(1e-12 * float(length.max()))):
            for exponent in (-12, -8, -6, -4, -3, -2, -1, 0):
                matrix = torch.cat([jacobian / scale, torch.eye(len(y), dtype=y.dtype) * 10 ** (exponent / 2)])
                right = torch.cat([-residuals, torch.zeros_like(y)])
                steps.append(torch.linalg.lstsq(matrix, right[:, None], driver="gelsd").solution[:, 0] / scale)
    size = float(gradient.abs().max())
    if size > 0:
        longest = reach if math.isfinite(reach) else max(1.0, float(y.abs().max()))
        steps += [-gradient / size * longest * 10.0**-k for k in range(8)]
    shrunk = []
    for step in steps:
        largest = float(step.abs().max())
        if math.isfinite(largest):
            shrunk.append(step * min(1.0, reach / largest) if largest > 0 else step)
    return shrunk
