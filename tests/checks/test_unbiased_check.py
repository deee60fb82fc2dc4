"""The estimator check: p-values of right estimators are uniform, wrong densities and weights are rejected."""

from __future__ import annotations

import dataclasses
import math
from unittest import mock

import pytest
import torch
from scipy import stats

import dsfit
from dsfit.checks.finding import judge
from dsfit.checks.subject import Subject
from dsfit.checks.unbiased import agreement, hotelling, run
from dsfit.mis.heuristics import Power
from dsfit.proposals import StructuredProposal, UniformSphere, chapter_proposals
from dsfit.proposals.printed import PRINTED

BSDF = dsfit.DualScattering(dsfit.Fiber.preset("blond"), precision="table")
INTEGRAND, CONTEXT = dsfit.Integrand(BSDF), dsfit.Context(0.5, 0.2, 2.0, 0.3)


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.fixture(scope="module")
def truth() -> dsfit.quality.Reference:
    return dsfit.reference(INTEGRAND, CONTEXT, 1e-5)


def test_hotelling_has_uniform_p_values_whatever_the_covariance() -> None:
    mix = torch.tensor([[1.0, 0.9, 0.0], [0.2, 0.1, 3.0], [0.0, 1.0, 1.0]], dtype=torch.float64)
    truth, g = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64), generator(1)
    p_values = []
    for _ in range(400):
        values = truth + torch.randn(32, 3, generator=g, dtype=torch.float64) @ mix
        p_values.append(hotelling(values, truth, torch.zeros(3)).p_value)
    assert stats.kstest(p_values, "uniform").pvalue > 0.01


def test_grey_channels_count_once() -> None:
    g = generator(2)
    p_values = []
    for _ in range(300):
        values = 1 + torch.randn(32, 1, generator=g, dtype=torch.float64).expand(-1, 3)
        p_values.append(hotelling(values, torch.ones(3).double(), torch.zeros(3)).p_value)
    assert stats.kstest(p_values, "uniform").pvalue > 0.01


def test_p_values_of_right_estimators_are_uniform(truth: dsfit.quality.Reference) -> None:
    strategies = [StructuredProposal(BSDF, CONTEXT), UniformSphere()]
    p_values = [
        agreement(INTEGRAND, strategies, CONTEXT, truth, 3200, generator=generator(k)).p_value for k in range(40)
    ]
    assert stats.kstest(p_values, "uniform").pvalue > 0.01


@pytest.mark.parametrize("name", [n for n in PRINTED if n not in ("lobe_clamped", "azimuth_clamped")])
def test_printed_samplers_are_rejected(name: str, truth: dsfit.quality.Reference) -> None:
    strategies = [PRINTED[name](), UniformSphere()]
    found = agreement(INTEGRAND, strategies, CONTEXT, truth, 200_000, generator=generator(3))
    assert found.p_value < 1e-6


def test_weights_that_do_not_sum_to_one_are_rejected(truth: dsfit.quality.Reference) -> None:
    chapter = chapter_proposals(BSDF)
    strategies = [chapter["TT"], chapter["R"], chapter["uniform"]]
    right = agreement(INTEGRAND, strategies, CONTEXT, truth, 100_000, "power", generator=generator(4))
    original = Power.log_weights
    with mock.patch.object(Power, "log_weights", lambda self, *a: original(self, *a) + math.log(1.1)):
        wrong = agreement(INTEGRAND, strategies, CONTEXT, truth, 100_000, "power", generator=generator(4))
    assert right.p_value > 1e-3 and wrong.p_value < 1e-6 and right.relative_error < 0.02


def test_run_says_where_it_cannot_tell() -> None:
    """A narrow lobe in the wrong place beside few uniform samples: too noisy to judge."""
    black = dsfit.Integrand(dsfit.DualScattering(dsfit.Fiber.preset("black", beta=torch.full((3,), 1e-3).double())))
    subject = Subject(black, dsfit.Context(0.3), {"uniform": UniformSphere()}, "black", 5)
    outcome = run(subject, samples=1000, heuristics=["balance"], rtol=1e-4)
    assert all(v == "unclear" for _, v in judge(outcome.findings)) and len(outcome.findings) == 5


def test_run_passes_on_the_chapters_proposals() -> None:
    chapter = chapter_proposals(BSDF)
    subject = Subject(INTEGRAND, CONTEXT, {k: chapter[k] for k in ("TT", "MG_TT", "back")}, "blond", 6)
    outcome = run(subject, samples=20_000)
    verdicts = [v for _, v in judge(outcome.findings)]
    assert "fail" not in verdicts and verdicts.count("pass") > 8


def test_wrong_error_bars_are_rejected() -> None:
    """Half the standard error claimed: the value is right, the claim is not."""
    chapter = chapter_proposals(BSDF)
    subject = Subject(INTEGRAND, CONTEXT, {k: chapter[k] for k in ("TT", "MG_TT", "back")}, "blond", 6)
    original = dsfit.mis.estimate

    def optimistic(*args: object, **options: object) -> dsfit.Estimate:
        found = original(*args, **options)
        return dataclasses.replace(found, standard_error=0.5 * found.standard_error)

    with mock.patch("dsfit.mis.estimate", optimistic):
        outcome = run(subject, samples=20_000, heuristics=["balance"])
    verdicts = {f.subject: v for f, v in judge(outcome.findings)}
    assert verdicts.pop("claimed standard errors") == "fail"
    assert "fail" not in verdicts.values()
