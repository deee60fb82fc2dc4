"""Standard errors, p-values and the bridge are calibrated; diagnostics see stuck and biased chains."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from dsfit.checks.independent.chains import Chains
from dsfit.checks.independent.comparisons import bridge, marginals, means, region
from dsfit.checks.independent.diagnostics import Limits, diagnose, unvisited
from dsfit.checks.independent.resampling import Weighted, effective
from dsfit.checks.independent.welch import Sample, smallest_p, welch

ENSEMBLES, PLACES, DRAWS = 16, 120, 2000
WIDTH = 0.35


def toy(
    random: np.random.Generator, *, scale: float = 1.0, shift: float = 0.0
) -> tuple[Weighted, np.ndarray, np.ndarray]:
    """p* a Gaussian of width 0.35 in theta and phi, the proposal a wider one; correlated ensembles by a common offset.

    int |F| is 3. The claimed density is `scale` times the right one; samples are `shift` away from it in theta.
    """

    def log_gauss(x: np.ndarray, width: float) -> np.ndarray:
        return -0.5 * (x**2).sum(-1) / width**2 - 2 * math.log(width) - math.log(2 * math.pi)

    common = random.normal(size=(ENSEMBLES, 1, 2))
    place = WIDTH * (0.1 * common + math.sqrt(1 - 0.01) * random.normal(size=(ENSEMBLES, PLACES, 2)))
    drawn = 1.3 * WIDTH * random.normal(size=(DRAWS, 2)) + np.array([shift, 0.0])
    size, own = math.log(3) + log_gauss(place, WIDTH), math.log(3) + log_gauss(drawn, WIDTH)

    def claimed(x: np.ndarray) -> np.ndarray:
        return log_gauss(x, 1.3 * WIDTH) + math.log(scale)

    return Weighted(drawn, own, own - claimed(drawn), size - claimed(place)), place, size


def p_values(seed: int, **wrong: float) -> dict[str, float]:
    weighted, place, size = toy(np.random.default_rng(seed), **wrong)
    where = region(weighted, math.log(3), 50.0)
    found = bridge(weighted, where, 1000.0)
    return {
        "marginals": marginals(weighted, place, size, where).p_value,
        "means": means(weighted, place, where).p_value,
        "bridge": found.against(3.0, 0.0)[0],
        "region": found.p_region,
    }


def test_false_alarms() -> None:
    """Over 200 repetitions: p-values of the bridge are uniform, those of families not below uniform."""
    rows = [p_values(seed) for seed in range(200)]
    for name in ("bridge", "region"):
        assert stats.kstest([row[name] for row in rows], "uniform").pvalue > 1e-3, name
    for name in ("marginals", "means"):
        values = np.array([row[name] for row in rows])
        assert (values < 0.01).sum() <= stats.binom.isf(1e-3, len(values), 0.01), name
        assert (values < 0.1).sum() <= stats.binom.isf(1e-3, len(values), 0.1), name
        assert values.min() > 1e-5


def test_planted_wrongs() -> None:
    """A wrong scale is seen by the bridge alone; samples that are not the density's by marginals and means."""
    twice, moved = p_values(1, scale=2.0), p_values(1, shift=0.5 * WIDTH)
    assert twice["bridge"] < 1e-6
    assert min(twice["marginals"], twice["means"], twice["region"]) > 1e-3
    assert moved["marginals"] < 1e-6 and moved["means"] < 1e-6


def test_bridge_is_better_than_importance_sampling_alone() -> None:
    """Where the proposal is too narrow: its weights have no variance, the bridge has."""
    random = np.random.default_rng(4)
    place = WIDTH * random.normal(size=(ENSEMBLES, PLACES, 2))
    drawn = 0.6 * WIDTH * random.normal(size=(DRAWS, 2))

    def ratio(x: np.ndarray) -> np.ndarray:
        r2 = (x**2).sum(-1) / WIDTH**2
        return -0.5 * r2 + 0.5 * r2 / 0.36 + 2 * math.log(0.6) + math.log(3)

    weighted = Weighted(drawn, ratio(drawn), ratio(drawn), ratio(place))
    found = bridge(weighted, region(weighted, math.log(3), 50.0), 4000.0)
    p, z = found.against(3.0, 0.0)
    assert found.log_error < 0.05 and p > 1e-3, z
    assert found.importance[1] > found.log_error


def test_region_leaves_out_what_a_proposal_never_draws() -> None:
    """A proposal on half of the plane is judged there, and its integral by the bridge is still the whole one."""
    weighted, place, size = toy(np.random.default_rng(2))
    front = weighted.place[:, 1] > 0
    half = Weighted(
        weighted.place[front],
        weighted.log_size[front],
        weighted.log_weight[front] - math.log(2),
        np.where(place[..., 1] > 0, weighted.other_log_weight - math.log(2), np.inf),
    )
    where = region(half, math.log(3), 50.0)
    assert 0.4 < where.share < 0.6
    assert marginals(half, place, size, where).p_value > 1e-3
    assert means(half, place, where).p_value > 1e-3
    p, _ = bridge(half, where, 1000.0).against(3.0, 0.0)
    assert p > 1e-3


