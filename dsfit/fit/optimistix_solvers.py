"""Optimistix's solvers on torch functions, one jitted step at a time.

Each step is one compiled JAX program that asks torch once, through the bridge, for value and (compressed) Jacobian.
Programs are compiled once per solver and number of parameters (padded to a multiple of 8 by parameters without
effect), because the torch function behind the bridge is an argument (a token), not a constant. The loop over steps is
Python's: it records history, applies the criteria below, and obeys limits of time and Ctrl-C.

Variables are scaled (`tracking.column_scale`). Residuals are scaled by one factor, such that optimistix's first
Levenberg-Marquardt parameter, which is always 1, equals `damping` times the largest diagonal element of J^T J (Madsen,
Nielsen and Tingleff 2004, section 3.2).

Convergence of the least-squares solvers, at an accepted point: the undamped Gauss-Newton step, no longer than `reach`,
promises a relative decrease of the value below `tolerance`, or the value is below `absolute`, or five accepted steps
together brought less than that. For all solvers: optimistix's own test, made so strict that it means "no further step
possible in float64".
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
import torch
from torch import Tensor
from torch.nn.functional import pad

from dsfit.fit import bridge
from dsfit.fit.tracking import SolverResult, Stall, Tracker, column_scale, relative_gap, scalar_scales

_EPS = 1e-15  # rtol and atol of optimistix's own convergence test
_TRUST = optx.ClassicalTrustRegion(high_cutoff=0.75, low_cutoff=0.01, high_constant=5.0, low_constant=0.25)


class _LevenbergMarquardt(optx.AbstractGaussNewton):
    """optimistix's Levenberg-Marquardt with a damping that falls as soon as the model is good to 75% (there: 99%)."""

    rtol: float = _EPS
    atol: float = _EPS
    norm: Any = optx.max_norm
    descent: Any = optx.DampedNewtonDescent(linear_solver=lx.QR())
    search: Any = _TRUST
    verbose: Any = staticmethod(lambda **kwargs: None)


class _Dogleg(optx.AbstractGaussNewton):
    """optimistix's dogleg with the same trust region; SVD, because QR cannot take a rank-deficient Jacobian."""

    rtol: float = _EPS
    atol: float = _EPS
    norm: Any = optx.max_norm
    descent: Any = optx.DoglegDescent(linear_solver=lx.SVD())
    search: Any = _TRUST
    verbose: Any = staticmethod(lambda **kwargs: None)


class _NelderMead(optx.NelderMead):
    """optimistix's Nelder-Mead with two repairs.

    Version 0.1 builds a degenerate first simplex for a vector of parameters (its vertices repeat): here it has edges
    `adelta` along the axes. And it reads the best and the worst vertex from the simplex before the update: they are
    read again after it.
    """

    def init(self, fn: Any, y: Any, args: Any, options: Any, f_struct: Any, aux_struct: Any, tags: Any) -> Any:
        state = super().init(fn, y, args, options, f_struct, aux_struct, tags)
        simplex = y + self.adelta * jnp.eye(len(y) + 1, len(y), -1)
        return eqx.tree_at(lambda s: s.simplex, state, simplex)

    def step(self, fn: Any, y: Any, args: Any, options: Any, state: Any, tags: Any) -> tuple[Any, Any, Any]:
        simplex, state, aux = super().step(fn, y, args, options, state, tags)
        best, worst = (state.simplex[index] for index in (state.best[2], state.worst[2]))
        return simplex, eqx.tree_at(lambda s: (s.best[1], s.worst[1]), state, (best, worst)), aux


_SOLVERS: dict[str, Callable[[], Any]] = {
    "optimistix.lm": _LevenbergMarquardt,
    "optimistix.dogleg": _Dogleg,
    "optimistix.gauss_newton": lambda: optx.GaussNewton(_EPS, _EPS, linear_solver=lx.SVD()),
    "optimistix.bfgs": lambda: optx.BFGS(_EPS, _EPS),
    "optimistix.nelder_mead": lambda: _NelderMead(_EPS, _EPS, rdelta=0.0, adelta=1.0),
}


