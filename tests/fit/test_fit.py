"""Fits of a toy proposal to integrands that it can match exactly, and of the library's own mixture."""

from __future__ import annotations

import math
import subprocess
import sys

import pytest
import torch
from torch import nn

import dsfit.fit
from dsfit.context import Context
from dsfit.errors import InputError
from dsfit.fit import SOLVERS, Excess, ProposalProblem, Target, fit
from dsfit.fit.fit import make_targets
from tests.fit.toys import Toy, nodes, nodes_of, truth

pytest.importorskip("jax")
ONE = Context(0.4)
NODES = nodes_of(truth(Toy([-0.4, 0.5])), ONE)
SINGLE = nodes_of(truth(Toy([0.1], learn_shares=False)), ONE)


def parameters_of(toy):
    return torch.cat([p.detach().flatten() for p in toy.parameters()])


@pytest.mark.parametrize("name", list(SOLVERS))
def test_every_solver_recovers_one_lobe(name):
    toy = Toy([0.1], learn_shares=False)
    before = parameters_of(toy)
    limit = {"max_steps": 300} if name in ("torch.adam", "optimistix.nelder_mead") else {}
    result = fit(toy, None, ONE, solver=name, nodes=SINGLE, tolerance=1e-8, **limit)
    assert result.excess < (1e-8 if name not in ("torch.adam", "optimistix.nelder_mead") else 1e-5), result
    assert result.largest_weight == pytest.approx(1.0, abs=1e-2)
    assert result.mass == pytest.approx(1.0, abs=1e-3)
    found, known = parameters_of(result.proposal), parameters_of(truth(Toy([0.1], learn_shares=False)))
    torch.testing.assert_close(found, known, rtol=0, atol=2e-2)
    assert torch.equal(parameters_of(toy), before), "the proposal given is unchanged"
    assert result.history[0].value > 0.1 and result.history is result.result.history


@pytest.mark.parametrize("name", ["optimistix.lm", "optimistix.dogleg", "optimistix.bfgs", "torch.lbfgs"])
@pytest.mark.parametrize("objective", ["excess", "forward_kl", "variance_cost"])
def test_two_lobes(name, objective):
    result = fit(Toy([-0.4, 0.5]), None, ONE, objective, name, nodes=NODES, tolerance=1e-9, max_steps=200)
    assert result.excess < 1e-6, result.result
    torch.testing.assert_close(result.proposal.phi.detach(), truth(Toy([-0.4, 0.5])).phi.detach(), rtol=0, atol=1e-2)


def test_fit_is_callable_as_the_package():
    result = dsfit.fit(Toy([-0.4, 0.5]), None, ONE, nodes=NODES)
    assert result.converged and result.excess < 1e-4
    assert dsfit.fit.fit is fit


def test_excess_and_largest_weight_are_of_what_is_returned():
    result = fit(Toy([0.3]), None, ONE, nodes=NODES)
    omega, weight, value = NODES
    f, p = value[:, 0], result.proposal(ONE).log_prob(omega).exp().detach()
    norm = float((weight * f).sum())
    m = float((weight * f**2 / p).sum()) / norm**2 - 1
    assert result.excess > 0.01 and result.excess == pytest.approx(m + float((weight * p).sum()) - 1, rel=1e-9)
    assert result.largest_weight == pytest.approx(float((f / p).max()) / norm, rel=1e-9)
    assert result.excess == pytest.approx(result.result.value, rel=1e-6)


def test_quadrature_nodes_are_asked_for(monkeypatch):
    asked = []
    module = type(sys)("dsfit.quality")

    def quadrature_nodes(integrand, context, rtol):
        asked.append((float(context.theta_r), rtol))
        omega, weight = nodes()
        return type("Nodes", (), {"omega": omega, "weight": weight, "value": integrand(omega, context)})()

    module.quadrature_nodes = quadrature_nodes
    monkeypatch.setitem(sys.modules, "dsfit.quality", module)
    known = truth(Toy([-0.4, 0.5]))

    def integrand(omega, context):
        return known(context).log_prob(omega).exp()[..., None].detach()

    result = fit(Toy([-0.4, 0.5]), integrand, Context(torch.tensor([0.4, -0.6])), rtol=1e-3)
    assert result.excess < 1e-4
    assert asked == [(pytest.approx(0.4), 1e-3), (pytest.approx(-0.6), 1e-3)]


