"""Gauss-Newton on samples: they are the nodes of a quadrature by Monte Carlo, and each step adds some.

With samples of `qbar` (see `replay`), weights w = 1 / (N qbar) and the running second moment M, a step minimises

    sum_j w_j (sqrt(h_j / M) - p_j)^2 / p_j  =  M(p) / M + int p domega + const, as the samples see it,

a sum of squares whose gradient `sum w (p - h / (p M)) dlog p` is the score estimator with p for its baseline: without
noise every term vanishes where p is the best density, so that what sampling does to the fit is of the order of the
excess that is left. In general a fit of P parameters to N samples is worse than the best of its family by

    O = k P / (4 N),    k = E_qbar[(p / qbar)^2 (1 - h / (p^2 M))^2],

to first order: k is 4 times the excess without noise, and at least the relative variance of h with it. What samples
see, the gain G from the start to their own optimum, has O in it once too much. Two guards against fitting noise:

    a pull `k / (4 N spread^2) |y - y_0|^2` towards the start, which keeps what few samples cannot tell where it was;
    the step is shortened to `1 - O / G` of the way from the start (James and Stein's factor, with the curvature of M
    for metric), which without noise is all of it.

Both vanish like 1 / N. And each step's samples are drawn before they are fitted to, so they judge the step before: a
proposal that they find worse than its predecessor by more than two standard errors is taken back.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from dsfit.context import Context
from dsfit.errors import InputError, as_number
from dsfit.fit.fit import NATURAL, REACH
from dsfit.fit.objectives import LOG_FLOOR, Excess, Target
from dsfit.fit.problem import Problem, compress
from dsfit.fit.proposal_problem import ProposalProblem
from dsfit.fit.solvers import minimise
from dsfit.fit.stochastic.estimates import improvement
from dsfit.fit.stochastic.replay import Replay, log_mean_exp
from dsfit.fit.stochastic.samples import Draws
from dsfit.fit.stochastic.setting import Setting


@dataclass(frozen=True)
class GaussNewton:
    """Options.

    Args:
        inner: steps of Levenberg-Marquardt after each batch of samples.
        spread: how far a parameter is expected to end from its start (radians, e-folds, logits), as a standard
            deviation.
        tolerance: stop when O, see the module's text, is below this share of M ...
        patience: ... and so many batches of samples in a row saw no progress beyond one standard error.

    Raises:
        InputError: a number out of range.
    """

    inner: int = 10
    spread: float = 1.0
    tolerance: float = 1e-3
    patience: int = 4

    def __post_init__(self) -> None:
        for name in ("inner", "patience"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise InputError(name, value, "an integer >= 1")
        as_number("spread", self.spread, 0.0, open_low=True)
        as_number("tolerance", self.tolerance, 0.0)

    def start(self, setting: Setting) -> GaussNewtonRun:
        """A run of this solver."""
        if not isinstance(setting.contexts, Context):
            raise InputError("solver", "gauss_newton", "'adam' for a stream of contexts, which keeps no sample")
        return GaussNewtonRun(self, setting)


class Anchored(Problem):
    """A least-squares problem plus `pull |y - y0|^2`."""

    least_squares = True

    def __init__(self, problem: Problem, y0: Tensor, pull: float) -> None:
        self.problem, self.y0, self.pull, self.size = problem, y0, pull, problem.size

    def value(self, y: Tensor) -> float:
        return self.problem.value(y) + self.pull * float((y - self.y0).square().sum())

    def gradient(self, y: Tensor) -> tuple[float, Tensor]:
        value, gradient = self.problem.gradient(y)
        away = y - self.y0
        return value + self.pull * float(away.square().sum()), gradient + 2 * self.pull * away

    def linearise(self, y: Tensor) -> tuple[Tensor, Tensor]:
        residuals, jacobian = self.problem.linearise(y)
        root = math.sqrt(self.pull)
        return compress(
            torch.cat([residuals, root * (y - self.y0)]), torch.cat([jacobian, root * torch.eye(len(y)).to(jacobian)])
        )


_STATE = ("y0", "y", "before", "fitted", "stalled", "sampling")


class GaussNewtonRun:
    """The state of a run: all samples so far, and the parameters before the last step."""

    def __init__(self, options: GaussNewton, setting: Setting) -> None:
        self.options, self.setting = options, setting
        assert isinstance(setting.contexts, Context)
        self.context = setting.contexts.to(torch.float64)
        self.replay = Replay(setting.work, self.context, setting.share)
        self.y0 = self.y = self.before = self.fitted = setting.parameters.vector(setting.work)
        self.stalled, self.sampling = 0, math.inf

    def judge(self, drawn: Draws) -> None:
        """Take the last step back if fresh samples find it harmful, and note whether they see progress."""
        if torch.equal(self.y, self.before):
            self.stalled += len(self.replay.batches) > 1
            return
        mean, error = improvement(drawn, self._log_p(self.before, drawn), self._log_p(self.y, drawn))
        self.stalled = 0 if mean > error else self.stalled + 1
        if not mean + 2 * error >= 0:
            self.y = self.before
        self.setting.parameters.assign(self.setting.work, self.y)

    def advance(self, drawn: Draws, context: Context, step: int) -> None:
        """One step: take in the samples, and fit to all there are."""
        self.replay.add(drawn, self.setting.parameters.vector(self.setting.work))
        self.judge(drawn)
        drawn = self.replay.draws()
        if not bool((drawn.log_square > -math.inf).any()):
            return
        problem = self._problem(drawn)
        limits = {"max_steps": self.options.inner, "tolerance": 1e-4, "reach": REACH}
        self.fitted = minimise(problem, self.fitted, "optimistix.lm", **limits, **NATURAL).y
        self.sampling = self._sampling(drawn)
        gain = problem.problem.value(self.y0) - problem.problem.value(self.fitted)
        kept = max(1 - self.sampling / gain, 0.0) if gain > 0 else 0.0
        self.before, self.y = self.y, self.y0 + kept * (self.fitted - self.y0)
        self.setting.parameters.assign(self.setting.work, self.y)

    @property
    def done(self) -> bool:
        """Whether progress has stalled, and not for want of samples."""
        return self.stalled >= self.options.patience and self.sampling <= self.options.tolerance

    def _log_p(self, y: Tensor, drawn: Draws) -> Tensor:
        self.setting.parameters.assign(self.setting.work, y)
        with torch.no_grad():
            return self.setting.work(self.context).log_prob(drawn.omega)

    def _problem(self, drawn: Draws) -> Anchored:
        """The sum of squares over all samples, per context of the flattened batch."""
        count = len(drawn.omega)
        log_moment = self._log_moment(self.y, drawn)
        seen = log_moment > -math.inf
        share = 1.0 / int(seen.sum())
        log_best = 0.5 * (drawn.log_square - torch.where(seen, log_moment, 0.0))
        weight = torch.exp(-drawn.log_q) / count
        targets = [
            Target(self.context[b], drawn.omega[:, b], weight[:, b], log_best[:, b], 1.0, 1.0, share)
            for b in seen.nonzero()[:, 0].tolist()
        ]
        pull = self._noise(self.y, drawn) * share / (4 * count * self.options.spread**2)
        return Anchored(ProposalProblem(self.setting.work, targets, Excess()), self.y0, pull)

    def _sampling(self, drawn: Draws) -> float:
        """O of the module's text. In place of N - P, what corrects k for having been fitted, the share of samples that
        M rests on counts: of ten samples with light among a hundred, as many parameters leave nothing."""
        size = len(self.y0)
        log_m = drawn.log_square - self._log_p(self.y, drawn).clamp_min(LOG_FLOOR) - drawn.log_q
        log_m = log_m[:, (log_m > -math.inf).any(0)]
        weight = torch.softmax(log_m, 0)
        effective = float((1 / weight.square().sum(0)).sum())
        if effective <= size:
            return math.inf
        return self._noise(self.fitted, drawn) * size / (4 * log_m.numel()) * effective / (effective - size)

    def _log_moment(self, y: Tensor, drawn: Draws) -> Tensor:
        """log M `[B]` at parameters y; -inf where no sample has light."""
        return log_mean_exp(drawn.log_square - self._log_p(y, drawn).clamp_min(LOG_FLOOR) - drawn.log_q)

    def _noise(self, y: Tensor, drawn: Draws) -> float:
        """k of the module's text at parameters y, mean over contexts."""
        log_p, log_moment = self._log_p(y, drawn).clamp_min(LOG_FLOOR), self._log_moment(y, drawn)
        seen = log_moment > -math.inf
        log_m = drawn.log_square - log_p - drawn.log_q - torch.where(seen, log_moment, 0.0)
        rows = torch.exp(log_p - drawn.log_q) - torch.exp(log_m)
        return float(rows[:, seen].square().mean())

    def state(self) -> dict[str, Any]:
        """Everything to go on from."""
        names = _STATE
        return {**{name: getattr(self, name) for name in names}, "replay": self.replay.state()}

    def load(self, state: dict[str, Any]) -> None:
        """Go on from there."""
        for name in _STATE:
            setattr(self, name, state[name])
        self.replay.load(state["replay"])
