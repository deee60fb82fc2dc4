"""Monte Carlo gradients of the second moment: unbiased where they claim it, with standard errors that are true, and
planted faults rejected."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from scipy import stats

import dsfit
from dsfit.checks.gradients.agreement import POWER, agreement, planted_faults
from dsfit.checks.gradients.estimators import (
    ESTIMATORS,
    GradientEstimate,
    Problem,
    components_of,
    path_strata,
    pathwise_of,
    score_function,
    score_rows,
    summary,
)
from dsfit.checks.gradients.jumps import find_jumps
from dsfit.checks.gradients.moment import (
    ExactMoment,
    Layout,
    defended,
    learnable,
    log_prob_and_slopes,
    moment_gradient,
)
from dsfit.checks.gradients.moment_findings import jumps_of
from dsfit.errors import InputError
from dsfit.proposals import (
    CosineHalf,
    FrontHalf,
    GaussianLobe,
    Mixture,
    Product,
    UniformAzimuth,
    UniformSphere,
    WrappedGaussian,
    chapter_proposals,
)

CONTEXT = dsfit.Context(0.5, 0.2)
FIBER = dsfit.Fiber.preset("blond")


class Bump:
    """A cheap integrand of two channels, smooth over the circle, that is nowhere near zero at the edges."""

    is_even = False

    def __call__(self, omega: torch.Tensor, context: dsfit.Context) -> torch.Tensor:
        theta, phi = omega[..., 0], context.phi_r - omega[..., 1]
        first = torch.exp(torch.cos(phi - 2.0) - 2 * (theta - 0.3) ** 2)
        second = 0.5 * torch.exp(-8 * (theta + 0.2) ** 2)
        return torch.stack([first + 0.02, second], dim=-1) * torch.cos(theta)[..., None]

    def theta_breaks(self, context: dsfit.Context) -> torch.Tensor:
        return torch.linspace(-math.pi / 2, math.pi / 2, 7, dtype=torch.float64)

    def azimuth_edges(self, context: dsfit.Context, theta: torch.Tensor, coarse: bool = False) -> torch.Tensor:
        return torch.linspace(-math.pi, math.pi, 5, dtype=torch.float64).expand(*theta.shape, 5)


BUMP = Bump()


def mixture() -> Mixture:
    parts = [Product(GaussianLobe(-0.1, 0.15), WrappedGaussian(0.8)), Product(GaussianLobe(0.2, 0.3), CosineHalf())]
    return Mixture(parts, [0.6, 0.4], 0.2)


def across_an_edge() -> Mixture:
    """Samples of the first component, whose width is learned, cross the edges of the second at +-90 degrees."""
    front = Product(GaussianLobe(0.1, 0.4), FrontHalf())
    return Mixture([Product(GaussianLobe(0.0, 0.3), WrappedGaussian(1.4)), front], [0.5, 0.5], 0.1)


def nested() -> Mixture:
    return Mixture([mixture(), Product(GaussianLobe(0.0, 0.5), UniformAzimuth())], [0.7, 0.3], 0.1)


PROPOSALS: dict[str, Callable[[], Mixture]] = {"mixture": mixture, "nested": nested}


def exact_of(proposal: Mixture, integrand: Any = BUMP) -> tuple[Problem, ExactMoment]:
    exact = moment_gradient(integrand, proposal, CONTEXT, 1e-4)
    assert exact.converged
    return Problem(integrand, proposal, CONTEXT, exact.norm), exact


def test_quadrature_is_the_derivative_of_the_excess() -> None:
    """The library's own excess, by its own cubature, moved along every parameter."""
    proposal = mixture()
    exact = moment_gradient(BUMP, proposal, CONTEXT, 1e-6)
    assert abs(dsfit.excess(BUMP, proposal, CONTEXT, 1e-5).value - (exact.moment - 1)) < 1e-5 * exact.moment
    named, step = dict(proposal.named_parameters()), 3e-2
    place = 0
    for parameter in named.values():
        for k in range(parameter.numel()):
            ends = []
            for h in (step, -step, step / 2, -step / 2):
                with torch.no_grad():
                    parameter.view(-1)[k] += h
                    ends.append(float(dsfit.excess(BUMP, proposal, CONTEXT, 1e-5).value))
                    parameter.view(-1)[k] -= h
            wide, near = (ends[0] - ends[1]) / (2 * step), (ends[2] - ends[3]) / step
            assert abs((4 * near - wide) / 3 - float(exact.gradient[place])) < 2e-3 * exact.size, exact.labels[place]
            place += 1
    assert place == len(exact.labels) == len(exact.gradient)


