"""What every solver shares: its result, its history, and a recorder that keeps the best point and turns failures into
reasons."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dsfit.errors import InputError, check_finite
from dsfit.fit.problem import Problem, gauss_newton_gap

NUMERICAL = (ArithmeticError, ValueError, RuntimeError)
"""Exceptions of a function under minimisation that mean "no value here"; any other is a mistake in the program and is
passed on."""


MOST_SCALED = 256
"""Number of parameters up to which a solver that needs no Jacobian may yet ask for one, to scale its variables or to
judge its result."""


class HistoryEntry(NamedTuple):
    """State after one solver step: evaluations so far, best value so far, seconds since the start."""

    step: int
    evaluations: int
    value: float
    seconds: float


@dataclass(frozen=True)
class SolverResult:
    """What a solver found.

    Attributes:
        y: best parameters ever evaluated, [P] float64; always finite.
        value: the value there: `sum r^2` for least squares.
        steps: steps taken, rejected ones included.
        evaluations: calls of the function, those with derivatives included.
        derivatives: how many of these computed a gradient or Jacobian.
        converged: whether a convergence criterion was met; `reason` says which, or what stopped the solver instead.
        gap: share of the value by which a Gauss-Newton step from the best point, no longer than `reach`, promises to
            lower it (least-squares problems only).
        history: one entry per step.
        seconds: wall time, compilation included; `compile_seconds` of them went into compiling JAX programs.
    """

    solver: str
    y: Tensor
    value: float
    steps: int
    evaluations: int
    derivatives: int
    converged: bool
    reason: str
    gap: float | None
    history: list[HistoryEntry] = field(repr=False)
    seconds: float = 0.0
    compile_seconds: float = 0.0


class Tracker:
    """A `Problem` as solvers call it: counts, times, remembers the best point, never raises for a numerical failure.

    A point where the function is non-finite or raises one of `NUMERICAL` has value inf. Any other exception is stored
    in `fatal` and raised by `check`, because it must not travel through JAX or torch.optim.

    Raises:
        InputError: `y0` is not finite, or the function is not finite there.
    """

    def __init__(self, problem: Problem, y0: Tensor, max_seconds: float = float("inf")) -> None:
        self.problem, self.max_seconds = problem, max_seconds
        self.y0 = check_finite("y0", y0.detach().to("cpu", torch.float64).clone())
        self.started = time.perf_counter()
        self.evaluations = self.derivatives = self.bad = 0
        self.compile_seconds = self.asked_seconds = 0.0
        self.last_error, self.fatal = "", None
        self.history: list[HistoryEntry] = []
        self.best_y = self.y0
        self.linearised_at = torch.full_like(self.y0, torch.nan)
        self.best_value = self.start = self._ask(problem.value, self.y0)
        if not abs(self.start) < float("inf"):
            raise InputError("y0", self.start, "a start at which the function has a finite value")
        self.record(0)

    @property
    def seconds(self) -> float:
        """Seconds since the start."""
        return time.perf_counter() - self.started

    @property
    def expired(self) -> bool:
        """Whether the time allowed has passed."""
        return self.seconds >= self.max_seconds

    def check(self) -> None:
        """Raise what the function raised, if that was no numerical failure."""
        if self.fatal is not None:
            raise self.fatal

    def record(self, step: int) -> None:
        """Append to the history."""
        self.history.append(HistoryEntry(step, self.evaluations, self.best_value, self.seconds))

    def _note(self, y: Tensor, value: float) -> float:
        if value < self.best_value:
            self.best_y, self.best_value = y.clone(), value
        return value

    def _fail(self, error: BaseException | None) -> None:
        self.bad += 1
        if error is not None and not isinstance(error, NUMERICAL):
            self.fatal = self.fatal or error
        elif error is not None:
            self.last_error = f"{type(error).__name__}: {error}".splitlines()[0]

    def _ask(self, what: Callable[[Tensor], Any], y: Tensor) -> Any:
        self.evaluations += 1
        started = time.perf_counter()
        try:
            return what(y)
        finally:
            self.asked_seconds += time.perf_counter() - started

    def value(self, y: Tensor) -> float:
        """The value at `y`; inf where it fails."""
        try:
            value = self._ask(self.problem.value, y)
        except BaseException as error:  # noqa: B036 - stored, and raised again by check()
            self._fail(error)
            return float("inf")
        if not abs(value) < float("inf"):
            self._fail(None)
            return float("inf")
        return self._note(y, value)

    def gradient(self, y: Tensor) -> tuple[float, Tensor]:
        """Value and gradient at `y`; inf and zeros where either fails."""
        self.derivatives += 1
        try:
            value, gradient = self._ask(self.problem.gradient, y)
            gradient = gradient.detach().to("cpu", torch.float64)
        except BaseException as error:  # noqa: B036 - stored, and raised again by check()
            self._fail(error)
            return float("inf"), torch.zeros_like(y)
        if not (abs(value) < float("inf") and bool(torch.isfinite(gradient).all())):
            self._fail(None)
            return float("inf"), torch.zeros_like(y)
        return self._note(y, value), gradient

    def sampled_gradient(self, y: Tensor, count: int, generator: torch.Generator) -> Tensor | None:
        """A gradient [P] from `count` contexts; None where it fails. Neither counts as a value, nor as best."""
        self.derivatives += 1
        try:
            value, gradient = self._ask(lambda y: self.problem.sampled_gradient(y, count, generator), y)
            gradient = gradient.detach().to("cpu", torch.float64)
        except BaseException as error:  # noqa: B036 - stored, and raised again by check()
            self._fail(error)
            return None
        if not (abs(value) < float("inf") and bool(torch.isfinite(gradient).all())):
            self._fail(None)
            return None
        return gradient

    def linearise(self, y: Tensor) -> tuple[float, Tensor, Tensor]:
        """Value, compressed residuals and Jacobian at `y`; inf and zeros where any fails."""
        self.derivatives += 1
        bad = (
            float("inf"),
            torch.zeros(len(y) + 1, dtype=torch.float64),
            torch.zeros(len(y) + 1, len(y), dtype=torch.float64),
        )
        try:
            residuals, jacobian = (x.detach().to("cpu", torch.float64) for x in self._ask(self.problem.linearise, y))
        except BaseException as error:  # noqa: B036 - stored, and raised again by check()
            self._fail(error)
            return bad
        value = float(residuals.square().sum())
        if not (value < float("inf") and bool(torch.isfinite(jacobian).all())):
            self._fail(None)
            return bad
        self.linearised_at = y.clone()
        return self._note(y, value), residuals, jacobian

    def result(self, solver: str, steps: int, converged: bool, reason: str, gap: float | None = None) -> SolverResult:
        """The result, with the best point seen; the reason tells of failed evaluations too."""
        self.check()
        if self.bad:
            reason += f"; {self.bad} of {self.evaluations} evaluations had no finite value"
            reason += f" (last error: {self.last_error})" if self.last_error else ""
        return SolverResult(
            solver=solver, y=self.best_y, value=self.best_value, steps=steps, evaluations=self.evaluations,
            derivatives=self.derivatives, converged=converged, reason=reason, gap=gap, history=self.history,
            seconds=self.seconds, compile_seconds=self.compile_seconds,
        )  # fmt: skip


class Stall:
    """Convergence by lack of progress: the value fell by less than `tolerance * |value| + absolute` over the last
    `window` steps."""

    def __init__(self, value: float, window: int, tolerance: float, absolute: float) -> None:
        self.values, self.window, self.tolerance, self.absolute = [value], window, tolerance, absolute

    def __call__(self, value: float) -> bool:
        """Note the value after one more step; whether progress has stalled."""
        self.values.append(value)
        if len(self.values) <= self.window:
            return False
        return self.values[-self.window - 1] - value <= self.tolerance * abs(value) + self.absolute


def relative_gap(residuals: Tensor, jacobian: Tensor, absolute: float, reach: float = float("inf")) -> float:
    """`gauss_newton_gap` as a share of the value, which is floored by `absolute`."""
    value = float(residuals.square().sum())
    return gauss_newton_gap(residuals, jacobian, reach=reach) / max(value, absolute, torch.finfo(torch.float64).tiny)


def column_scale(jacobian: Tensor, floor: float) -> Tensor:
    """Scales d [P] of the variables `z = d (y - y0)`: the lengths of the columns of the first Jacobian, at least
    `floor` times the longest.

    So the units of the parameters do not matter, and yet a parameter that has hardly any effect at the start is not
    thrown to infinity.
    """
    length = jacobian.norm(dim=0)
    return length.clamp_min(floor * float(length.max()))


def scalar_scales(tracker: Tracker, floor: float) -> tuple[Tensor, float] | None:
    """For a solver of scalars: scales of the variables and of the value, or None where the gradient is zero.

    With residuals, `z = d (y - y0) / sqrt(value)` and objective = value / (2 first value), so that the Gauss-Newton
    Hessian has a unit diagonal and the objective starts at 1/2. Without, or with too many parameters for a Jacobian,
    the first gradient gets unit length.
    """
    value, y0 = tracker.start, tracker.y0
    if tracker.problem.least_squares and len(y0) <= MOST_SCALED:
        at, _, jacobian = tracker.linearise(y0)
        if at < float("inf"):
            return (column_scale(jacobian, floor) / value**0.5, 2 * value) if bool((jacobian != 0).any()) else None
    at, gradient = tracker.gradient(y0)
    length = float(gradient.norm())
    return (torch.ones_like(y0), length) if length > 0 else None
