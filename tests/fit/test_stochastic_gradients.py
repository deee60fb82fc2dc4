"""Gradients from samples against those of a quadrature: unbiased, less noisy than the plain ones, wrong ones caught."""

from __future__ import annotations

import functools
import math
from dataclasses import replace

import pytest
import torch
from scipy import stats

from dsfit.errors import InputError
from dsfit.fit.proposal_problem import Parameters
from dsfit.fit.stochastic import NoisyRadiance, draw, improvement, sampled_excess, sampling_law
from dsfit.fit.stochastic.adam import coefficients
from dsfit.fit.stochastic.gradients import (
    PLANS,
    gradient_from,
    log_prob_and_score,
    sampled_gradient,
    variance_factor,
)
from tests.fit.stochastic_toys import OMEGA, ONE, WEIGHT, lobes
from tests.fit.stochastic_toys import light as LIGHT  # noqa: N812

PROPOSAL = lobes()
LENGTH = LIGHT(OMEGA, ONE).norm(dim=-1)
NORM = float((WEIGHT * LENGTH).sum())
SCALE = 2 * math.log(NORM)
SAMPLES, REPEATS = 128, 60


def exact(factor: float | torch.Tensor = 1.0) -> torch.Tensor:
    """-int factor |F|^2 / p dlog p, in units of M*."""
    log_p, score = log_prob_and_score(PROPOSAL, ONE, OMEGA)
    moment = factor * WEIGHT * torch.exp(2 * torch.log(LENGTH) - log_p - SCALE)
    return -(moment[:, None] * score).sum(0)


def past() -> list[torch.Tensor]:
    generator, y = torch.Generator().manual_seed(0), Parameters(PROPOSAL).vector(PROPOSAL)
    return [y + 0.1 * torch.randn(len(y), generator=generator, dtype=torch.float64) for _ in range(2)]


@functools.cache
def estimates(plan: str) -> torch.Tensor:
    """Independent estimates `[REPEATS, P]`, call by call."""
    generator = torch.Generator().manual_seed(11)
    arguments = (LIGHT, PROPOSAL, ONE, plan, SAMPLES, generator)
    return torch.stack([sampled_gradient(*arguments, log_scale=SCALE, past=past()) for _ in range(REPEATS)])


def sets(repeats: int, share: float, light=LIGHT, samples: int = SAMPLES, seed: int = 3, draws: int = 1) -> tuple:
    """Draws `[samples, repeats]`, their log p, and scores `[samples, repeats, P]`."""
    many, generator = ONE.expand(repeats), torch.Generator().manual_seed(seed)
    law = sampling_law(PROPOSAL, many, share)
    drawn = draw(light, many, law, samples, generator, draws=draws, points="random")
    log_p, score = log_prob_and_score(PROPOSAL, ONE, drawn.omega.reshape(-1, 2))
    return drawn, log_p.reshape(samples, repeats), score.reshape(samples, repeats, -1)


def gradients_of(drawn, log_p, score, coefficient: float = 1.0) -> torch.Tensor:
    """`gradient_from` for every repeat."""
    names = ("omega", "log_q", "log_square", "log_length")
    rows = []
    for k in range(log_p.shape[1]):
        one = replace(drawn, **{name: getattr(drawn, name)[:, k] for name in names})
        rows.append(gradient_from(one, log_p[:, k], score[:, k], SCALE, coefficient))
    return torch.stack(rows)


def p_value(rows: torch.Tensor, truth: torch.Tensor) -> float:
    """Of the largest t-statistic over the parameters, by Bonferroni; parameters without effect are left out."""
    error = rows.std(0) / len(rows) ** 0.5
    live = error > 1e-12
    t = ((rows.mean(0) - truth)[live] / error[live]).abs().max()
    return min(1.0, 2 * int(live.sum()) * float(stats.t.sf(float(t), len(rows) - 1)))


@pytest.mark.parametrize("plan", list(PLANS))
def test_unbiased(plan):
    rows, truth = estimates(plan), exact()
    assert p_value(rows, truth) > 1e-3
    error = float((rows.var(0).sum() / len(rows)).sqrt())
    assert error < 0.3 * float(truth.norm()), "a test that could not fail"


def test_each_step_takes_noise_away():
    generator = torch.Generator().manual_seed(0)
    plain = estimates("plain")
    factors = {plan: variance_factor(plain, estimates(plan), generator) for plan in PLANS}
    assert factors["plain"][0] == 1.0 and factors["plain"][1] < 1 < factors["plain"][2]
    for plan in ("baseline", "optimal", "defensive", "sobol", "replay"):
        assert factors[plan][1] > 1, (plan, factors)
    assert variance_factor(estimates("defensive"), estimates("sobol"), generator)[1] > 1, factors
    assert variance_factor(estimates("sobol"), estimates("replay"), generator)[1] > 1, factors