@pytest.mark.parametrize("kind", [*PROPOSALS, "hair"])
def test_estimators_agree_with_quadrature(kind: str) -> None:
    """Of toys, and of directly lit hair under the chapter's lobes."""
    if kind == "hair":
        lobes = chapter_proposals(FIBER)
        hair = dsfit.Integrand(dsfit.DualScattering(FIBER, d_b=0.0))
        problem, exact = exact_of(Mixture([lobes["TT"], lobes["R"], lobes["TRT"]], defensive=0.2), hair)
    else:
        problem, exact = exact_of(PROPOSALS[kind]())
    generator = torch.Generator().manual_seed(1)
    for name, function in ESTIMATORS.items():
        estimate = function(problem, 40_000, generator)
        found = agreement(estimate, exact)
        assert estimate.name == name and found.p_value > 1e-3 and found.relative_error < 0.3, (name, found)
        assert bool(found.judged.all()) and estimate.samples >= 40_000 and estimate.cost > 0


@pytest.mark.parametrize("kind", PROPOSALS)
def test_planted_faults_are_rejected(kind: str) -> None:
    problem, exact = exact_of(PROPOSALS[kind]())
    faults = planted_faults(problem, exact, 40_000, torch.Generator().manual_seed(2))
    names = ["sign of the score", "factor 2", "no dlog p", "detached samples", "weights"]
    assert [fault.name for fault in faults] == names
    for fault in faults:
        assert fault.power > POWER and fault.p_value < 1e-6, fault