def test_nothing_in_common() -> None:
    weighted, place, size = toy(np.random.default_rng(2))
    nothing = replace(weighted, log_weight=np.full(DRAWS, -np.inf), other_log_weight=np.full(place.shape[:2], np.inf))
    where = region(nothing, math.log(3), 50.0)
    assert (where.share, where.ess) == (0.0, 0.0)
    assert math.isinf(marginals(nothing, place, size, where).relative_error)
    assert math.isinf(means(nothing, place, where).relative_error)
    assert math.isnan(bridge(nothing, where, 1000.0).log_norm)


def test_standard_errors_of_weights_and_ensembles() -> None:
    """z-scores over 400 repetitions are standard normal (weights) or Student's (ensembles)."""
    random = np.random.default_rng(5)
    weights, ensembles = [], []
    for _ in range(400):
        x = random.normal(size=2000)
        found = Sample.of_weights(np.exp(0.5 * x), x[:, None])  # mean 1/2 under the weighted law
        weights.append((found.mean[0] - 0.5) / math.sqrt(found.variance[0]))
        value = random.normal(size=(8, 50)) + 0.5 * random.normal(size=(8, 1))
        found = Sample.of_ensembles(random.random((8, 50)) < 0.7, value[..., None])
        ensembles.append(found.mean[0] / math.sqrt(found.variance[0]))
    assert stats.kstest(weights, "norm").pvalue > 1e-3
    assert stats.kstest(ensembles, stats.t(7).cdf).pvalue > 1e-3


def test_few_large_weights_have_few_degrees_of_freedom() -> None:
    random = np.random.default_rng(5)
    x = random.normal(size=(10_000, 1))
    heavy = random.pareto(1.1, size=10_000) ** 2
    assert Sample.of_weights(np.ones(10_000), x).degrees > 5000
    assert Sample.of_weights(heavy, x).degrees < 10
    assert effective(np.log(heavy)) < 20
    assert effective(np.zeros(100)) == pytest.approx(100)


def test_smallest_p() -> None:
    assert smallest_p(np.array([0.01, 0.5])) == pytest.approx(1 - 0.99**2)
    assert smallest_p(np.array([1e-300, 1.0])) == pytest.approx(2e-300)
    same = Sample(np.array([1.0]), np.array([0.0]), 10.0)
    assert welch(same, same)[0] == pytest.approx(1.0)


def made_chains(offset: float = 0.0, start_bias: float = 0.0, seed: int = 0) -> Chains:
    """Independent draws around two places `offset` to either side, between which no walker moves."""
    random = np.random.default_rng(seed)
    steps, ensembles, walkers = 120, 8, 16
    place = 0.2 * random.normal(size=(steps, ensembles, walkers, 2))
    side = np.where(np.arange(walkers) % 2 == 0, 1, -1)
    place[..., 1] += offset * side
    start = np.arange(ensembles) // 4
    place[..., 0] += start_bias * start[:, None]
    size = -0.5 * ((place - [0, 0]) ** 2).sum(-1) / 0.04
    size = np.where(np.isfinite(size), size, 0) + (0 if offset == 0 else 0.5 * offset**2 / 0.04)
    return Chains(place, size, np.full(ensembles, 0.4), np.zeros(ensembles), start, 100)


def test_good_chains_have_no_reasons() -> None:
    for seed in range(3):
        found = diagnose(made_chains(seed=seed), limits=Limits())
        assert found.reasons == (), found
        assert found.autocorrelation < 3


def test_stuck_walkers_are_seen_though_the_proportions_are_right() -> None:
    """Both lobes have half of the walkers in every ensemble, so that ensembles agree perfectly."""
    found = diagnose(made_chains(offset=1.5))
    assert any("R-hat of walkers" in reason for reason in found.reasons)
    assert any("autocorrelation" in reason for reason in found.reasons)


def test_starts_that_differ_are_seen() -> None:
    """By a fifth of the spread."""
    found = diagnose(made_chains(start_bias=0.04))
    assert any("different starts" in reason for reason in found.reasons)


@pytest.mark.parametrize("field, value, word", [("acceptance", 0.01, "acceptance"), ("stuck", 0.1, "never moved")])
def test_lame_ensembles_are_seen(field: str, value: float, word: str) -> None:
    found = diagnose(replace(made_chains(), **{field: np.full(8, value)}))
    assert any(word in reason for reason in found.reasons)


def test_walkers_without_light_are_seen() -> None:
    chains = made_chains()
    chains.log_size[:, 0, 0] = -np.inf
    assert any("never found" in reason for reason in diagnose(chains).reasons)


def test_a_lobe_that_nobody_found_is_seen() -> None:
    """2 % of p* in a narrow lobe that sits on top of the one that all walkers are in."""
    chains, random = made_chains(), np.random.default_rng(3)
    broad = 0.2 * random.normal(size=(20_000, 2))
    narrow = np.array([0.1, 0.1]) + 0.001 * random.normal(size=(400, 2))
    place = np.concatenate([broad, narrow])
    size = np.concatenate([-0.5 * (broad**2).sum(-1) / 0.04, np.full(400, 6.0)])
    share = np.full(len(place), 1 / len(place))
    assert unvisited(chains, place, size, share, ess=20_000) == pytest.approx(400 / 20_400, rel=0.1)
    assert unvisited(chains, broad, size[:20_000], np.full(20_000, 1 / 20_000), ess=20_000) == 0.0
    assert any("hardly visited" in reason for reason in diagnose(chains, (place, size, share)).reasons)
