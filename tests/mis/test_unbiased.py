"""Every heuristic x model x kind of uniforms is unbiased with the right standard error, and wrong estimators are found
out.

One table of z-scores: one estimate of each of many contexts, each context's truth known. Under a correct estimator and
standard error z follows a normal law (independent uniforms) or Student's t with replicates - 1 degrees of freedom.
"""

from __future__ import annotations

import functools
import math

import numpy as np
import pytest
import torch
from scipy import stats
from torch import Tensor

from dsfit.context import Context
from dsfit.frame import to_vector
from dsfit.mis import HEURISTICS, Balance, Heuristic, combine, estimate
from dsfit.mis.estimators import contribution, draw_mixture
from dsfit.mis.optimal import solve_alpha
from dsfit.random import KINDS, uniforms
from tests.mis.toys import Lobe, Sphere, TruncatedNormal, TwoLobes, contexts, generator

COUNT, SAMPLES, REPLICATES = 120, 1536, 24
CASES = [(h, m, k) for h in HEURISTICS for m in ("multi", "one") for k in KINDS]


def strategies() -> list[torch.nn.Module]:
    """A broad lobe, a lobe that is 0 on half the sphere, a product law, and the uniform sphere."""
    return [Lobe(6.0), Lobe(2.0, half=True, tangent=True), TruncatedNormal(0.3, 0.8), Sphere()]


def z_scores(value: Tensor, error: Tensor, truth: Tensor) -> Tensor:
    """One number per context: its channels are dependent, so contexts take turns with them."""
    channel = torch.arange(len(value)) % value.shape[-1]
    pick = (torch.arange(len(value)), channel)
    return ((value - truth) / error)[pick].detach()


@functools.lru_cache(maxsize=1)
def table() -> dict[tuple[str, str, str], Tensor]:
    integrand, rows = TwoLobes(), {}
    for index, (rule, model, kind) in enumerate(CASES):
        context = contexts(COUNT, seed=100 + index)
        result = estimate(
            integrand,
            strategies(),
            context,
            SAMPLES,
            rule,
            generator=generator(index),
            model=model,
            allocation=[0.3, 0.25, 0.2, 0.25],
            uniforms=kind,
            replicates=REPLICATES,
            test=False,
        )
        rows[rule, model, kind] = z_scores(result.value, result.standard_error, integrand.integral(context))
    return rows


def to_uniform(z: Tensor, kind: str) -> np.ndarray:
    law = stats.norm if kind == "random" else stats.t(REPLICATES - 1)
    return law.cdf(z.numpy())


def test_all_estimators_are_unbiased() -> None:
    """One p-value for the whole table, one for the means, one for the spread."""
    rows = table()
    u = np.concatenate([to_uniform(z, case[2]) for case, z in rows.items()])
    assert stats.kstest(u, "uniform").pvalue > 0.01
    normal = {case: stats.norm.ppf(to_uniform(z, case[2])) for case, z in rows.items()}
    means = np.array([math.sqrt(COUNT) * x.mean() for x in normal.values()])
    spreads = np.array([(x**2).sum() for x in normal.values()])
    assert stats.chi2.sf((means**2).sum(), len(means)) > 0.01, dict(zip(normal, means.round(2), strict=True))
    assert stats.chi2.sf(spreads.sum(), COUNT * len(spreads)) > 0.005, dict(zip(normal, spreads.round(), strict=True))
    assert stats.chi2.cdf(spreads.sum(), COUNT * len(spreads)) > 0.005


def test_standard_errors_are_not_vacuous() -> None:
    """z would look fine with errors of any size if they scaled with the deviations: bound them from above."""
    integrand, context = TwoLobes(), contexts(COUNT)
    truth = integrand.integral(context).detach()
    bounds = {"balance": 0.02, "power": 0.025, "maximum": 0.04, "cutoff": 0.02, "optimal": 0.01}
    for rule, bound in bounds.items():
        result = estimate(integrand, strategies(), context, SAMPLES, rule, generator=generator(0), test=False)
        assert float((result.standard_error.norm(dim=-1) / truth.norm(dim=-1)).mean()) < bound
        torch.testing.assert_close(result.variance, SAMPLES * result.standard_error**2)


