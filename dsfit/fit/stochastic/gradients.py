"""How noisy a gradient from samples is, and what takes the noise away.

The gradient of M / M_0 in the parameters (M_0 a known scale) from samples of q, with m = h / (p q M_0), c = p / q and
the score s = dlog p / dy:

    mean_j (b c_j - m_j) s_j,        E_q[c s] = int dp/dy domega = 0 for any b.

    plain      b = 0, q = p, independent samples
    baseline   b = 1: where p is the best density and nothing is noisy, every term is zero
    optimal    b for each parameter from the other half of the samples, Cov(m s, c s) / Var(c s)
    defensive  as baseline, q = 0.9 p + 0.1 / (4 pi): c and m are bounded where p has next to nothing
    sobol      as defensive, with scrambled Sobol points
    replay     as sobol, with samples of earlier proposals too, under balance weights: no further call of the integrand
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from dsfit.context import Context
from dsfit.errors import InputError, check_choice
from dsfit.fit.fit import copied
from dsfit.fit.proposal_problem import Parameters
from dsfit.fit.stochastic.replay import Replay
from dsfit.fit.stochastic.samples import Draws, Radiance, draw, sampling_law


@dataclass(frozen=True)
class Plan:
    """One estimator: `baseline` ("none", "density" or "optimal"), defensive `share`, kind of `points`, whether earlier
    samples are `replayed`."""

    baseline: str = "density"
    share: float = 0.0
    points: str = "random"
    replayed: bool = False


PLANS: dict[str, Plan] = {
    "plain": Plan("none"),
    "baseline": Plan(),
    "optimal": Plan("optimal"),
    "defensive": Plan(share=0.1),
    "sobol": Plan(share=0.1, points="sobol"),
    "replay": Plan(share=0.1, points="sobol", replayed=True),
}
"""Estimators by name, see the module's text."""


def gradient_from(drawn: Draws, log_p: Tensor, score: Tensor, log_scale: float, coefficient: float | Tensor) -> Tensor:
    """Gradient `[P]` of M / exp(log_scale) from samples `[N]`, their densities `[N]` and scores `[N, P]`."""
    moment, control = _terms(drawn, log_p, score, log_scale)
    return (coefficient * control - moment).mean(0)


def _terms(drawn: Draws, log_p: Tensor, score: Tensor, log_scale: float) -> tuple[Tensor, Tensor]:
    m = torch.exp(drawn.log_square - log_p - drawn.log_q - log_scale)
    return m[:, None] * score, torch.exp(log_p - drawn.log_q)[:, None] * score


def log_prob_and_score(proposal: nn.Module, context: Context, omega: Tensor) -> tuple[Tensor, Tensor]:
    """log p `[N]` and its derivative `[N, P]` at directions `[N, 2]` of one context."""
    log_p, slopes = proposal.log_prob_with_jacobian(context, omega)
    names = Parameters(proposal).names
    return log_p.detach(), torch.cat([slopes[name].detach().reshape(len(log_p), -1) for name in names], dim=1)


@torch.no_grad()
def sampled_gradient(
    radiance: Radiance,
    proposal: nn.Module,
    context: Context,
    plan: str | Plan,
    samples: int,
    generator: torch.Generator,
    *,
    log_scale: float = 0.0,
    draws: int = 1,
    past: Sequence[Tensor] = (),
) -> Tensor:
    """One estimate `[P]` of the gradient of M / exp(log_scale), from `samples` new directions.

    Args:
        context: a single one, float64.
        plan: name in `PLANS`, or one made.
        past: parameters of the earlier proposals that a plan with replay has `samples` of each from.

    Raises:
        InputError: unknown plan, fewer than 4 samples.
    """
    made = plan if isinstance(plan, Plan) else PLANS[check_choice("plan", plan, tuple(PLANS))]
    if samples < 4:
        raise InputError("samples", samples, "an integer >= 4")

    def fresh(proposal: nn.Module, count: int) -> Draws:
        law = sampling_law(proposal, context, made.share)
        return draw(radiance, context, law, count, generator, draws=draws, points=made.points)

    if made.baseline == "optimal":
        parts = [fresh(proposal, count) for count in (samples // 2, samples - samples // 2)]
        known = [(part, *log_prob_and_score(proposal, context, part.omega)) for part in parts]
        found = [
            gradient_from(*mine, log_scale, _best_coefficient(*_terms(*other, log_scale))) * len(mine[0].omega)
            for mine, other in zip(known, reversed(known), strict=True)
        ]
        return (found[0] + found[1]) / samples
    drawn = fresh(proposal, samples)
    if made.replayed:
        work = copied(proposal)
        replay = Replay(work, context, made.share)
        now = replay.parameters.vector(proposal)
        for y in past:
            replay.parameters.assign(work, y)
            replay.add(fresh(work, samples), y)
        replay.add(drawn, now)
        drawn = replay.draws()
    log_p, score = log_prob_and_score(proposal, context, drawn.omega)
    return gradient_from(drawn, log_p, score, log_scale, float(made.baseline == "density"))


def _best_coefficient(moment: Tensor, control: Tensor) -> Tensor:
    """Cov / Var `[P]`; 0 for a parameter without effect."""
    moment, control = moment - moment.mean(0), control - control.mean(0)
    square = control.square().sum(0)
    return torch.where(square > 0, (moment * control).sum(0) / torch.where(square > 0, square, 1.0), 0.0)


def variance_factor(
    first: Tensor, second: Tensor, generator: torch.Generator, *, resamples: int = 400, level: float = 0.95
) -> tuple[float, float, float]:
    """By what factor the variance of `second` is less, from independent estimates `[R, P]` of both: summed over
    parameters, with a bootstrap interval of this level."""

    def total(rows: Tensor) -> Tensor:
        return rows.var(0).sum()

    def resampled(rows: Tensor) -> Tensor:
        index = torch.randint(len(rows), (resamples, len(rows)), generator=generator)
        return torch.stack([total(rows[i]) for i in index])

    ratios = (resampled(first) / resampled(second)).sort().values
    tail = math.floor((1 - level) / 2 * resamples)
    return float(total(first) / total(second)), float(ratios[tail]), float(ratios[-1 - tail])
