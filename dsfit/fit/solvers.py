"""One registry of solvers and one way to call them: `minimise(function, y0, solver="optimistix.lm")`."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from dsfit.errors import InputError, as_number, check_choice, check_finite
from dsfit.fit.problem import FunctionProblem, Problem, gauss_newton_gap
from dsfit.fit.tracking import MOST_SCALED, NUMERICAL, SolverResult, Tracker, relative_gap


@dataclass(frozen=True)
class Solver:
    """An entry of the registry.

    Attributes:
        name: "library.method".
        least_squares: whether it needs residuals; such a solver cannot minimise a plain scalar.
        max_steps: default limit.
        options: names of extra options it takes, with their defaults.
        module, function: where its implementation is, imported on first use (JAX only then).
    """

    name: str
    least_squares: bool
    max_steps: int
    module: str
    function: str
    options: dict[str, Any]

    def run(self, tracker: Tracker, **options: Any) -> SolverResult:
        """Run on a tracked problem."""
        implementation: Callable[..., SolverResult] = getattr(importlib.import_module(self.module), self.function)
        return implementation(self.name, tracker, **options)


_OPTIMISTIX, _TORCH = "dsfit.fit.optimistix_solvers", "dsfit.fit.torch_solvers"

_FLOOR = {"floor": 1e-8}

SOLVERS: dict[str, Solver] = {
    solver.name: solver
    for solver in (
        Solver("optimistix.lm", True, 100, _OPTIMISTIX, "least_squares", {**_FLOOR, "damping": 1e-3}),
        Solver("optimistix.gauss_newton", True, 100, _OPTIMISTIX, "least_squares", {**_FLOOR}),
        Solver("optimistix.dogleg", True, 100, _OPTIMISTIX, "least_squares", {**_FLOOR}),
        Solver("optimistix.bfgs", False, 500, _OPTIMISTIX, "bfgs", {**_FLOOR}),
        Solver("optimistix.nelder_mead", False, 10000, _OPTIMISTIX, "nelder_mead", {**_FLOOR, "simplex": 0.3}),
        Solver("torch.lbfgs", False, 500, _TORCH, "lbfgs", {**_FLOOR, "memory": 20}),
        Solver("torch.adam", False, 1000, _TORCH, "adam", {"rate": 0.05, "final_rate": 1e-3, "contexts": 0, "seed": 0}),
    )
}
"""All solvers by name."""


def solver_named(name: str, problem_is_least_squares: bool | None = None) -> Solver:
    """The solver of that name; raises `InputError` if there is none or it cannot take the problem."""
    solver = SOLVERS[check_choice("solver", name, tuple(SOLVERS))]
    if problem_is_least_squares is False and solver.least_squares:
        able = [other.name for other in SOLVERS.values() if not other.least_squares]
        raise InputError("solver", name, "for a function without residuals, one of " + ", ".join(map(repr, able)))
    return solver


def minimise(
    function: Problem | Callable[[Tensor], Tensor],
    y0: Tensor,
    solver: str = "optimistix.lm",
    *,
    max_steps: int | None = None,
    tolerance: float = 1e-6,
    absolute: float = 1e-14,
    max_seconds: float = float("inf"),
    reach: float = float("inf"),
    **options: Any,
) -> SolverResult:
    """Minimise a function of a parameter vector.

    Args:
        function: vector [P] to residuals [N], whose sum of squares is minimised, or to a scalar; or a `Problem`.
        y0: start, [P].
        solver: a name in `SOLVERS`. Those marked least-squares need residuals; the others take either.
        max_steps: limit on solver steps; the default depends on the solver.
        tolerance: converged when a step promises, or a few steps brought, a relative decrease of the value below this.
        absolute: ... or a decrease below this; also the value that counts as zero.
        max_seconds: wall time after which to stop, checked between steps.
        reach: the longest step of any one parameter over which a linear model is believed. Solvers that can refuse a
            longer one unevaluated, and the convergence of all is judged by what a step within reach promises.
        options: further options of the solver (`SOLVERS[name].options`): `floor` of the scales of the variables
            (`tracking.column_scale`); first `damping` relative to the largest element of J^T J; first edge of the
            `simplex`; `memory` of L-BFGS; first and final learning rate of Adam (`rate`, `final_rate`), and how many
            `contexts` to draw for each of its steps (0: all), with which `seed`.

    Returns:
        `SolverResult`; numerical failure is not an exception but a `reason`, with the best point seen.

    Raises:
        InputError: unknown solver or option, a solver that needs residuals for a scalar, `y0` not finite or without a
            finite value.
    """
    if y0.ndim != 1 or not len(y0):
        raise InputError("y0", tuple(y0.shape), "a vector of at least one parameter")
    tolerance = as_number("tolerance", tolerance, 0.0, open_low=True)
    if not reach > 0:
        raise InputError("reach", reach, "numbers > 0")
    if max_steps is not None and (isinstance(max_steps, bool) or not isinstance(max_steps, int) or max_steps < 0):
        raise InputError("max_steps", max_steps, "integers >= 0")
    start = check_finite("y0", y0.detach().to("cpu", torch.float64))
    problem = function if isinstance(function, Problem) else FunctionProblem(function, start)
    entry = solver_named(solver, problem.least_squares)
    unknown = sorted(set(options) - set(entry.options))
    if unknown:
        raise InputError("options", unknown, f"options of {solver}: {sorted(entry.options) or 'none'}")
    tracker = Tracker(problem, start, max_seconds)
    limit = entry.max_steps if max_steps is None else max_steps
    limits = {"max_steps": limit, "tolerance": tolerance, "absolute": absolute}
    if entry.least_squares:
        limits["reach"] = reach
    result = entry.run(tracker, **limits, **{**entry.options, **options})
    return _judged(result, tracker, tolerance, absolute, reach)


def _judged(
    result: SolverResult, tracker: Tracker, tolerance: float, absolute: float, reach: float = float("inf")
) -> SolverResult:
    """Judge the results of all solvers alike by what a Gauss-Newton step from the best point promises, where there is
    such a model.

    Stopped for lack of progress is not converged if that is more than sqrt(tolerance); stopped otherwise is converged
    if it is less than the tolerance.
    """
    problem = tracker.problem
    if len(result.y) > MOST_SCALED or not (problem.least_squares or problem.gauss_newton):
        return result
    if problem.least_squares and result.value <= absolute:
        return result
    if not problem.least_squares:
        gap = _scalar_gap(problem, result, absolute, reach)
        if gap is None:
            return result
        result = replace(result, gap=gap)
    elif result.gap is None or not torch.equal(result.y, tracker.linearised_at):
        _, residuals, jacobian = tracker.linearise(result.y)
        result = replace(result, gap=relative_gap(residuals, jacobian, absolute, reach))
    assert result.gap is not None
    if result.converged and not result.gap <= tolerance**0.5:
        reason = f"{result.reason}; yet a Gauss-Newton step from the best point promises {result.gap:.1e}"
        return replace(result, converged=False, reason=reason)
    if not result.converged and result.gap <= tolerance:
        reason = f"{result.reason}; but a Gauss-Newton step from the best point promises only {result.gap:.1e}"
        return replace(result, converged=True, reason=reason)
    return result


def _scalar_gap(problem: Problem, result: SolverResult, absolute: float, reach: float) -> float | None:
    """As `relative_gap`, for a scalar with a Gauss-Newton model; None where that has no value."""
    try:
        residuals, jacobian = problem.linearise(result.y)
    except NUMERICAL:
        return None
    tiny = torch.finfo(torch.float64).tiny
    return gauss_newton_gap(residuals, jacobian, reach=reach) / max(abs(result.value), absolute, tiny)
