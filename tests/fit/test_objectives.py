"""Objectives: values against direct sums, pointwise non-negativity, stability at extremes, gradients against finite
differences."""

from __future__ import annotations

import math

import pytest
import torch

from dsfit.context import Context
from dsfit.errors import InputError
from dsfit.fit.objectives import (
    OBJECTIVES,
    Excess,
    ForwardKL,
    LogExcess,
    Objective,
    Target,
    VarianceCost,
    divergence_residuals,
    excess_residuals,
    objective_named,
)
from dsfit.fit.proposal_problem import ProposalProblem
from tests.fit.toys import Toy, nodes_of, truth

ONE = Context(0.3)


def made_target(value=None, share=1.0):
    omega, weight, v = nodes_of(truth(Toy([-0.3, 0.5])), ONE)
    return Target.from_nodes(ONE, omega, weight, v if value is None else value(v), share)


def test_target_is_normalised_and_knows_its_channels():
    target = made_target()
    assert target.norm == pytest.approx(3.0, rel=1e-3) and target.grey == pytest.approx(1.0, rel=1e-12)
    assert float((target.weight * target.log_best.exp()).sum()) == pytest.approx(1.0, rel=1e-12)
    coloured = made_target(lambda v: torch.cat([v, v * (v > 0.5), 2 * v], -1))
    integral = coloured.grey**0.5 * coloured.norm
    v = nodes_of(truth(Toy([-0.3, 0.5])), ONE)[2]
    expected = (coloured.weight[:, None] * torch.cat([v, v * (v > 0.5), 2 * v], -1)).sum(0).norm()
    assert integral == pytest.approx(float(expected), rel=1e-12) and coloured.grey < 1


@pytest.mark.parametrize("scale", [1e-200, 1e-30, 1e30, 1e200])
def test_target_of_any_magnitude(scale):
    assert made_target(lambda v: v * scale).norm == pytest.approx(made_target().norm * scale, rel=1e-12)


def test_bad_targets():
    omega, weight, value = nodes_of(truth(Toy([0.0])), ONE)
    for bad, match in [
        ((omega, weight, 0 * value), "not zero"),
        ((omega, weight, value + math.nan), "finite"),
        ((omega, -weight, value), "nodes.weight"),
        ((omega[:5], weight, value), "nodes"),
    ]:
        with pytest.raises(InputError, match=match):
            Target.from_nodes(ONE, *bad)