class Leaky(Heuristic):
    """Balance weights that sum to 1.03."""

    def log_weights(self, log_p: Tensor, counts: Tensor) -> Tensor:
        return Balance().log_weights(log_p, counts) + math.log(1.03)


def rejected(value: Tensor, error: Tensor, truth: Tensor) -> float:
    return stats.kstest(z_scores(value, error, truth).numpy(), "norm").pvalue


@pytest.mark.parametrize("kind", ["no jacobian", "leaky weights", "wrong scale"])
@pytest.mark.parametrize("model", ["multi", "one"])
def test_wrong_densities_and_weights_are_rejected(kind: str, model: str) -> None:
    integrand, context = TwoLobes(), contexts(COUNT)
    wrong = {
        "no jacobian": [TruncatedNormal(0.3, 0.8, jacobian=False), Lobe(6.0)],
        "leaky weights": [TruncatedNormal(0.3, 0.8), Lobe(6.0)],
        "wrong scale": [TruncatedNormal(0.3, 0.8), Lobe(6.0, log_scale=0.1)],
    }[kind]
    rule = Leaky() if kind == "leaky weights" else "balance"
    result = estimate(integrand, wrong, context, 4096, rule, generator=generator(1), model=model)
    assert rejected(result.value, result.standard_error, integrand.integral(context)) < 1e-6
    if kind != "leaky weights":  # the densities give themselves away without a reference
        p = result.consistency_p_value.numpy()
        assert stats.kstest(p, "uniform", alternative="greater").pvalue < 1e-6
    right = [TruncatedNormal(0.3, 0.8), Lobe(6.0)]
    control = estimate(integrand, right, context, 4096, generator=generator(1), model=model)
    assert rejected(control.value, control.standard_error, integrand.integral(context)) > 0.01
    assert stats.kstest(control.consistency_p_value.numpy(), "uniform", alternative="greater").pvalue > 0.01


@pytest.mark.parametrize("believed", [[0.5, 0.5], [0.3, 0.7]])
def test_one_sample_with_wrong_probabilities_is_rejected(believed: list[float]) -> None:
    """Strategies are chosen with (0.3, 0.7); weights computed for other probabilities are biased."""
    integrand, context = TwoLobes(), contexts(COUNT)
    distributions = [proposal(context) for proposal in (Lobe(6.0), Sphere())]
    u = uniforms((4096, COUNT), 3, generator=generator(3))
    omega, log_p, choice = draw_mixture(distributions, torch.tensor([0.3, 0.7], dtype=torch.float64), u)
    share = (choice == 0).double().mean()
    assert abs(float(share) - 0.3) < 4 * math.sqrt(0.21 / choice.numel())
    z = contribution(integrand(omega, context), log_p, choice, torch.tensor(believed, dtype=torch.float64), Balance())
    p = rejected(z.mean(dim=0), z.std(dim=0) / 64, integrand.integral(context))
    assert p > 0.01 if believed == [0.3, 0.7] else p < 1e-6


@pytest.mark.parametrize("model", ["multi", "one"])
@pytest.mark.parametrize("crossed", [True, False])
def test_optimal_is_unbiased_with_few_samples(model: str, crossed: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """With 6 samples per strategy alpha is noise; from the samples it is used on, it biases the mean by percents."""
    if not crossed:

        def from_all_samples(second: Tensor, fractions: Tensor, channels: int, rcond: float | None = None) -> Tensor:
            mean = second.mean(dim=0, keepdim=True).expand_as(second)
            return solve_alpha(mean[..., channels:, channels:], mean[..., channels:, :channels], fractions, rcond)

        monkeypatch.setattr(combine, "cross_fit", from_all_samples)

    def cap(omega: Tensor, context: Context) -> Tensor:
        axis = to_vector(torch.stack([context.theta_r, context.phi_r], dim=-1))
        return ((to_vector(omega) * axis).sum(dim=-1, keepdim=True) > 0.3).to(omega.dtype)

    context = contexts(10000, seed=5)
    result = estimate(
        cap, [Lobe(1.0), Sphere()], context, 12, "optimal", generator=generator(6), model=model, test=False
    )
    relative = result.value[:, 0] / (2 * math.pi * 0.7) - 1
    z = float(relative.mean() / (relative.std() / math.sqrt(len(relative))))
    assert abs(z) < 4 if crossed else abs(z) > 10
