"""Errors with intervals, and the test against the truth."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from dsfit.race.statistics import centred, relative_squared, rmse


def generator(seed: int = 1) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def normal(*shape: int, seed: int = 1) -> Tensor:
    return torch.randn(*shape, generator=generator(seed), dtype=torch.float64)


def test_relative_squared_is_the_norm_over_channels_relative_to_that_of_the_truth() -> None:
    truth = torch.tensor([[3.0, 4.0], [0.0, 2.0]])
    estimates = torch.tensor([[3.0, 4.5], [2.0, 2.0]])
    assert relative_squared(estimates, truth).tolist() == pytest.approx([0.25 / 25, 4 / 4])


@pytest.mark.parametrize("count", [8, 32, 400])
def test_the_interval_of_normal_errors_holds_the_true_one_about_as_often_as_it_says(count: int) -> None:
    sigma, trials = 0.3, 600
    squared = (sigma * normal(trials, count)).square()
    found = [rmse(row) for row in squared]
    covered = sum(x.low <= sigma <= x.high for x in found) / trials
    assert 0.9 < covered < 0.99
    assert all(x.low < x.value < x.high and 1 <= x.degrees <= count and x.count == count for x in found)


def test_the_interval_widens_with_the_tails_and_says_when_one_estimate_decides() -> None:
    light = rmse(normal(64).square())
    weights = torch.exp(6 * normal(64, seed=2))
    heavy = rmse(weights.square())
    assert heavy.high / heavy.low > 3 * light.high / light.low
    assert heavy.heavy and heavy.top_share > 0.5 and not light.heavy


def test_no_error_at_all_and_infinite_ones() -> None:
    assert rmse(torch.zeros(10)).value == 0
    assert math.isinf(rmse(torch.tensor([1.0, math.inf])).value)
    assert rmse(torch.tensor([4.0])).value == 2 and rmse(torch.tensor([4.0])).degrees == 1


def test_estimates_around_the_truth_pass_and_their_p_values_are_not_small() -> None:
    tests = [centred(0.02 * row, 0.0) for row in normal(300, 32, 3)]
    assert sum(x.tested for x in tests) > 295
    p = torch.tensor([x.p_value for x in tests if x.tested])
    assert p.min() > 1e-4 and 0.4 < float((p < 0.5).double().mean()) < 0.6


def test_a_bias_is_seen_and_forgiven_up_to_the_allowance() -> None:
    deviations = 0.002 * normal(64, 3) + torch.tensor([0.0, 0.01, 0.0], dtype=torch.float64)
    assert centred(deviations, 0.0).p_value < 1e-20
    assert centred(deviations, 0.0).bias == pytest.approx(0.01, rel=0.1)
    assert centred(deviations, 0.011).p_value > 1e-3


def test_what_cannot_be_told_is_not_tested() -> None:
    assert not centred(0.5 * normal(32, 1), 0.0).tested  # the mean is known to 9 % only
    assert not centred(1e-3 * normal(4, 1), 0.0).tested  # too few
    rare = torch.full((64, 1), -0.001, dtype=torch.float64)
    rare[0] = 0.02
    assert not centred(rare, 0.0).tested  # one estimate decides
    assert not centred(1e-3 * normal(32, 1), 0.0, predicted=0.5).tested  # quadrature knows better
