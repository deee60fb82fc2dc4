"""Variance by quadrature against Monte Carlo, fractions of least variance, allocation."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from dsfit.errors import InputError
from dsfit.mis import (
    HEURISTICS,
    OptimalAllocation,
    best_fractions,
    estimate,
    measure_costs,
    mis_variance,
    parse_allocation,
    split_counts,
)
from tests.mis.toys import Lobe, Sphere, TwoLobes, contexts, generator, sphere_nodes

STRATEGIES = [Lobe(6.0), Lobe(2.0), Sphere()]


def nodes() -> tuple[Tensor, Tensor, Tensor]:
    context = contexts(1)[0]
    omega, weight = sphere_nodes(64)
    value = TwoLobes()(omega, context).detach()
    log_p = torch.stack([proposal(context).log_prob(omega).detach() for proposal in STRATEGIES])
    return value, weight, log_p


@pytest.mark.parametrize("model", ["multi", "one"])
@pytest.mark.parametrize("heuristic", list(HEURISTICS))
def test_predicted_variance_is_that_of_the_estimator(heuristic: str, model: str) -> None:
    """Spread of 4000 estimates of 64 samples; optimal is compared per sample at a count where alpha is well known."""
    value, weight, log_p = nodes()
    samples, repeats = (64, 4000) if heuristic != "optimal" else (1024, 400)
    fractions = [0.5, 0.25, 0.25]
    counts = torch.tensor([samples * c for c in fractions], dtype=torch.float64)
    predicted = mis_variance(value, weight, log_p, counts, heuristic, model=model)
    context = contexts(1).expand(repeats)
    result = estimate(
        TwoLobes(), STRATEGIES, context, samples, heuristic, generator=generator(1), model=model,
        allocation=fractions, test=False,
    )  # fmt: skip
    ratio = result.value.detach().var(dim=0) / predicted.variance
    tolerance = 5 * (2 / repeats) ** 0.5 + (0.02 if heuristic == "optimal" else 0)
    assert float((ratio - 1).abs().max()) < tolerance
    torch.testing.assert_close(predicted.integral, TwoLobes().integral(contexts(1)[0]).detach(), rtol=1e-12, atol=0)


def test_excess_of_balance_is_that_of_the_mixture() -> None:
    value, weight, log_p = nodes()
    c = torch.tensor([0.2, 0.5, 0.3], dtype=torch.float64)
    mixture = (c[:, None] * log_p.exp()).sum(dim=0)
    norm = value.norm(dim=-1)
    m_star = (norm * weight).sum() ** 2
    excess = (norm.square() / mixture * weight).sum() / m_star - 1
    for model in ("multi", "one"):
        found = mis_variance(value, weight, log_p, 50 * c, model=model)
        torch.testing.assert_close(found.excess, excess)
        torch.testing.assert_close(found.m_star, m_star)
    assert float(found.variance_excess - excess) == pytest.approx(0, abs=1e-12)
    multi = mis_variance(value, weight, log_p, 50 * c)
    assert float(multi.variance_excess) < float(excess)
    single = mis_variance(value, weight, log_p[:1], [7])
    torch.testing.assert_close(single.excess, single.variance_excess)


def test_optimal_is_the_least_and_known_inequalities() -> None:
    """Kondapaneni: optimal <= all others (multi-sample). Veach: balance is the best one-sample weighting."""
    value, weight, log_p = nodes()
    counts = torch.tensor([2.0, 1.0, 3.0], dtype=torch.float64)
    for model in ("multi", "one"):
        by_name = {
            name: float(mis_variance(value, weight, log_p, counts, name, model=model).variance_excess)
            for name in HEURISTICS
        }
        assert min(by_name, key=by_name.get) == "optimal"
        if model == "one":
            assert by_name["balance"] == min(v for k, v in by_name.items() if k != "optimal")


def test_extreme_densities_and_batches() -> None:
    value, weight, log_p = nodes()
    counts = torch.tensor([2.0, 1.0, 3.0], dtype=torch.float64)
    expected = mis_variance(value, weight, log_p, counts, "power").excess
    scaled = mis_variance(value * 1e-150, weight, log_p, counts, "power").excess
    torch.testing.assert_close(scaled, expected, rtol=1e-9, atol=0)
    small = mis_variance(value, weight, log_p - torch.tensor([[700.0], [0.0], [0.0]]), counts, "power")
    others = mis_variance(value, weight, log_p[1:], [1.0, 3.0], "power").excess
    torch.testing.assert_close(small.excess + 1, 6 / 4 * (others + 1))  # 2 of 6 samples are wasted
    batch = mis_variance(
        torch.stack([value, 2 * value], dim=1), weight, log_p.unsqueeze(-1).expand(-1, -1, 2), counts, "power"
    )
    torch.testing.assert_close(batch.excess, expected.expand(2))
    torch.testing.assert_close(batch.variance[1], 4 * batch.variance[0])
    with pytest.raises(InputError, match="log_p"):
        mis_variance(value, weight, torch.full_like(log_p, -torch.inf), counts)
    with pytest.raises(InputError, match="model"):
        mis_variance(value, weight, log_p, counts, model="two")


def test_best_fractions_against_a_grid() -> None:
    value, weight, log_p = nodes()
    pair = log_p[[0, 2]]
    for heuristic in ("balance", "power", "cutoff"):
        for model in ("multi", "one"):
            grid = torch.linspace(0.01, 0.99, 99, dtype=torch.float64)
            cost = [float(mis_variance(value, weight, pair, [c, 1 - c], heuristic, model=model).variance.sum())
                    for c in grid]  # fmt: skip
            fractions, excess = best_fractions(value, weight, pair, heuristic, model=model)
            found = mis_variance(value, weight, pair, fractions, heuristic, model=model)
            assert float(found.variance.sum()) <= 1.0005 * min(cost)
            assert excess == pytest.approx(float(found.variance_excess)) and float(fractions.sum()) == pytest.approx(1)
    cheap, _ = best_fractions(value, weight, pair, costs=[10.0, 1.0])
    dear, _ = best_fractions(value, weight, pair, costs=[1.0, 10.0])
    assert float(cheap[0]) < float(best_fractions(value, weight, pair)[0][0]) < float(dear[0])
    floored, _ = best_fractions(value, weight, pair, costs=[1000.0, 1.0], minimum=0.2)
    assert float(floored.min()) >= 0.2
    for bad in ({"costs": [1.0]}, {"costs": [1.0, -1.0]}, {"minimum": 0.6}):
        with pytest.raises(InputError):
            best_fractions(value, weight, pair, **bad)


@pytest.mark.parametrize("model", ["multi", "one"])
def test_optimal_allocation_is_unbiased_and_better(model: str) -> None:
    """A bad strategy gets little; the pilot is counted and not reused."""
    context, integrand = contexts(100), TwoLobes()
    proposals = [Lobe(6.0), Lobe(40.0, tangent=True), Lobe(1.0)]
    options = {"generator": generator(2), "model": model, "test": False}
    best = estimate(integrand, proposals, context, 1000, allocation="optimal", **options)
    equal = estimate(integrand, proposals, context, 1000, **options)
    assert best.evaluations == (1000 + 3 * 342) * 100 and best.samples == 1000
    assert best.fractions[1] < 0.1 and sum(best.fractions) == pytest.approx(1)
    assert float(best.variance.sum()) < 0.9 * float(equal.variance.sum())
    z = (best.value - integrand.integral(context).detach()) / best.standard_error
    assert 0.85 < float(z.square().mean().sqrt()) < 1.15
    costly = {"kind": "optimal", "pilot": 600, "costs": [50.0, 1.0, 1.0], "minimum": 0.05}
    other = estimate(integrand, proposals, context, 1000, allocation=costly, **options)
    assert other.fractions[0] < best.fractions[0] and min(other.fractions) >= 0.049


def test_parse_and_split() -> None:
    assert parse_allocation("equal", 4, 10) == parse_allocation(None, 4, 10) == [0.25] * 4
    assert parse_allocation([1, 3, 6], 3, 10) == parse_allocation((0.1, 0.3, 0.6), 3, 10) == [0.1, 0.3, 0.6]
    assert parse_allocation({"kind": "proportional", "weights": [1, 4]}, 2, 10) == [0.2, 0.8]
    assert parse_allocation("optimal", 2, 10) == OptimalAllocation()
    assert split_counts(10, [0.25] * 4) == [3, 3, 2, 2]
    assert split_counts(10, [0.1, 0.3, 0.6]) == [1, 3, 6]
    assert split_counts(7, [0.999, 0.0005, 0.0005]) == [5, 1, 1]
    assert split_counts(5, [0.0, 1.0]) == [0, 5]
    for samples in range(3, 60):
        for fractions in ([0.5, 0.3, 0.2], [0.9, 0.05, 0.05], [1 / 3] * 3):
            counts = split_counts(samples, fractions)
            assert sum(counts) == samples and min(counts) >= 1
            assert max(abs(n - samples * f) for n, f in zip(counts, fractions, strict=True)) < 2.01
    with pytest.raises(InputError):
        split_counts(2, [0.3, 0.3, 0.4])


def test_zero_counts_leave_a_strategy_out() -> None:
    context = contexts(50)
    result = estimate(TwoLobes(), STRATEGIES, context, 900, generator=generator(1), allocation=[400, 0, 500])
    z = (result.value - TwoLobes().integral(context).detach()) / result.standard_error
    assert result.fractions[1] == 0 and 0.8 < float(z.square().mean().sqrt()) < 1.25
    assert bool(torch.isfinite(result.consistency_p_value).all())


def test_measured_costs_are_positive() -> None:
    costs = measure_costs(TwoLobes(), STRATEGIES, contexts(2), generator=generator(1), samples=64, repeats=3)
    assert len(costs) == 3 and min(costs) > 0
