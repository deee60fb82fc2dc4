"""Solvers of torch.optim, step by step; they need plain autograd only and no JAX."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from dsfit.fit.tracking import SolverResult, Stall, Tracker, scalar_scales


class _Closure:
    """Value and gradient for torch.optim at its parameter. A point without a finite value gets a high but finite value
    and no gradient, because line searches interpolate and infinities would become NaN there."""

    def __init__(self, tracker: Tracker, parameter: Tensor, scale: Tensor, factor: float) -> None:
        self.tracker, self.parameter, self.scale, self.factor = tracker, parameter, scale, factor
        self.gradient = torch.zeros_like(parameter)
        self.at = tracker.y0

    def __call__(self) -> Tensor:
        tracker = self.tracker
        y = tracker.y0 + self.parameter.detach() / self.scale
        self.at = y
        if bool(torch.isfinite(y).all()):
            value, gradient = tracker.gradient(y)
        else:
            value, gradient = float("inf"), torch.zeros_like(y)
        if value == float("inf"):
            value = tracker.best_value + 10 * (abs(tracker.start) + abs(tracker.best_value))
        self.gradient = gradient
        self.parameter.grad = gradient / self.scale * self.factor
        return torch.tensor(value * self.factor, dtype=torch.float64)


def lbfgs(
    name: str, tracker: Tracker, *, max_steps: int, tolerance: float, absolute: float, floor: float, memory: int
) -> SolverResult:
    """L-BFGS with a strong-Wolfe line search; `memory` pairs are kept.

    The objective is scaled up: torch drops pairs whose curvature `ds . dg` is below 1e-10, and a fit gets there.
    """
    if tracker.problem.least_squares and tracker.start <= absolute:
        return tracker.result(name, 0, True, "the value is zero")
    scales = scalar_scales(tracker, floor)
    if scales is None:
        return tracker.result(name, 0, True, "the gradient is zero")
    parameter = torch.zeros_like(tracker.y0).requires_grad_()
    closure = _Closure(tracker, parameter, scales[0], 1e6 / scales[1])
    optimizer = torch.optim.LBFGS(
        [parameter], max_iter=1, max_eval=25, history_size=memory, line_search_fn="strong_wolfe",
        tolerance_grad=0.0, tolerance_change=0.0,
    )  # fmt: skip
    stall, restarted = Stall(tracker.start, 5, tolerance, absolute), False
    for count in range(1, max_steps + 1):
        before = parameter.detach().clone()
        optimizer.step(closure)
        tracker.check()
        tracker.record(count)
        if tracker.problem.least_squares and tracker.best_value <= absolute:
            return tracker.result(name, count, True, "the value is zero")
        if stall(tracker.best_value):
            return tracker.result(name, count, True, f"five steps lowered the value by less than {tolerance:g} of it")
        if torch.equal(before, parameter.detach()) or not bool(torch.isfinite(parameter).all()):
            # The line search found no descent: once more from the best point without memory, then give up.
            if restarted:
                flat = not bool((closure.gradient != 0).any()) and torch.equal(closure.at, tracker.best_y)
                reason = "the gradient is zero" if flat else "the line search finds no descent"
                return tracker.result(name, count, flat, reason)
            restarted = True
            optimizer.state.clear()
            with torch.no_grad():
                parameter.copy_((tracker.best_y - tracker.y0) * closure.scale)
        else:
            restarted = False
        if tracker.expired:
            return tracker.result(name, count, False, f"max_seconds reached ({tracker.max_seconds:g})")
    return tracker.result(name, max_steps, False, f"max_steps reached ({max_steps})")


def adam(
    name: str,
    tracker: Tracker,
    *,
    max_steps: int,
    tolerance: float,
    absolute: float,
    rate: float,
    final_rate: float,
    contexts: int,
    seed: int,
) -> SolverResult:
    """Adam with a learning rate falling on a cosine from `rate` to `final_rate` over `max_steps`, in units of the
    parameters.

    Converged when a tenth of `max_steps` (at least 50 steps) no longer lowered the best value by more than the
    tolerance. A step onto a point without a finite value, or onto a plateau without a gradient that is not the best
    point, goes back to the best point with half the rate. With
    `contexts`, a step sees only that many contexts, drawn at random; the value is then taken every 1/40 of `max_steps`
    and at the end, and convergence is not judged before.
    """
    if tracker.problem.least_squares and tracker.start <= absolute:
        return tracker.result(name, 0, True, "the value is zero")
    parameter = torch.zeros_like(tracker.y0).requires_grad_()
    closure = _Closure(tracker, parameter, torch.ones_like(tracker.y0), 1.0)
    optimizer = torch.optim.Adam([parameter], lr=rate)
    window, every = max(50, max_steps // 10), max(1, max_steps // 40) if contexts > 0 else 1
    generator = torch.Generator().manual_seed(seed)
    stall, shrink = Stall(tracker.start, window, tolerance, absolute), 1.0
    for count in range(1, max_steps + 1):
        share = 0.5 * (1 + math.cos(math.pi * (count - 1) / max_steps))
        optimizer.param_groups[0]["lr"] = shrink * (final_rate + share * (rate - final_rate))
        bad = tracker.bad
        if contexts > 0:
            parameter.grad = tracker.sampled_gradient(tracker.y0 + parameter.detach(), contexts, generator)
            optimizer.step()
            if count % every == 0 or count == max_steps:
                tracker.value(tracker.y0 + parameter.detach())
        else:
            optimizer.step(closure)
        tracker.check()
        tracker.record(count)
        flat = contexts <= 0 and not bool((closure.gradient != 0).any())
        if tracker.bad > bad or (flat and not torch.equal(closure.at, tracker.best_y)):
            shrink *= 0.5
            optimizer.state.clear()
            with torch.no_grad():
                parameter.copy_(tracker.best_y - tracker.y0)
        elif flat:
            return tracker.result(name, count, True, "the gradient is zero")
        if tracker.problem.least_squares and tracker.best_value <= absolute:
            return tracker.result(name, count, True, "the value is zero")
        if contexts <= 0 and stall(tracker.best_value):
            reason = f"{window} steps lowered the value by less than {tolerance:g} of it"
            return tracker.result(name, count, True, reason)
        if tracker.expired:
            return tracker.result(name, count, False, f"max_seconds reached ({tracker.max_seconds:g})")
    return tracker.result(name, max_steps, False, f"max_steps reached ({max_steps})")