BATCH = Context(torch.tensor([[0.4, -1.0], [0.0, 1.2]], dtype=torch.float64))


@pytest.mark.parametrize("name", ["optimistix.lm", "torch.lbfgs"])
def test_batch_of_contexts_with_different_nodes(name):
    known = truth(Toy([-0.4, 0.5]))
    several = [nodes_of(known, BATCH.reshape(-1)[i], 30 + 2 * i) for i in range(4)]
    result = fit(Toy([-0.4, 0.5]), None, BATCH, solver=name, nodes=several, tolerance=1e-9, max_steps=150)
    assert result.excess < 1e-6 and result.excesses.shape == (2, 2)
    assert float(result.excesses.mean()) == pytest.approx(result.excess, rel=1e-9)


def test_batch_value_is_the_weighted_mean_however_it_is_blocked(monkeypatch):
    known, toy = truth(Toy([-0.4, 0.5])), Toy([-0.4, 0.5])
    several = [nodes_of(known, BATCH.reshape(-1)[i], 24 + 2 * i) for i in range(4)]
    weights = torch.tensor([[1.0, 2.0], [3.0, 4.0]])
    targets = make_targets(None, BATCH, several, 1e-4, weights)
    single = [
        ProposalProblem(toy, [Target.from_nodes(t.context, t.omega, t.weight, v[2])], Excess())
        for t, v in zip(targets, several, strict=True)
    ]
    y = single[0].parameters.vector(toy)
    expected = sum(w * one.value(y) for w, one in zip([0.1, 0.2, 0.3, 0.4], single, strict=True))
    for block in (1, 2000, 1 << 20):
        monkeypatch.setattr("dsfit.fit.proposal_problem.BLOCK", block)
        problem = ProposalProblem(toy, targets, Excess())
        assert len(problem.blocks) == (4 if block == 1 else 2 if block == 2000 else 1)
        assert problem.value(y) == pytest.approx(expected, rel=1e-12)
        value, gradient = problem.gradient(y)
        r, j = problem.linearise(y)
        assert float(r.square().sum()) == pytest.approx(expected, rel=1e-12) == pytest.approx(value, rel=1e-12)
        torch.testing.assert_close(2 * j.T @ r, gradient, rtol=1e-9, atol=1e-11)


class Amortised(nn.Module):
    """One lobe whose parameters are a function of theta_r."""

    def __init__(self):
        super().__init__()
        generator = torch.Generator().manual_seed(0)
        self.toy = Toy([0.0])
        self.net = nn.Sequential(nn.Linear(2, 8), nn.Tanh(), nn.Linear(8, 4)).double()
        with torch.no_grad():
            for parameter in self.net.parameters():
                parameter.copy_(0.5 * torch.randn(parameter.shape, generator=generator, dtype=torch.float64))
        for parameter in self.toy.parameters():
            parameter.requires_grad_(False)

    def forward(self, context):
        t = self.net(torch.stack([context.theta_r, context.theta_r**2], -1))
        centre, width, phi, spread = (x[..., None] for x in t.unbind(-1))
        base = self.toy(context)
        _, *args = base.args
        moved = [args[0] + centre, args[1] * width.exp(), args[2] + phi, args[3] * spread.exp()]
        return type(base)(base.args[0], *moved, base.defensive)


class Drifting(Toy):
    def forward(self, context):
        base = super().forward(context)
        log_share, centre, width, phi, spread = base.args
        t = context.theta_r[..., None]
        return type(base)(
            log_share, centre + 0.3 * t**2, width, phi - 0.5 * t, spread * (0.3 * t).exp(), base.defensive
        )


MANY = Context(torch.linspace(-1.2, 1.2, 12, dtype=torch.float64))


@pytest.mark.parametrize(
    "name, objective, options",
    [
        ("optimistix.lm", "excess", {}),
        ("torch.lbfgs", "log_excess", {"max_steps": 150}),
        ("torch.adam", "log_excess", {"contexts": 4, "max_steps": 400, "seed": 1}),
    ],
)
def test_one_network_for_many_contexts(name, objective, options):
    known = truth(Drifting([0.1]))
    several = [nodes_of(known, MANY[i], 24) for i in range(12)]
    result = fit(Amortised(), None, MANY, objective, name, nodes=several, **options)
    before = fit(Amortised(), None, MANY, objective, name, nodes=several, max_steps=0)
    assert result.excess < 0.01 < 0.5 < before.excess, result
    assert result.excesses.shape == (12,) and float(result.excesses.max()) < 0.03