def test_the_path_of_a_mixture_alone_is_what_a_user_would_get_and_is_biased() -> None:
    """`h(sample(u)).mean().backward()`: selection by u has no derivative in the weights."""
    proposal = mixture()
    problem, exact = exact_of(proposal)
    layout = Layout.of(proposal)
    u = torch.rand(80, 500, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    rows = []
    for batch in u:
        distribution = proposal(CONTEXT)
        omega = distribution.sample(batch)
        h = problem.square(omega) * torch.exp(-2 * distribution.log_prob(omega))
        slopes = torch.autograd.grad(h.mean(), [p for _, p in proposal.named_parameters()])
        rows.append(torch.cat([x.reshape(-1) for x in slopes]))
    naive = summary("naive", [(1.0, torch.stack(rows))], 0.0)
    assert agreement(naive, exact).p_value < 1e-6
    weights = torch.tensor(["logits" in label for label in layout.labels])
    assert agreement(naive, exact, ~weights).p_value > 1e-3  # all else is right
    strata = path_strata(problem, 40_000, torch.Generator().manual_seed(4))
    assert agreement(pathwise_of(strata), exact).p_value > 1e-3


def test_pathwise_is_what_autograd_makes_of_the_sum_over_components() -> None:
    proposal = nested()
    problem, _ = exact_of(proposal)
    strata = path_strata(problem, 500, torch.Generator().manual_seed(5))
    found = pathwise_of(strata)
    parts, logs = components_of(proposal(CONTEXT))
    generator, total = torch.Generator().manual_seed(5), torch.zeros((), dtype=torch.float64)
    for component, log_weight, stratum in zip(parts, logs, strata, strict=True):
        u = torch.rand((len(stratum.h), component.dimension), generator=generator, dtype=torch.float64)
        omega = component.sample(u)
        h = problem.square(omega) * torch.exp(-2 * proposal(CONTEXT).log_prob(omega))
        total = total + log_weight.exp() * h.mean()
    slopes = torch.autograd.grad(total, [p for p in proposal.parameters() if p.requires_grad])
    torch.testing.assert_close(found.mean, torch.cat([x.reshape(-1) for x in slopes]), rtol=1e-9, atol=1e-11)


def test_jumps_are_found_and_bias_the_path() -> None:
    problem, exact = exact_of(across_an_edge())
    jumps = jumps_of(problem)
    assert jumps[0].count == 0 and jumps[1].count > 0 and jumps[1].largest > 0.2
    assert abs(abs(math.remainder(jumps[1].at[1] - 0.2, 2 * math.pi)) - math.pi / 2) < 1e-9
    strata = path_strata(problem, 100_000, torch.Generator().manual_seed(6))
    estimate = pathwise_of(strata)
    crossing = torch.stack([s.turned[1] > 0 for s in strata]).any(0)
    assert [label for label, x in zip(exact.labels, crossing, strict=True) if x] == ["components.0.azimuthal.std.raw"]
    assert agreement(estimate, exact, crossing).p_value < 1e-6  # the path misses what jumps
    assert agreement(estimate, exact, ~crossing).p_value > 1e-3
    score = score_function(problem, 40_000, torch.Generator().manual_seed(7))
    assert agreement(score, exact).p_value > 1e-3  # the score does not


def test_jumps_of_simple_functions() -> None:
    smooth = lambda o: torch.exp(torch.sin(o[:, 0]) + torch.cos(3 * o[:, 1]))  # noqa: E731
    steep = lambda o: torch.atan(1e5 * (o[:, 1] - 0.7)) + 2  # noqa: E731
    kink = lambda o: (o[:, 1] - 0.3).abs() + 0.1  # noqa: E731
    step = lambda o: smooth(o) * (1 + 0.01 * (o[:, 0] > 0.123))  # noqa: E731
    for function in (smooth, steep, kink):
        assert find_jumps(function, 0).count == find_jumps(function, 1).count == 0
    found = find_jumps(step, 0)
    assert abs(found.largest - 0.01 / 1.01) < 1e-6 and abs(found.at[0] - 0.123) < 1e-9 and found.count > 10
    assert find_jumps(step, 1).count == 0


def judge_runs(runs: list[GradientEstimate], exact: ExactMoment) -> None:
    """p-values of a single component are uniform, and those of all together are not too small too often."""
    single = [float(torch.special.erfc(((r.mean - exact.gradient) / r.error)[1].abs() / 2**0.5)) for r in runs]
    assert stats.kstest(single, "uniform").pvalue > 1e-3
    joint = np.array([agreement(r, exact).p_value for r in runs])
    assert np.mean(joint < 0.05) < 0.05 + 3 * math.sqrt(0.05 * 0.95 / len(joint))


def test_standard_errors_are_true() -> None:
    problem, exact = exact_of(mixture())
    h, score = score_rows(problem, 200_000, torch.Generator().manual_seed(8))
    rows = (-h[:, None] * score).split(1000)
    judge_runs([summary("score", [(1.0, part)], 0.0) for part in rows], exact)
    strata = path_strata(problem, 200_000, torch.Generator().manual_seed(9))
    runs = []
    for k in range(200):
        parts = [slice(k * len(s.h) // 200, (k + 1) * len(s.h) // 200) for s in strata]
        cut = [replace(s, h=s.h[p], score=s.score[p], moved=s.moved[p]) for s, p in zip(strata, parts, strict=True)]
        runs.append(pathwise_of(cut))
    judge_runs(runs, exact)


@pytest.mark.slow
@pytest.mark.parametrize("name", ESTIMATORS)
def test_standard_errors_of_every_estimator_are_true(name: str) -> None:
    problem, exact = exact_of(nested())
    generator = torch.Generator().manual_seed(10)
    judge_runs([ESTIMATORS[name](problem, 1000, generator) for _ in range(200)], exact)


def test_frozen_proposals_become_learnable_and_get_a_defence() -> None:
    lobes = chapter_proposals(FIBER, learnable=False)
    for name, proposal in lobes.items():
        made = learnable(proposal)
        wanted = len(list(chapter_proposals(FIBER)[name].parameters()))
        assert len(list(made.parameters())) == wanted and not list(proposal.parameters())
        omega = torch.tensor([[0.3, 1.0], [-0.5, -2.9]], dtype=torch.float64)
        torch.testing.assert_close(made(CONTEXT).log_prob(omega), proposal(CONTEXT).log_prob(omega))
        mixed = defended(made, 0.3)
        density = 0.7 * proposal(CONTEXT).log_prob(omega).exp() + 0.3 / (4 * math.pi)
        torch.testing.assert_close(mixed(CONTEXT).log_prob(omega).exp(), density)
        log_p, slopes = log_prob_and_slopes(mixed, CONTEXT, omega, Layout.of(mixed)) if wanted else (None, None)
        assert slopes is None or slopes.shape == (2, wanted)
    assert defended(mixture(), 0.5).defensive == 0.2
    frozen = learnable(Mixture([UniformSphere(), lobes["R"]], learnable=False))
    assert Layout.of(frozen).labels[:2] == ("logits[0]", "logits[1]")
    with pytest.raises(InputError, match="requires? grad"):
        moment_gradient(BUMP, UniformSphere(), CONTEXT)
    with pytest.raises(InputError, match="single context"):
        moment_gradient(BUMP, mixture(), dsfit.Context(torch.tensor([0.1, 0.2])))
