"""Averages of estimators: their variance formula, the inequalities behind the chapter's claim, unbiased readings."""

from __future__ import annotations

import fnmatch
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from dsfit.experiment.plots.style import styled
from dsfit.figures import Estimate, catalogue
from dsfit.figures.data import read_data, write_data
from dsfit.figures.experiment import Work
from dsfit.figures.page import Page
from dsfit.mis.heuristics import Heuristic
from experiments._averaging_sampled import draws, estimators, forms
from experiments._mis_spot import Spot
from experiments.averaging import EXPERIMENT, _statistics, average_variance
from experiments.drawing import averaging as drawing

ROOT = Path(__file__).parents[2]
NAMES = ["transmittance_gaussian", "uniform", "M_TRT", "back"]


@pytest.fixture(scope="module")
def spot() -> Spot:
    return Spot("brown", 30.0, 2.0)


@dataclass(frozen=True)
class Equal(Heuristic):
    """w_s = 1/K: the average of the K estimators."""

    def log_weights(self, log_p: Tensor, counts: Tensor) -> Tensor:
        return torch.full_like(log_p, -math.log(len(log_p)))


def test_the_average_has_the_mean_of_the_variances(spot: Spot) -> None:
    single = np.array([spot.single(name) for name in NAMES])
    by_weights = spot.value(NAMES, [1 / len(NAMES)] * len(NAMES), Equal())
    assert average_variance(single) == pytest.approx(by_weights, rel=1e-9)
    found = drawing.averages(single)
    assert found[0][-1] == pytest.approx(average_variance(single), rel=1e-12)
    assert found[2][-1] == single.min()


def test_balance_lies_below_the_average_and_the_average_above_the_best(spot: Spot) -> None:
    for count in range(2, len(NAMES) + 1):
        single = [spot.single(name) for name in NAMES[:count]]
        balance = spot.value(NAMES[:count], [1 / count] * count)
        assert balance <= average_variance(np.array(single)) * (1 + 1e-12)
        assert min(single) <= average_variance(np.array(single)) <= max(single)


def test_measured_averages_agree(spot: Spot) -> None:
    some = draws(spot, NAMES, 200, 48, 5)
    exact = (average_variance(np.array([spot.single(name) for name in NAMES])), spot.value(NAMES, [0.25] * 4))
    for expected, (value, variance) in zip(exact, (some.average(), some.balance()), strict=True):
        found, error, mean, mean_error = _statistics(spot, value, variance)
        assert abs(found - expected) < 4.5 * error
        assert abs(mean - 1) < 4.5 * mean_error


def test_lean_estimators_estimate_the_integral(spot: Spot) -> None:
    for name, estimator in estimators(spot, NAMES, "M_TRT").items():
        generator = torch.Generator().manual_seed(6)
        values = torch.stack([estimator(400, generator) for _ in range(40)]).sum(-1) / spot.integral.sum()
        assert abs(float(values.mean()) - 1) < 4.5 * float(values.std()) / 40**0.5, name


def test_readings_of_the_equations(spot: Spot) -> None:
    rows = {(row["density"], row["reading"]): row for row in forms(Spot("blond", 0.0, 0.0), 1200, 32, 7)}
    z = {key: (row["mean"] - 1) / row["mean_se"] for key, row in rows.items()}
    right = [key for key in z if "corrected" in key[0] and "no weights" not in key[1]]
    assert len(right) == 4 and all(abs(z[key]) < 4.5 for key in right)
    assert all(abs(z[key]) > 8 for key in z if "printed" in key[0])
    (unweighted,) = (row["mean"] for key, row in rows.items() if "no weights" in key[1])
    assert unweighted == pytest.approx(2, abs=0.2)


def test_a_small_run_is_drawn_and_tabulated(tmp_path: Path) -> None:
    settings = catalogue.find(ROOT, "averaging").settings(EXPERIMENT.small)
    made = EXPERIMENT.compute(settings, Work(tmp_path, ROOT, lambda what: None))
    assert (made.arrays["pairs"][:, 3] >= 1).all()
    # balance is below the average of every pair, which is never below the better one
    assert (made.arrays["pairs"][:, 4] <= (1 + made.arrays["pairs"][:, 3]) / 2 * (1 + 1e-9)).all()
    assert np.isinf(made.arrays["single"][:, settings.order.index("R")]).all()
    values = dict(made.values())
    for pattern, rule in EXPERIMENT.reproduces.items():
        assert fnmatch.filter(values, pattern), pattern
        assert not isinstance(rule, Estimate) or fnmatch.filter(values, rule.error), pattern
    write_data(tmp_path, made)
    data = read_data(tmp_path)
    with styled():
        assert set(drawing.figures(data, Page())) == {"proposals", "pairs", "bad", "time"}
    tables = {table.name: table for table in drawing.tables(data)}
    assert all(row[2] == "0" for row in tables["pairs"].rows)
