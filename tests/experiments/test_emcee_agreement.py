"""Walkers, the fitted proposal and quadrature agree, and a wrong proposal is seen not to."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy import stats
from torch import Tensor

from dsfit.bsdf.dual_scattering import DualScattering
from dsfit.bsdf.fiber import Fiber
from dsfit.checks.independent import Chains
from dsfit.context import Context
from dsfit.figures import Data, Estimate, Exact
from dsfit.figures.data import read_data, write_data
from dsfit.figures.experiment import Work
from dsfit.figures.page import Page
from dsfit.figures.verify import error_name, rules_of
from dsfit.proposals.base import Distribution, Proposal
from experiments._emcee_cell import Cell, Sizes, Walk, acceptance, autocorrelation, compare, walk
from experiments.drawing import emcee_agreement as drawing
from experiments.drawing._emcee_corner import _level
from experiments.drawing._emcee_costs import ACCURACY, costs
from experiments.emcee_agreement import EXPERIMENT, EmceeAgreement, compute

ROOT = Path(__file__).parents[2]
SMALL = Sizes(ensembles=8, walkers=16, steps=160, burn_in=60, samples=8192, fit_steps=3)


class Changed(Proposal):
    """A proposal whose density is not its sampler's."""

    def __init__(self, fitted: Proposal, scale: float = 1.0, forward: float = 0.0) -> None:
        super().__init__()
        self.fitted, self.scale, self.forward_share = fitted, scale, forward

    def forward(self, context: Context) -> Distribution:
        law, scale, more = self.fitted(context), self.scale, self.forward_share

        class Law(Distribution):
            dimension, batch_shape = law.dimension, context.batch_shape

            def sample_with_log_prob(self, u: Tensor) -> tuple[Tensor, Tensor]:
                omega = law.sample(u)
                return omega, self.log_prob(omega)

            def log_prob(self, omega: Tensor) -> Tensor:
                tilt = 1 + more * torch.cos(context.phi_r - omega[..., 1])
                return law.log_prob(omega) + torch.log(scale * tilt)

        return Law()


@pytest.fixture(scope="module")
def blond() -> DualScattering:
    return DualScattering(Fiber.preset("blond"), precision="table")


@pytest.fixture(scope="module")
def walked(blond) -> Walk:
    return walk(blond, Context(math.radians(45), 0.0, 3.0, 0.5, dtype=torch.float64), SMALL, 3)


@pytest.fixture(scope="module")
def right(walked) -> Cell:
    return compare(walked, walked.fitted, SMALL.samples, 4, maps=True)


def judged(walked: Walk, law: Proposal) -> dict[str, float]:
    return compare(walked, law, SMALL.samples, 4).numbers["p"]


@pytest.mark.parametrize("axis", ["theta", "phi", "size"])
def test_marginals_of_all_three_agree(right, axis):
    exact = right.arrays[f"{axis}.quadrature"]
    assert exact.sum() == pytest.approx(1, abs=2e-3)
    likely = exact > 1e-3
    for kind in ("chain", "proposal"):
        found, error = right.arrays[f"{axis}.{kind}"], right.arrays[f"{axis}.{kind}_error"]
        assert found.sum() == pytest.approx(1, abs=5e-3)
        z = (found - exact)[likely] / error[likely]
        # standard errors from eight ensembles have seven degrees of freedom
        assert np.abs(z).max() < stats.t.isf(1e-3 / len(z), 7)
        assert np.sqrt((z**2).mean()) > 0.3, "standard errors that are far too large agree with anything"


def test_the_integral_agrees(right):
    for key in ("bridge", "importance"):
        z = (right.numbers[key] - right.numbers["quadrature"]) / right.numbers[f"{key}_error"]
        assert abs(z) < 5
    assert right.numbers["grid_gap"] < 1e-4
    assert all(p > 1e-4 for p in right.numbers["p"].values())


def test_a_density_of_the_wrong_scale_is_seen_by_the_bridge(walked):
    p = judged(walked, Changed(walked.fitted, scale=1.05))
    assert p["bridge"] < 1e-6 and p["marginals"] > 1e-4


def test_a_density_that_is_not_the_samplers_is_seen_by_the_marginals(walked):
    p = judged(walked, Changed(walked.fitted, forward=0.9))
    # eight ensembles have seven degrees of freedom
    assert min(p["marginals"], p["means"]) < 1e-4 and p["chains_quadrature"] > 1e-4


@pytest.mark.parametrize(("steps", "expected"), [(4000, 8.8), (600, 7.65)])
def test_autocorrelation_of_a_known_chain(steps, expected):
    """x' = r x + noise has tau = (1 + r) / (1 - r) = 9; emcee's estimate is lower by some 10 tau^2 / steps."""
    random, r = np.random.default_rng(1), 0.8
    x = np.zeros((steps, 8, 16))
    for k in range(1, steps):
        x[k] = r * x[k - 1] + math.sqrt(1 - r * r) * random.normal(size=(8, 16))
    # theta and phi are white: log |F| has the longest memory
    place = 0.1 + 1e-3 * random.normal(size=(steps, 8, 16, 2))
    tau, error = autocorrelation(Chains(place, x, np.ones(8), np.zeros(8), np.zeros(8, dtype=int), 1))
    assert 0 < error < 0.5
    assert tau == pytest.approx(expected, abs=4 * error)


