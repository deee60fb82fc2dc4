"""The chi-square check: right samplers pass with uniform p-values, wrong ones are rejected, masses are integrated."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from scipy import stats
from torch import Tensor

import dsfit
from dsfit.checks.chi_square import chi_square, findings, pooled_chi_square, run
from dsfit.checks.finding import judge
from dsfit.checks.subject import Subject
from dsfit.context import Context
from dsfit.errors import InputError
from dsfit.proposals import GaussianLobe, Product, StructuredProposal, UniformAzimuth, UniformSphere, chapter_proposals
from dsfit.proposals.base import Distribution, Proposal
from dsfit.proposals.printed import PRINTED

DEG = math.pi / 180


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def narrow(width: float) -> Proposal:
    return Product(GaussianLobe(0.1, width), UniformAzimuth())


@dataclasses.dataclass
class Altered(Distribution):
    """A distribution with its samples or its density changed."""

    inner: Distribution
    move: object = None
    weigh: object = None

    def __post_init__(self) -> None:
        self.dimension, self.batch_shape = self.inner.dimension, self.inner.batch_shape

    def sample(self, u: Tensor) -> Tensor:
        omega = self.inner.sample(u)
        return omega if self.move is None else self.move(omega)

    def sample_with_log_prob(self, u: Tensor) -> tuple[Tensor, Tensor]:
        omega = self.sample(u)
        return omega, self.log_prob(omega)

    def log_prob(self, omega: Tensor) -> Tensor:
        log = self.inner.log_prob(omega)
        return log if self.weigh is None else log + self.weigh(omega)


class Wrong(Proposal):
    """A proposal with a planted slip."""

    def __init__(self, inner: Proposal, move: object = None, weigh: object = None) -> None:
        super().__init__()
        self.inner, self.move, self.weigh = inner, move, weigh

    def forward(self, context: Context) -> Distribution:
        return Altered(self.inner(context), self.move, self.weigh)


def test_p_values_of_a_right_sampler_are_uniform() -> None:
    context = Context(0.5, 0.3)
    p_values = [chi_square(narrow(0.2), context, 4000, (8, 6), generator=generator(k)).p_value for k in range(60)]
    assert stats.kstest(p_values, "uniform").pvalue > 0.01


@pytest.mark.parametrize("width", [2e-5, 1e-3, 0.1, 5.0])
@pytest.mark.parametrize("theta_r", [0.0, 80 * DEG, 89.999 * DEG])
def test_narrow_lobes_and_grazing_viewers(width: float, theta_r: float) -> None:
    test = chi_square(narrow(width), Context(theta_r), 20_000, generator=generator(3))
    assert test.p_value > 1e-4 and abs(test.mass - 1) < 1e-5 and test.blur < 0.1
    assert test.degrees > 50  # the cells resolve the lobe


def test_a_small_error_of_width_is_found() -> None:
    """The density of a lobe 3 % wider than the one that is drawn."""

    class Wider(Altered):
        def log_prob(self, omega: Tensor) -> Tensor:
            return narrow(0.01 * 1.03)(Context(0.4)).log_prob(omega)

    class Slip(Wrong):
        def forward(self, context: Context) -> Distribution:
            return Wider(self.inner(context))

    assert chi_square(Slip(narrow(0.01)), Context(0.4), 100_000, generator=generator(1)).p_value < 1e-6


@pytest.mark.parametrize(
    ("move", "weigh"),
    [
        (lambda omega: torch.stack([-omega[..., 0], omega[..., 1]], -1), None),
        (lambda omega: torch.stack([omega[..., 0], -omega[..., 1]], -1), None),
        (None, lambda omega: torch.log(torch.cos(omega[..., 0]))),
        (lambda omega: torch.where(torch.rand(len(omega), 1, generator=generator(5)) < 1e-4, math.nan, omega), None),
        (lambda omega: torch.stack([omega[..., 0] + 0.01, omega[..., 1]], -1), None),
        (None, lambda omega: torch.full_like(omega[..., 0], math.log(2.0))),
    ],
    ids=["theta flipped", "phi flipped", "cosine forgotten", "some NaN", "shifted by 0.6 degrees", "twice too large"],
)
def test_wrong_samplers_are_rejected(move: object, weigh: object) -> None:
    right = chapter_proposals(dsfit.Fiber.preset("blond"))["TT"]
    context = Context(0.6, 0.8)
    good = chi_square(right, context, generator=generator(2))
    assert all(v == "pass" for _, v in judge(findings("TT", "", good)))
    bad = findings("TT", "", chi_square(Wrong(right, move, weigh), context, generator=generator(2)))
    assert bad[0].p_value < 1e-6 or bad[1].value > 0.1
    assert "fail" in [v for _, v in judge(bad)]


@pytest.mark.parametrize("name", PRINTED)
def test_printed_samplers_are_rejected(name: str) -> None:
    """At one of the viewers at least: the clamped lobe differs at grazing only."""
    found = [
        findings(name, "", chi_square(PRINTED[name](), Context(t * DEG, 0.2), 20_000, generator=generator(4)))
        for t in (0.0, 46.0, 80.0)
    ]
    assert min(f[0].p_value for f in found) < 1e-6 or max(f[1].value for f in found) > 0.01


def test_float32_samples() -> None:
    context = Context(torch.tensor(0.7, dtype=torch.float32))
    test = chi_square(narrow(0.05), context, 20_000, generator=generator(6))
    assert test.p_value > 1e-4 and abs(test.mass - 1) < 1e-4


def test_pooling() -> None:
    expected = torch.tensor([100.0, 1.0, 1.0, 98.0])
    assert pooled_chi_square(torch.tensor([101, 1, 0, 98]), expected)[2] == 1  # two rare cells join the rarest
    assert pooled_chi_square(torch.tensor([90, 20, 0, 90]), expected)[0] < 1e-12  # twenty where two belong
    assert pooled_chi_square(torch.tensor([7]), torch.tensor([7.0])) == (1.0, 0.0, 0)


def test_it_says_where_it_cannot_tell() -> None:
    """A density with 400 jumps: too many for the budget, so nothing is claimed."""

    class Comb(Altered):
        def log_prob(self, omega: Tensor) -> Tensor:
            stripes = torch.sin(4000 * omega[..., 0] + 3000 * omega[..., 1]) > 0
            return self.inner.log_prob(omega) + torch.log(0.02 + 1.96 * stripes.double())

    class Striped(Wrong):
        def forward(self, context: Context) -> Distribution:
            return Comb(self.inner(context))

    test = chi_square(Striped(UniformSphere()), Context(0.2), 10**5, (30, 20), generator=generator(1))
    found = findings("comb", "", test)
    assert [v for _, v in judge(found)][1] == "unclear"


def test_bad_arguments() -> None:
    with pytest.raises(InputError, match="context"):
        chi_square(UniformSphere(), Context(torch.tensor([0.1, 0.2])), generator=generator(0))
    with pytest.raises(InputError, match="samples"):
        chi_square(UniformSphere(), Context(0.1), 50, generator=generator(0))


def test_run_keeps_the_cells_of_the_least_likely() -> None:
    bsdf = dsfit.DualScattering(dsfit.Fiber.preset("brown"), precision="table")
    context = Context(0.3, 0.1, 2.0)
    proposals = {"structured": StructuredProposal(bsdf, context), "wrong": PRINTED["front_as_printed"]()}
    outcome = run(Subject(dsfit.Integrand(bsdf), context, proposals, "here", 4), samples=5000)
    verdicts = {f.subject: v for f, v in judge(outcome.findings)}
    assert verdicts == {"structured": "pass", "structured, mass": "pass", "wrong": "pass", "wrong, mass": "fail"}
    assert outcome.arrays["wrong/observed"].sum() == 5000