def test_values_are_what_they_are_called():
    target = made_target()
    log_p = Toy([-0.3, 0.5])(ONE).log_prob(target.omega).detach()
    p, best, w = log_p.exp(), target.log_best.exp(), target.weight
    mass = (w * p).sum()
    excess = (w * best**2 / p).sum() - 1 + (mass - 1)
    torch.testing.assert_close(Excess().loss(log_p, w, target.log_best), excess, rtol=1e-11, atol=1e-12)
    divergence = (w * best * (target.log_best - log_p)).sum() + (mass - 1)
    torch.testing.assert_close(ForwardKL().loss(log_p, w, target.log_best), divergence, rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize("function", [excess_residuals, divergence_residuals])
def test_residuals_are_signed_smooth_and_exact_near_zero(function):
    log_best = torch.tensor(-2.0, dtype=torch.float64)
    one = torch.tensor(1.0, dtype=torch.float64)
    a = torch.cat([-torch.logspace(2, -9, 400), torch.logspace(-9, 2, 400)]).double()
    log_p = (log_best - a).requires_grad_()
    r = function(log_p, one, log_best)
    (slope,) = torch.autograd.grad(r.sum(), log_p)
    assert bool((r.sign() == a.sign()).all()), "residual has the sign of P* - p"
    assert bool((slope < 0).all()), "and falls with p"
    small = a.abs() < 1e-4
    half = (log_best / 2).exp() * (2**-0.5 if function is divergence_residuals else 1.0)
    torch.testing.assert_close(r[small].detach(), (half * a)[small], rtol=2e-4, atol=0)
    if function is divergence_residuals:
        import mpmath

        for i in range(0, 800, 37):
            with mpmath.workdps(60):
                x = mpmath.mpf(float(log_best)) - mpmath.mpf(float(log_p[i].detach()))
                p = mpmath.exp(mpmath.mpf(float(log_p[i].detach())))
                expected = mpmath.sign(x) * mpmath.sqrt(p * (1 + mpmath.exp(x) * (x - 1)))
            assert float(r[i].detach()) == pytest.approx(float(expected), rel=1e-7 if abs(x) < 1e-6 else 1e-11)


@pytest.mark.parametrize("function", [excess_residuals, divergence_residuals])
@pytest.mark.parametrize("log_best", [-math.inf, -700.0, -30.0, 0.0, 30.0])
@pytest.mark.parametrize("log_p", [-math.inf, -5000.0, -700.0, -30.0, 0.0, 30.0])
def test_residuals_and_gradients_are_finite(function, log_best, log_p):
    log_p = torch.tensor(log_p, dtype=torch.float64, requires_grad=True)
    r = function(log_p, torch.tensor(0.1, dtype=torch.float64), torch.tensor(log_best, dtype=torch.float64))
    (slope,) = torch.autograd.grad(r.square(), log_p)
    assert torch.isfinite(r) and torch.isfinite(r.square()) and torch.isfinite(slope)


class CostOfWidth:
    def __call__(self, proposal, context):
        return 1 + proposal.log_width.exp().sum()


class Mean(Objective):
    """A scalar objective of our own, without residuals."""

    name, least_squares = "reverse_kl", False

    def residuals(self, log_p, weight, log_best):
        raise NotImplementedError

    def loss(self, log_p, weight, log_best):
        return (weight * log_p.exp() * (log_p - log_best)).sum(0)


@pytest.mark.parametrize(
    "objective", [Excess(), LogExcess(), ForwardKL(), VarianceCost(), VarianceCost(CostOfWidth(), base=0.5), Mean()]
)
def test_gradients_against_finite_differences(objective):
    targets = [made_target(lambda v: torch.cat([v, v**2 + 0.1], -1), 0.3), made_target(None, 0.7)]
    toy = Toy([-0.2, 0.6])
    problem = ProposalProblem(toy, targets, objective)
    y = problem.parameters.vector(toy)
    value, gradient = problem.gradient(y)
    assert problem.value(y) == pytest.approx(value, rel=1e-12)
    for i in range(len(y)):
        step = torch.zeros_like(y)
        step[i] = 1e-5
        numeric = (problem.value(y + step) - problem.value(y - step)) / 2e-5
        assert float(gradient[i]) == pytest.approx(numeric, rel=2e-5, abs=1e-7)
    if objective.least_squares:
        r, j = problem.linearise(y)
        assert float(r.square().sum()) == pytest.approx(value, rel=1e-12)
        torch.testing.assert_close(2 * j.T @ r, gradient, rtol=1e-9, atol=1e-10)


def test_variance_cost_is_relative_variance_times_cost():
    target = made_target(lambda v: torch.cat([v, v**2 + 0.1], -1))
    toy = Toy([-0.2, 0.6])
    v = torch.cat([nodes_of(truth(Toy([-0.3, 0.5])), ONE)[2]] * 1, -1)
    f = torch.cat([v, v**2 + 0.1], -1)
    p = toy(ONE).log_prob(target.omega).exp().detach()
    w = target.weight
    variance = (w * f.square().sum(-1) / p).sum() / (w[:, None] * f).sum(0).square().sum() - 1
    mass = float((w * p).sum())
    problem = ProposalProblem(toy, [target], VarianceCost(7.0, base=1.0))
    value = problem.value(problem.parameters.vector(toy))
    assert value == pytest.approx(8.0 * (float(variance) + (mass - 1) / target.grey), rel=1e-10)


def test_cost_by_components_wants_a_mixture():
    with pytest.raises(InputError, match="no mixture"):
        VarianceCost([1.0, 2.0]).cost_of(Toy([0.0, 1.0]), ONE)
    with pytest.raises(InputError, match="cost"):
        VarianceCost(-1.0)

    class Shares(torch.nn.Module):
        def forward(self, context):
            log_weights = torch.tensor([0.5, 0.4, 0.1], dtype=torch.float64).log()
            return type("D", (), {"log_weights": log_weights})()

    assert float(VarianceCost([1.0, 2.0], base=0.2).cost_of(Shares(), ONE)) == pytest.approx(0.2 + 0.5 + 0.8)
    assert float(VarianceCost([1.0, 2.0, 3.0]).cost_of(Shares(), ONE)) == pytest.approx(0.5 + 0.8 + 0.3)
    with pytest.raises(InputError, match="each component"):
        VarianceCost([1.0]).cost_of(Shares(), ONE)


def test_registry():
    assert set(OBJECTIVES) == {"excess", "log_excess", "forward_kl", "variance_cost"}
    assert objective_named("excess").name == "excess" and isinstance(objective_named(Mean()), Mean)
    with pytest.raises(InputError, match="forward_kl"):
        objective_named("chi2")