def test_acceptance_scatters_as_the_kinds_of_moves_do():
    """In half of the steps everybody moves, in the others nobody: the share of 1/2 is known to 1 / sqrt(4 steps)."""
    random, steps = np.random.default_rng(1), 401
    moves = random.random((steps, 1, 1, 1)) < 0.5
    place = np.cumsum(np.broadcast_to(moves, (steps, 8, 16, 2)), axis=0).astype(float)
    share, error = acceptance(Chains(place, place[..., 0], np.ones(8), np.zeros(8), np.zeros(8, dtype=int), 1))
    assert error == pytest.approx(0.5 / math.sqrt(steps - 1), rel=0.05)
    assert share == pytest.approx(0.5, abs=4 * error)


def known(**changes) -> dict:
    numbers = {
        "bulk_ess": 1000.0, "between_ess": 2000.0, "between_ess_error": 500.0, "chain_evaluations": 30_000,
        "burn_in_evaluations": 6_000, "ensembles": 4, "samples": 10_000, "excess": 0.04, "bridge": 2.0,
        "bridge_error": 0.004, "seconds": {"chains": 3.6, "samples": 0.5, "fit": 1.0},
    }  # fmt: skip
    return numbers | changes


def test_costs_follow_from_errors():
    found = costs(known())
    assert found.chain_each == 30 and found.proposal_each == pytest.approx(1.04)
    assert found.proposal_integral == pytest.approx(0.04 / ACCURACY**2)
    assert found.chain_integral == pytest.approx(40_000 * (0.002 / ACCURACY) ** 2 + 1500)
    assert found.chain_seconds == pytest.approx(3.5 * 4 + 0.15)
    assert costs(known(bridge_error=0.002)).chain_integral == pytest.approx(40_000 + 1500)
    assert costs(known(between_ess=500.0)).chain_each == 60


def test_walkers_cost_more_than_the_proposal(right):
    found = costs(right.numbers)
    assert found.chain_each > 3 * found.proposal_each
    assert found.chain_integral > found.proposal_integral


def test_contours_hold_the_share_that_they_name():
    share = np.random.default_rng(2).exponential(size=(60, 80))
    share /= share.sum()
    for inside in (0.5, 0.9, 0.99):
        assert share[share >= _level(share, inside)].sum() == pytest.approx(inside, abs=2e-3)


@pytest.fixture(scope="module")
def stored(right, tmp_path_factory) -> Data:
    folder = tmp_path_factory.mktemp("emcee")
    arrays = {f"blond0.{key}": value for key, value in right.arrays.items()}
    record = {
        "order": ["blond0"],
        "contexts": 1,
        "shown": 0,
        "bins": {"theta": 36, "phi": 36, "size": 24},
        "sizes": [SMALL.ensembles, SMALL.walkers, SMALL.steps, SMALL.burn_in],
        "cells": {"blond0": {"preset": "blond", "context": [45.0, 3.0, 0.5], **right.numbers}},
    }
    write_data(folder, Data(arrays, record))
    return read_data(folder)


def test_everything_is_drawn_from_the_files_alone(stored):
    figures = drawing.figures(stored, Page())
    assert list(figures) == ["marginals_0", "corner", "costs"]
    for figure in figures.values():
        figure.draw_without_rendering()
        assert figure.get_size_inches()[0] * 25.4 == pytest.approx(150)
    found = {table.name: table.rows for table in drawing.tables(stored)}
    assert {name: len(rows) for name, rows in found.items()} == {"mixing": 1, "agreement": 1, "costs": 1}


def test_every_statistical_value_has_its_standard_error(stored):
    rules = rules_of(dict(stored.values()), EXPERIMENT.reproduces)
    estimates = {name for name, (rule, _) in rules.items() if isinstance(rule, Estimate)}
    assert {"blond0.theta.chain", "blond0.phi.proposal", "cells.blond0.bridge", "cells.blond0.tau"} <= estimates
    for name in estimates:
        rule, pattern = rules[name]
        assert rules[error_name(rule, pattern, name)][1] == "", name
    exact = {name for name, (rule, _) in rules.items() if isinstance(rule, Exact)}
    assert exact == {
        "order", "contexts", "shown", "sizes", "bins.theta", "bins.phi", "bins.size",
        *(f"cells.blond0.{name}" for name in ("preset", "context", "reasons", "samples", "ensembles")),
        *(f"cells.blond0.{name}_evaluations" for name in ("chain", "burn_in")),
    }  # fmt: skip


@pytest.mark.slow
def test_the_small_run_is_drawn(tmp_path):
    settings = EmceeAgreement(
        presets=["black"], contexts=[[15.0, 0.0, 1.0], [45.0, 3.0, 0.5]], shown=1, steps=60, burn_in=20, samples=4096,
        fit_steps=2,
    )  # fmt: skip
    write_data(tmp_path, compute(settings, Work(tmp_path, ROOT, lambda _: None)))
    data = read_data(tmp_path)
    assert data.record["order"] == ["black0", "black1"]
    assert list(drawing.figures(data, Page())) == ["marginals_0", "marginals_1", "corner", "costs"]