@functools.cache
def _programs(name: str, size: int, outputs: int | None) -> tuple[Any, Any]:
    """Compiled `init(z, token) -> state` and `step(z, state, token) -> (z, state, flags)`; flags = (terminate, failed,
    accepted steps)."""
    solver = _SOLVERS[name]()
    call = bridge.call(outputs)
    struct = jax.ShapeDtypeStruct(() if outputs is None else (outputs,), np.float64)
    no_tags: frozenset[object] = frozenset()

    def fn(z: jax.Array, token: jax.Array) -> tuple[jax.Array, None]:
        return call(z, token), None

    @eqx.filter_jit
    def init(z: jax.Array, token: jax.Array) -> Any:
        return solver.init(fn, z, token, {}, struct, None, no_tags)

    @eqx.filter_jit
    def step(z: jax.Array, state: Any, token: jax.Array) -> tuple[jax.Array, Any, jax.Array]:
        z, state, _ = solver.step(fn, z, token, {}, state, no_tags)
        terminate, result = solver.terminate(fn, z, token, {}, state, no_tags)
        failed = (result != optx.RESULTS.successful) | ~jnp.isfinite(z).all()
        accepted = getattr(state, "num_accepted_steps", jnp.array(0))
        return z, state, jnp.stack([terminate.astype(int), failed.astype(int), accepted.astype(int)])

    return init, step


Criterion = Callable[[bool, Any], str]
"""From (a new point was accepted, solver state) to the reason to stop as converged, or ""."""