def test_sampled_gradient_is_unbiased():
    known, toy = truth(Toy([-0.4, 0.5])), Toy([-0.4, 0.5])
    several = [nodes_of(known, BATCH.reshape(-1)[i], 16) for i in range(4)]
    targets = make_targets(None, BATCH, several, 1e-4, torch.tensor([[1.0, 2.0], [3.0, 4.0]]))
    problem = ProposalProblem(toy, targets, Excess())
    y = problem.parameters.vector(toy)
    generator = torch.Generator().manual_seed(0)
    drawn = torch.stack([problem.sampled_gradient(y, 2, generator)[1] for _ in range(400)])
    error = drawn.std(0) / 400**0.5
    assert bool(((drawn.mean(0) - problem.gradient(y)[1]).abs() <= 4.5 * error + 1e-12).all())
    assert torch.equal(problem.sampled_gradient(y, 4, generator)[1], problem.gradient(y)[1])


def test_jacobian_methods_agree_and_auto_falls_back():
    target = make_targets(None, ONE, NODES, 1e-4, None)[0]
    toy = Toy([-0.4, 0.5])
    reverse, forward, auto = (
        ProposalProblem(toy, [target], Excess(), jacobian=m) for m in ("reverse", "forward", "auto")
    )
    y = reverse.parameters.vector(toy)
    (r1, j1), (r2, j2) = reverse.linearise(y), forward.linearise(y)
    # Softmax makes one direction redundant, so the factors themselves are not unique.
    torch.testing.assert_close(j1.T @ j1, j2.T @ j2, rtol=1e-10, atol=1e-11)
    torch.testing.assert_close(j1.T @ r1, j2.T @ r2, rtol=1e-10, atol=1e-11)
    auto.linearise(y)
    assert auto.jacobian == "reverse"

    class Coupled(Toy):
        """Normalised over the nodes it is asked at: a node's density depends on the others."""

        def forward(self, context):
            inner = super().forward(context)

            class Distribution:
                def log_prob(self, omega):
                    log_p = inner.log_prob(omega)
                    return log_p - torch.logsumexp(log_p.reshape(-1), 0) + 3.0

            return Distribution()

    class NoVmap(Toy):
        def forward(self, context):
            inner = super().forward(context)

            class Distribution:
                def log_prob(self, omega):
                    if float(omega.sum()) == 0.123:  # data-dependent: vmap cannot do it
                        raise AssertionError
                    return inner.log_prob(omega)

            return Distribution()

    for cls in (Coupled, NoVmap):
        problem = ProposalProblem(cls([-0.4, 0.5]), [target], Excess())
        r, j = problem.linearise(y)
        assert problem.jacobian == "forward"
        torch.testing.assert_close(2 * j.T @ r, problem.gradient(y)[1], rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("tied", [False, True])
@pytest.mark.parametrize("defensive", [0.0, 0.05])
def test_a_mixtures_own_jacobian_agrees_with_the_others_or_is_not_used(defensive, tied):
    from dsfit.proposals.azimuth import CosineHalf, WrappedGaussian
    from dsfit.proposals.base import Product
    from dsfit.proposals.gaussian_lobe import GaussianLobe
    from dsfit.proposals.mixture import Mixture

    parts = [Product(GaussianLobe(-0.2, 0.2), WrappedGaussian(0.6)), Product(GaussianLobe(0.3, 0.4), CosineHalf())]
    third = parts[0] if tied else Product(GaussianLobe(0.0, 0.3), WrappedGaussian(1.0))
    mixture = Mixture([*parts, third], [0.5, 0.3, 0.2], defensive)
    target = make_targets(None, ONE, NODES, 1e-4, None)[0]
    own, reverse, forward, auto = (
        ProposalProblem(mixture, [target], Excess(), jacobian=m) for m in ("own", "reverse", "forward", "auto")
    )
    y = own.parameters.vector(mixture)
    (r1, j1), (r2, j2), (r3, j3) = own.linearise(y), reverse.linearise(y), forward.linearise(y)
    ra, ja = auto.linearise(y)
    if not tied:
        assert auto.jacobian == "own"
    for r, j in ((r2, j2), (r3, j3), (ra, ja), *(() if tied else ((r1, j1),))):
        torch.testing.assert_close(j2.T @ j2, j.T @ j, rtol=1e-9, atol=1e-10)
        torch.testing.assert_close(j2.T @ r2, j.T @ r, rtol=1e-9, atol=1e-10)


def test_an_own_jacobian_that_is_wrong_is_not_used():
    class Wrong(Toy):
        def log_prob_with_jacobian(self, context, omega):
            log_p = self(context).log_prob(omega)
            return log_p, {name: torch.ones(len(log_p), *p.shape).double() for name, p in self.named_parameters()}

    problem = ProposalProblem(Wrong([-0.4, 0.5]), make_targets(None, ONE, NODES, 1e-4, None), Excess())
    y = problem.parameters.vector(problem.proposal)
    r, j = problem.linearise(y)
    assert problem.jacobian == "reverse"
    torch.testing.assert_close(2 * j.T @ r, problem.gradient(y)[1], rtol=1e-9, atol=1e-11)


def test_multi_start_is_deterministic_and_keeps_the_best():
    # From the far side of the circle one start alone fails.
    toy = Toy([-0.4, 0.5])
    with torch.no_grad():
        toy.phi += 2.6
    runs = [fit(toy, None, ONE, nodes=NODES, starts=4, jitter=1.0, seed=s, max_steps=40) for s in (3, 3, 4)]
    values = [[r.value for r in run.starts] for run in runs]
    assert values[0] == values[1] and values[0][1:] != values[2][1:] and values[0][0] == values[2][0]
    for run in runs:
        assert run.result.value == min(r.value for r in run.starts)
    assert torch.equal(parameters_of(runs[0].proposal), parameters_of(runs[1].proposal))


def test_float32_proposal_is_fitted_in_float64_and_returned_in_float32():
    toy = Toy([-0.4, 0.5]).float()
    result = fit(toy, None, Context(torch.tensor(0.4)), nodes=tuple(x.float() for x in NODES))
    assert all(p.dtype == torch.float32 for p in result.proposal.parameters())
    assert all(p.dtype == torch.float32 for p in toy.parameters())
    assert result.excess < 1e-4 and result.excesses.dtype == torch.float64


def test_only_parameters_that_require_grad_move():
    toy = Toy([-0.4, 0.5])
    toy.centre.requires_grad_(False)
    result = fit(toy, None, ONE, nodes=NODES)
    assert torch.equal(result.proposal.centre, toy.centre) and not torch.equal(result.proposal.phi, toy.phi)
    assert not result.proposal.centre.requires_grad and result.proposal.phi.requires_grad


def test_values_at_bounds_are_named():
    # One lobe wider than the bound allows: the integrand is the uniform sphere.
    omega, weight = nodes()
    toy = Toy([0.0, 0.1], defensive=0.01)
    with torch.no_grad():
        toy.log_width[1] = math.log(9.99)
    result = fit(toy, None, ONE, nodes=(omega, weight, torch.ones(len(weight), 1, dtype=torch.float64)), max_steps=0)
    assert result.at_bounds == ["width[1]"]


def test_steps_limit_and_reason():
    result = fit(Toy([-0.4, 0.5]), None, ONE, nodes=NODES, max_steps=1)
    assert not result.converged and "max_steps" in result.result.reason
    assert result.excess < result.history[0].value


def test_bad_input():
    class Fixed(nn.Module):
        def forward(self, context):
            raise AssertionError

    toy = Toy([0.0])
    for call, field in [
        (lambda: fit(Fixed(), None, ONE, nodes=NODES), "proposal"),
        (lambda: fit("toy", None, ONE, nodes=NODES), "proposal"),
        (lambda: fit(toy, None, ONE, "chi2", nodes=NODES), "objective"),
        (lambda: fit(toy, None, ONE, solver="newton", nodes=NODES), "solver"),
        (lambda: fit(toy, None, ONE, nodes=NODES, starts=0), "starts"),
        (lambda: fit(toy, None, ONE, nodes=NODES, jacobian="both"), "jacobian"),
        (lambda: fit(toy, None, ONE, nodes=NODES, jacobian="own"), "jacobian"),
        (lambda: fit(toy, None, ONE, nodes=NODES, rate=1.0), "options"),
        (lambda: fit(toy, None, ONE), "integrand"),
        (lambda: fit(toy, None, BATCH, nodes=[NODES]), "nodes"),
        (lambda: fit(toy, None, BATCH, nodes=[NODES] * 4, weights=[1.0, 0.0, 1.0, 1.0]), "weights"),
    ]:
        with pytest.raises(InputError) as error:
            call()
        assert error.value.field == field
    broken = Toy([0.0])
    with torch.no_grad():
        broken.centre += math.nan
    with pytest.raises(InputError, match="proposal.centre"):
        fit(broken, None, ONE, nodes=NODES)


def test_library_mixture_reduces_its_excess():
    from dsfit.proposals.azimuth import WrappedGaussian
    from dsfit.proposals.base import Product
    from dsfit.proposals.gaussian_lobe import GaussianLobe
    from dsfit.proposals.mixture import Mixture

    def lobe(mean, std, gamma):
        return Product(GaussianLobe(mean, std), WrappedGaussian(gamma))

    mixture = Mixture([lobe(-0.2, 0.2, 0.6), lobe(0.2, 0.4, 1.0)], defensive=0.05)
    known = Mixture([lobe(-0.1, 0.15, 0.8), lobe(0.3, 0.5, 1.5)], [0.3, 0.7], defensive=0.05)
    omega, weight = nodes(60)
    with torch.no_grad():
        value = known(ONE).log_prob(omega).exp()[:, None]
    result = fit(mixture, None, ONE, nodes=(omega, weight, value), tolerance=1e-9)
    assert result.excess < 1e-8, result.result
    assert not result.at_bounds
    torch.testing.assert_close(result.proposal.weights(), known.weights(), rtol=0, atol=1e-4)


def test_import_leaves_jax_alone():
    code = "import sys, dsfit.fit, dsfit.fit.transmittance; print({'jax', 'optimistix', 'equinox'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=50, cwd=".")
    assert done.stdout.strip() == "set()", done.stderr


def test_fit_leaves_jax_in_its_default_precision():
    import jax
    import jax.numpy as jnp

    fit(Toy([0.1]), None, ONE, nodes=SINGLE, max_steps=2)
    assert not jax.config.jax_enable_x64 and jnp.zeros(2).dtype == jnp.float32


def test_density_that_vanishes_where_the_integrand_does_not_is_no_fit():
    narrow = Toy([-0.4, 0.5], defensive=0.0)
    with torch.no_grad():
        narrow.log_width.fill_(math.log(1e-3))
    found = fit(narrow, None, ONE, solver="torch.adam", nodes=NODES, max_steps=2)
    assert math.isinf(found.excess) and not found.converged and "density vanishes at" in found.result.reason
    assert math.isfinite(fit(Toy([-0.4, 0.5]), None, ONE, solver="torch.adam", nodes=NODES, max_steps=2).excess)


@pytest.mark.parametrize("seed", [12, 23, 38])  # those of 0 to 40 where the ratio is rounded up
def test_one_channel_is_never_more_than_grey(seed):
    """Rounding once made `1 - grey` negative, and its root not a number."""
    omega, weight = nodes()
    value = torch.rand(len(weight), 1, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    target = Target.from_nodes(ONE, omega, weight, value)
    assert 0 < target.grey <= 1


def test_log_excess_is_judged_by_its_gauss_newton_model():
    toy = Toy([-0.4, 0.5])
    targets = make_targets(
        None, BATCH, [nodes_of(truth(Toy([-0.4, 0.5])), BATCH.reshape(-1)[i], 20) for i in range(4)], 1e-3, None
    )
    problem = ProposalProblem(toy, targets, dsfit.fit.LogExcess())
    y = problem.parameters.vector(toy)
    residuals, jacobian = problem.linearise(y)
    torch.testing.assert_close(2 * jacobian.T @ residuals, problem.gradient(y)[1], rtol=1e-9, atol=1e-12)
    started = fit(toy, None, ONE, "log_excess", "torch.lbfgs", nodes=NODES, max_steps=1)
    ended = fit(toy, None, ONE, "log_excess", "torch.lbfgs", nodes=NODES, max_steps=150, tolerance=1e-6)
    assert started.result.gap > 0.1 > ended.result.gap and not started.converged
