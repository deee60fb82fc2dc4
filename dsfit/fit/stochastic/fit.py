"""`fit_stochastic(proposal, integrand, contexts)`: a proposal fitted to samples only."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor, nn

from dsfit.context import Context
from dsfit.errors import InputError, as_number, check_choice
from dsfit.fit.fit import copied
from dsfit.fit.objectives import LOG_FLOOR
from dsfit.fit.stochastic.adam import Adam
from dsfit.fit.stochastic.estimates import SampledExcess, sampled_excess
from dsfit.fit.stochastic.gauss_newton import GaussNewton
from dsfit.fit.stochastic.samples import Draws, Radiance
from dsfit.fit.stochastic.setting import Progress, Setting
from dsfit.streams import ContextStream

SOLVERS: dict[str, Callable[[], GaussNewton | Adam]] = {"gauss_newton": GaussNewton, "adam": Adam}
"""Solvers by name, as made without options."""


@dataclass(frozen=True)
class StochasticFit:
    """A proposal fitted to samples, and what further samples say of it.

    Attributes:
        proposal: the fitted copy, in the dtype of the one given; that one is unchanged.
        excess_estimate, error: `M / N^2 - 1` with standard error, from `held_out` samples that no step was fitted to;
            mean over contexts. See `estimates` for what it means with a noisy integrand.
        excesses: the same for each context, of the shape of the context batch; of a stream, for contexts drawn last.
        leverage: share of the largest sample in the error's sum of squares, the largest over contexts: near 1 the error
            says little.
        history: one entry per step, from each step's samples before it was fitted to them.
        evaluations: of the integrand, the `held_out` samples included.
        seconds: wall time.
        steps: steps taken.
        converged: whether samples saw no more progress, and `reason` in words.
        state: everything that a fit needs to go on, for `torch.save`; see `state` of `fit_stochastic`.
    """

    proposal: nn.Module
    excess_estimate: float
    error: float
    excesses: Tensor = field(repr=False)
    leverage: float
    history: list[Progress] = field(repr=False)
    evaluations: int
    seconds: float
    steps: int
    converged: bool
    reason: str
    state: dict[str, Any] = field(repr=False)


def fit_stochastic(
    proposal: nn.Module,
    integrand: Radiance,
    contexts: Context | ContextStream,
    *,
    solver: str | GaussNewton | Adam = "gauss_newton",
    samples_per_step: int = 512,
    steps: int = 12,
    contexts_per_step: int = 64,
    held_out: int = 1024,
    draws: int = 1,
    share: float = 0.1,
    seed: int = 0,
    max_seconds: float = math.inf,
    state: dict[str, Any] | None = None,
    watch: Callable[[Progress, nn.Module], None] | None = None,
) -> StochasticFit:
    """Fit a proposal to an integrand that can only be asked at directions, with or without noise: no quadrature, no
    known integral, no derivative of the integrand, nothing known of its edges.

    The objective is the mean over contexts of log M(p), with M = int |F|^2 / p domega the second moment under the
    proposal and E|f|^2 for |F|^2 where the integrand is noisy and `draws` is 1; see `samples` for which integral that
    is. Directions come from the proposal as it is, mixed with `share` of the uniform sphere. The fit runs in float64
    on a copy.

    Args:
        proposal: module whose `proposal(context)` is a `Distribution`, with parameters that require grad.
        integrand: `integrand(omega [*samples, *batch, 2], context) -> [..., C]` without negative values, asked in the
            dtype of the contexts; noisy answers must be independent from call to call. Its own randomness is its own:
            results repeat with `seed` if it does.
        contexts: one, or a batch [*batch], that one set of parameters is fitted to; or a stream of contexts.
        solver: "gauss_newton" (keeps all samples; up to some hundreds of parameters and a few contexts), "adam" (uses
            samples once; networks and streams), or either with options.
        samples_per_step: directions per context and step.
        steps: most steps in all. Adam's learning rate falls over them.
        contexts_per_step: contexts drawn from a stream for each step.
        held_out: directions per context for judging the result (for a stream: in all, `samples_per_step` each).
        draws: answers of the integrand per direction, 1 or 2.
        share: defensive share of the sampling law, in [0, 1).
        seed: of all samples.
        max_seconds: wall time after which to stop, checked between steps; at least one step is taken.
        state: of a fit with the same arguments that was stopped: goes on from there, to the same result as without a
            stop.
        watch: called after each step's samples with what they say, and the proposal under work (float64; not to be
            changed).

    Raises:
        InputError: an argument out of range; a proposal without learnable parameters, that cannot be copied, or whose
            density is zero where the integrand is not (give it a defensive share); a bad answer of the integrand; a
            stream for a solver that keeps samples.

    Example:
        >>> import torch
        >>> import dsfit
        >>> from dsfit.proposals import GaussianLobe, Mixture, Product, UniformAzimuth
        >>> ridge = dsfit.FunctionIntegrand(lambda omega, context: torch.exp(-50 * (omega[..., :1] - 0.2) ** 2))
        >>> start = Mixture([Product(GaussianLobe(0.0, 0.2), UniformAzimuth())])
        >>> found = dsfit.fit_stochastic(start, ridge, dsfit.Context(0.0), samples_per_step=128, steps=6)
        >>> found.evaluations, float(dsfit.excess(ridge, found.proposal, dsfit.Context(0.0)).value) < 0.05
        (1792, True)
    """
    began = time.perf_counter()
    for name, value, least in (
        ("samples_per_step", samples_per_step, 2),
        ("steps", steps, 1),
        ("contexts_per_step", contexts_per_step, 1),
        ("held_out", held_out, 2),
    ):
        if isinstance(value, bool) or not isinstance(value, int) or value < least:
            raise InputError(name, value, f"an integer >= {least}")
    if isinstance(seed, bool) or not isinstance(seed, int) or not 0 <= seed < 2**63:
        raise InputError("seed", seed, "integers in [0, 2^63)")
    if draws not in (1, 2) or isinstance(draws, bool):
        raise InputError("draws", draws, "1 or 2")
    share = as_number("share", share, 0.0, 1.0, open_high=True)
    setting = Setting(
        copied(proposal).double(), integrand, _source(contexts), samples_per_step, contexts_per_step, share, draws,
        torch.Generator().manual_seed(seed),
    )  # fmt: skip
    run = _solver(solver).start(setting)
    run.steps = steps
    history: list[Progress] = []
    spent, reason = 0.0, f"steps reached ({steps})"
    if state is not None:
        setting.load(state["setting"])
        run.load(state["run"])
        history, spent = list(state["history"]), state["seconds"]
    while len(history) < steps:
        context = setting.next_contexts()
        drawn = setting.draw(context)
        found = _judged(setting, context, drawn)
        history.append(_progress(len(history), setting, found, spent + time.perf_counter() - began))
        if watch is not None:
            watch(history[-1], setting.work)
        run.advance(drawn, context, len(history))
        if run.done:
            reason = "samples see no more progress"
            break
        if time.perf_counter() - began >= max_seconds:
            reason = f"max_seconds reached ({max_seconds:g})"
            break
    spent += time.perf_counter() - began
    kept = {"setting": setting.state(), "run": run.state(), "history": history, "seconds": spent}
    context, drawn = _last(setting, held_out)
    if not setting.lit:
        raise InputError("integrand", 0.0, "radiance that is not zero at every sample")
    run.judge(drawn)
    found = _judged(setting, context, drawn)
    last = _progress(len(history), setting, found, spent)
    fitted = copied(proposal)
    setting.parameters.assign(fitted, setting.parameters.vector(setting.work))
    shape = contexts.batch_shape if isinstance(contexts, Context) else found.value.shape
    return StochasticFit(
        proposal=fitted,
        excess_estimate=last.excess,
        error=last.error,
        excesses=found.value.reshape(shape),
        leverage=float(found.leverage.max()),
        history=history,
        evaluations=setting.evaluations,
        seconds=time.perf_counter() - began,
        steps=len(history),
        converged=run.done,
        reason=reason,
        state=kept,
    )


def _source(contexts: Any) -> Context | ContextStream:
    if isinstance(contexts, ContextStream):
        return contexts
    if not isinstance(contexts, Context) or not contexts.batch_shape.numel():
        raise InputError("contexts", contexts, "a Context with at least one element, or a ContextStream")
    return contexts.reshape(-1)


def _solver(solver: Any) -> GaussNewton | Adam:
    if isinstance(solver, GaussNewton | Adam):
        return solver
    return SOLVERS[check_choice("solver", solver, tuple(SOLVERS))]()


def _last(setting: Setting, held_out: int) -> tuple[Context, Draws]:
    """Contexts and samples to judge the result by."""
    if isinstance(setting.contexts, Context):
        return setting.contexts, setting.draw(setting.contexts, held_out)
    count = max(held_out // setting.samples, 1)
    context = setting.contexts.draw(count, setting.generator)
    return context, setting.draw(context)


@torch.no_grad()
def _judged(setting: Setting, context: Context, drawn: Draws) -> SampledExcess:
    log_p = setting.work(context.to(torch.float64)).log_prob(drawn.omega)
    if bool(((log_p < LOG_FLOOR) & (drawn.log_square > -math.inf)).any()):
        raise InputError("proposal", "a density of 0", "a density that is positive where the integrand is")
    return sampled_excess(drawn, log_p)


def _progress(step: int, setting: Setting, found: SampledExcess, seconds: float) -> Progress:
    error = float(found.error.square().sum().sqrt()) / found.error.numel()
    return Progress(step, setting.evaluations, float(found.value.mean()), error, seconds)