def _padded(size: int) -> int:
    return -(-size // 8) * 8 if size <= 64 else -(-size // 64) * 64


def _loop(
    name: str, tracker: Tracker, fn: Any, jacobian: Any, vector: bool, max_steps: int, criterion: Criterion
) -> tuple[int, bool, str]:
    """Step from z = 0 until the criterion gives a reason or something else ends it; returns steps, converged, reason.

    `fn(z) -> value` and `jacobian(z) -> (value, Jacobian)`, where the value is P + 1 residuals (`vector`) or a scalar.
    """
    size = len(tracker.y0)
    extra = _padded(size) - size if jacobian is not None else 0
    rows = (0, extra) if vector else ()

    def padded_fn(z: Tensor) -> Tensor:
        return pad(fn(z[:size]), rows) if rows else fn(z[:size])

    def padded_jacobian(z: Tensor) -> tuple[Tensor, Tensor]:
        value, matrix = jacobian(z[:size])
        return (pad(value, rows) if rows else value), pad(matrix, (0, extra, *rows))

    init, step = _programs(name, size + extra, size + extra + 1 if vector else None)
    token = bridge.register(padded_fn, padded_jacobian)
    try:
        with bridge.x64(), jax.default_device(jax.devices("cpu")[0]):
            began, asked = time.perf_counter(), tracker.asked_seconds
            z, number = jnp.zeros(size + extra), np.uint32(token)
            state, before = init(z, number), 0
            # The first pass only evaluates the start: it is no step.
            for count in range(max_steps + 1):
                z, state, flags = step(z, state, number)
                terminate, failed, accepted = np.asarray(flags)
                tracker.check()
                if count == 0:
                    tracker.compile_seconds = time.perf_counter() - began - (tracker.asked_seconds - asked)
                else:
                    tracker.record(count)
                if reason := criterion(bool(accepted > before), state):
                    return count, True, reason
                before = accepted
                if failed:
                    said = optx.RESULTS[state.result] or "non-finite step"
                    return count, False, f"solver failed: {' '.join(said.split())}"
                if terminate:
                    return count, True, "no further step possible in float64"
                if tracker.expired:
                    return count, False, f"max_seconds reached ({tracker.max_seconds:g})"
            return max_steps, False, f"max_steps reached ({max_steps})"
    finally:
        bridge.release(token)


def least_squares(
    name: str,
    tracker: Tracker,
    *,
    max_steps: int,
    tolerance: float,
    absolute: float,
    floor: float,
    damping: float = 1e-3,
    reach: float = float("inf"),
) -> SolverResult:
    """Levenberg-Marquardt, Gauss-Newton, dogleg."""
    y0 = tracker.y0
    value, residuals, jacobian = tracker.linearise(y0)
    if not value < float("inf"):
        return tracker.result(name, 0, False, "the Jacobian at the start is not finite")
    if value <= absolute:
        return tracker.result(name, 0, True, "the value is zero", 0.0)
    if not bool((jacobian != 0).any()):
        return tracker.result(name, 0, True, "the gradient is zero", 0.0)
    scale, factor = column_scale(jacobian, floor), damping**-0.5  # the longest scaled column has length 1
    # Steps of these two are accepted only if the value falls, so a point above the accepted one needs no Jacobian.
    monotone = name != "optimistix.gauss_newton"
    latest = accepted = (torch.zeros_like(y0), value, residuals, jacobian)

    def ask(z: Tensor) -> tuple[Tensor, Tensor]:
        nonlocal latest
        if not torch.equal(z, latest[0]):
            y = y0 + z / scale
            far = float((y - y0 - accepted[0] / scale).abs().max()) > reach
            if monotone and (far or not tracker.value(y) <= accepted[1]):
                latest = (z, float("inf"), *(torch.zeros_like(x) for x in latest[2:]))
            else:
                latest = (z, *tracker.linearise(y))
        residuals = factor * latest[2]
        if latest[1] == float("inf"):
            residuals = residuals + float("inf")
        return residuals, factor * latest[3] / scale

    stall = Stall(value, 5, tolerance, absolute)
    gap: float | None = None

    def criterion(moved: bool, state: Any) -> str:
        nonlocal accepted, gap
        if not moved or latest[1] == float("inf"):
            return ""
        accepted = latest
        gap = relative_gap(accepted[2], accepted[3], absolute, reach)
        if accepted[1] <= absolute:
            return "the value is zero"
        if gap <= tolerance:
            return f"a Gauss-Newton step promises a relative decrease of {gap:.1e}"
        if stall(accepted[1]):
            return f"five steps lowered the value by less than {tolerance:g} of it"
        return ""

    steps, converged, reason = _loop(name, tracker, lambda z: ask(z)[0], ask, True, max_steps, criterion)
    return tracker.result(name, steps, converged, reason, gap)


def bfgs(
    name: str, tracker: Tracker, *, max_steps: int, tolerance: float, absolute: float, floor: float
) -> SolverResult:
    """BFGS with Armijo backtracking."""
    y0 = tracker.y0
    if tracker.problem.least_squares and tracker.start <= absolute:
        return tracker.result(name, 0, True, "the value is zero")
    scales = scalar_scales(tracker, floor)
    if scales is None:
        return tracker.result(name, 0, True, "the gradient is zero")
    scale, factor = scales
    latest = accepted = (torch.full_like(y0, torch.nan), float("inf"), torch.zeros_like(y0))

    def ask(z: Tensor) -> tuple[Tensor, Tensor]:
        nonlocal latest
        if not torch.equal(z, latest[0]):
            y = y0 + z / scale
            if accepted[1] < float("inf") and not tracker.value(y) <= accepted[1]:
                latest = (z, float("inf"), torch.zeros_like(z))
            else:
                latest = (z, *tracker.gradient(y))
        return torch.tensor(latest[1] / factor, dtype=torch.float64), latest[2] / scale / factor

    stall = Stall(tracker.start, 5, tolerance, absolute)

    def criterion(moved: bool, state: Any) -> str:
        nonlocal accepted
        if not moved or latest[1] == float("inf"):
            return ""
        accepted = latest
        if tracker.problem.least_squares and accepted[1] <= absolute:
            return "the value is zero"
        if not bool((accepted[2] != 0).any()):
            return "the gradient is zero"
        return f"five steps lowered the value by less than {tolerance:g} of it" if stall(accepted[1]) else ""

    steps, converged, reason = _loop(name, tracker, lambda z: ask(z)[0], ask, False, max_steps, criterion)
    return tracker.result(name, steps, converged, reason)


def nelder_mead(
    name: str, tracker: Tracker, *, max_steps: int, tolerance: float, absolute: float, floor: float, simplex: float
) -> SolverResult:
    """Nelder and Mead's simplex; `simplex` is its first edge in scaled variables. Uses values only (a gradient once,
    for the scales)."""
    y0 = tracker.y0
    scales = scalar_scales(tracker, floor)
    scale = (torch.ones_like(y0) if scales is None else scales[0]) / simplex  # the first edges have length 1

    def fn(z: Tensor) -> Tensor:
        return torch.tensor(tracker.value(y0 + z / scale), dtype=torch.float64)

    lowered, level, count = 0, float("inf"), 0

    def criterion(moved: bool, state: Any) -> str:
        nonlocal lowered, level, count
        values, vertices = np.asarray(state.f_simplex), np.asarray(state.simplex)
        best, count = values.min(), count + 1
        if best < level:
            level, lowered = best, count
        elif values.max() == best and count - lowered > 10 * (len(y0) + 1):
            return "the value is the same all over the simplex"
        if tracker.problem.least_squares and best <= absolute:
            return "the value is zero"
        if values.max() - best > tolerance * abs(best) + absolute:
            return ""
        size = np.abs(vertices - vertices[values.argmin()]).max()
        return f"the simplex shrank to {size:.1e}" if size <= tolerance**0.5 else ""

    steps, converged, reason = _loop(name, tracker, fn, None, False, max_steps, criterion)
    return tracker.result(name, steps, converged, reason)