def test_forgotten_weights_are_rejected():
    drawn, log_p, score = sets(300, 0.5)
    assert p_value(gradients_of(drawn, log_p, score), exact()) > 1e-3
    assert p_value(gradients_of(replace(drawn, log_q=log_p), log_p, score), exact()) < 1e-6


def test_a_baseline_whose_mean_is_not_zero_is_rejected():
    drawn, log_p, score = sets(300, 0.5)
    flawed = gradients_of(drawn, log_p, score, 0.0) + score.mean(0)  # dlog p without the weight p / q
    assert p_value(flawed, exact()) < 1e-6


def side(omega: torch.Tensor) -> torch.Tensor:
    return omega[..., 0] > -0.8


def spotty() -> NoisyRadiance:
    """Noise where theta_i > -0.8 only: E|f|^2 = 2 |F|^2 there."""

    class Spotty(NoisyRadiance):
        def __call__(self, omega, context):
            noisy = super().__call__(omega, context)
            return torch.where(side(omega)[..., None], noisy, self.radiance(omega, context))

    return Spotty(LIGHT, 1.0, "roulette", seed=2)


def test_one_draw_counts_the_noise_and_two_draws_do_not():
    louder = torch.where(side(OMEGA), 2.0, 1.0)
    one, two = (gradients_of(*sets(400, 0.1, spotty(), draws=draws)) for draws in (1, 2))
    assert p_value(one, exact(louder)) > 1e-3 and p_value(two, exact()) > 1e-3
    assert p_value(one, exact()) < 1e-6 and p_value(two, exact(louder)) < 1e-6


def test_gradient_of_log_m_is_along_the_gradient():
    # coefficients of Adam: the mean is E[M / M_j] times the gradient of log M, whatever the number of samples
    log_p, _ = log_prob_and_score(PROPOSAL, ONE, OMEGA)
    moment = float((WEIGHT * torch.exp(2 * torch.log(LENGTH) - log_p - SCALE)).sum())
    truth = exact() / moment
    factors = []
    for samples, repeats in ((8, 4000), (64, 1000)):
        drawn, log_p, score = sets(repeats, 0.1, samples=samples, seed=4)
        rows = (coefficients(drawn, log_p)[..., None] * score).mean(0)
        along = rows @ truth / truth.square().sum()
        factors.append((float(along.mean()), float(along.std()) / repeats**0.5))
        assert p_value(rows - along[:, None] * truth, torch.zeros_like(truth)) > 1e-3
    (few, few_error), (many, many_error) = factors
    assert 1 + 3 * few_error < few < 1.3 and abs(many - 1) < 0.02 + 3 * many_error and many_error < 0.02


def test_sampled_excess_and_improvement_agree_with_the_quadrature():
    other = lobes(0.04, 0.12, (1.2, 1.0))
    log_p, log_other = (p(ONE).log_prob(OMEGA).detach() for p in (PROPOSAL, other))
    square = WEIGHT * torch.exp(2 * torch.log(LENGTH) - SCALE)
    first, second = (float((square * torch.exp(-x)).sum()) for x in (log_p, log_other))
    law, generator = sampling_law(PROPOSAL, ONE, 0.1), torch.Generator().manual_seed(5)
    z, fell, errors, apart = [], [], [], []
    for _ in range(60):
        drawn = draw(LIGHT, ONE, law, 512, generator, points="random")
        mine, theirs = PROPOSAL(ONE).log_prob(drawn.omega).detach(), other(ONE).log_prob(drawn.omega).detach()
        found = sampled_excess(drawn, mine)
        z.append((float(found.value) - (first - 1)) / float(found.error))
        mean, error = improvement(drawn, mine, theirs)
        fell.append((mean - (1 - second / first)) / error)
        errors.append(error)
        apart.append(math.hypot(float(found.error), float(sampled_excess(drawn, theirs).error)) / first)
        assert 0 < float(found.leverage) < 1
    for values in (torch.tensor(z), torch.tensor(fell)):
        assert abs(float(values.mean())) < 4 * float(values.std()) / len(values) ** 0.5
        assert 0.5 < float(values.std()) < 2
    assert sorted(errors)[30] < 0.9 * sorted(apart)[30], "common samples leave less error than each density's own"


def test_bad_input():
    generator = torch.Generator()
    with pytest.raises(InputError, match="plan"):
        sampled_gradient(LIGHT, PROPOSAL, ONE, "pathwise", 64, generator)
    with pytest.raises(InputError, match="samples"):
        sampled_gradient(LIGHT, PROPOSAL, ONE, "plain", 3, generator)
