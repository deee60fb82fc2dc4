"""Variances of the MIS heuristics: what must hold exactly, agreement of measurement and quadrature, planted faults."""

from __future__ import annotations

import fnmatch
import math
from dataclasses import dataclass
from pathlib import Path

import pytest
from torch import Tensor

from dsfit.experiment.plots.style import styled
from dsfit.figures import Estimate, catalogue
from dsfit.figures.data import read_data, write_data
from dsfit.figures.experiment import Work
from dsfit.figures.page import Page
from dsfit.mis import Balance
from dsfit.mis.heuristics import Heuristic
from experiments._mis_spot import Spot
from experiments._mis_variance_sampled import measure
from experiments.drawing import mis_variance as drawing
from experiments.mis_variance import EXPERIMENT, MisVariance, rules

ROOT = Path(__file__).parents[2]
NAMES, SHARES = ["TT", "TRT", "back", "uniform"], (0.4, 0.3, 0.2, 0.1)
RULES = rules(
    MisVariance.model_construct(powers=[1.5, 2.0, 8.0], cutoffs=[0.1, 0.5]),
)


@pytest.fixture(scope="module")
def spot() -> Spot:
    return Spot("blond", 20.0, 1.0, 0.4)


def test_balance_is_within_the_bound_of_the_best(spot: Spot) -> None:
    # Veach 1997, theorem 9.2: Var[balance] <= Var[any] + (1/min n_s - 1/N) I^2
    balance = spot.value(NAMES, SHARES)
    best = min(spot.value(NAMES, SHARES, rule) for rule in RULES.values() if rule != "optimal")
    assert balance <= best + 1 / min(SHARES) - 1


def test_balance_is_the_best_of_the_one_sample_model(spot: Spot) -> None:
    found = {name: spot.value(NAMES, SHARES, rule, "one") for name, rule in RULES.items() if name != "optimal"}
    assert all(value >= found["balance"] for value in found.values())
    assert found["maximum"] > 1.05 * found["balance"]


@pytest.mark.parametrize("model", ["multi", "one"])
def test_optimal_weights_are_at_least_as_good_as_balance(spot: Spot, model: str) -> None:
    optimal = spot.value(NAMES, SHARES, "optimal", model)
    assert optimal <= spot.value(NAMES, SHARES, "balance", model)
    assert optimal <= min(spot.value(NAMES, SHARES, rule, model) for rule in RULES.values())


def test_fixed_counts_never_cost_variance(spot: Spot) -> None:
    for rule in RULES.values():
        assert spot.value(NAMES, SHARES, rule) <= spot.value(NAMES, SHARES, rule, "one") * (1 + 1e-12)


def test_powers_lie_between_balance_and_maximum(spot: Spot) -> None:
    powers = [spot.value(NAMES, SHARES, {"kind": "power", "beta": beta}) for beta in (1.0, 1e4)]
    assert powers[0] == pytest.approx(spot.value(NAMES, SHARES), rel=1e-12)
    assert powers[1] == pytest.approx(spot.value(NAMES, SHARES, "maximum"), rel=2e-2)


def test_variances_that_are_infinite_or_undefined_are_told(spot: Spot) -> None:
    assert [spot.diverges(name) for name in ("R", "TRT", "TT", "uniform", "M_TRT")] == [True, True, False, False, False]
    assert spot.single("R") == math.inf and math.isnan(spot.single("front"))
    assert spot.single("uniform") == spot.value(["uniform"], [1.0])


@pytest.mark.parametrize("model", ["multi", "one"])
def test_measured_variances_and_means_agree_with_quadrature(spot: Spot, model: str) -> None:
    found = measure(spot, NAMES, SHARES, list(RULES.values()), model, 400, 48, 3)
    for (name, rule), one in zip(RULES.items(), found, strict=True):
        allowed = 4.5 * one.variance_se + (0.15 if name == "optimal" else 0.0) * one.variance
        assert abs(one.variance - spot.value(NAMES, SHARES, rule, model)) < allowed, name
        assert abs(one.mean - 1) < 4.5 * one.mean_se, name


@dataclass(frozen=True)
class Wrong(Heuristic):
    """Balance weights that sum to 0.9, or that use the square of the counts without normalising anew."""

    factor: float = 0.9

    def log_weights(self, log_p: Tensor, counts: Tensor) -> Tensor:
        return Balance().log_weights(log_p, counts) + math.log(self.factor)


@pytest.mark.parametrize("model", ["multi", "one"])
def test_weights_that_do_not_sum_to_one_are_seen(spot: Spot, model: str) -> None:
    right, wrong = measure(spot, NAMES, SHARES, ["balance", Wrong()], model, 400, 48, 4)
    assert abs(right.mean - 1) < 4.5 * right.mean_se
    assert abs(wrong.mean - 1) > 8 * wrong.mean_se
    assert wrong.mean == pytest.approx(0.9 * right.mean, rel=1e-12)


def test_a_small_run_is_drawn_and_tabulated(tmp_path: Path) -> None:
    overrides = (
        *EXPERIMENT.small, "samples=56", "repeats=3", "shares=5", "powers=[2.0]", "cutoffs=[0.1]", "timing_samples=56",
        'pairs=[{first="TT", second="uniform", n=0.0}]', 'sets={two=["TT", "uniform"], three=["R", "TT", "uniform"]}',
    )  # fmt: skip
    settings = catalogue.find(ROOT, "mis_variance").settings(overrides)
    made = EXPERIMENT.compute(settings, Work(tmp_path, ROOT, lambda what: None))
    assert made.arrays["exact"].shape == (1, 1, 1, len(settings.sets), 5, 2)
    for name in ("exact", "variance", "variance_se", "seconds_per_sample"):
        assert (made.arrays[name] > 0).all(), name
    values = dict(made.values())
    for pattern, rule in EXPERIMENT.reproduces.items():
        assert fnmatch.filter(values, pattern), pattern
        assert not isinstance(rule, Estimate) or fnmatch.filter(values, rule.error), pattern
    write_data(tmp_path, made)
    data = read_data(tmp_path)
    with styled():
        figures = drawing.figures(data, Page())
    assert set(figures) == {"heuristics", "measured", "shares"}
    summary = drawing.tables(data)[0]
    wins = [int(row[6]) for row in summary.rows if row[6] != "–"]
    assert sum(wins) == len(settings.sets) * 2  # one winner for each set and model
