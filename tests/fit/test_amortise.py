"""Training of amortised proposals: the objective against exact quadrature, what training brings, what it needs."""

from __future__ import annotations

import copy
import math
from typing import Any

import pytest
import torch

import dsfit
from dsfit.fit.amortise import amortise, held_out, held_out_contexts
from dsfit.fit.amortise.excess import all_excesses, excess_at
from dsfit.fit.amortise.targets import best_density, make_targets
from dsfit.fit.amortise.train import TRAINING, training_contexts
from tests.proposals.cases_amortised import _random as changed
from tests.proposals.cases_amortised import bsdf, untrained

SMALL: dict[str, Any] = {"inclinations": 12, "pairs": 6}
SOME = dsfit.Context(
    torch.tensor([[0.3], [-1.2], [1.53]], dtype=torch.float64),
    n=torch.tensor([0.0, 2.0, 12.0, 28.0], dtype=torch.float64),
    v=torch.tensor([1.0, 0.4, 0.0, math.exp(-28)], dtype=torch.float64),
)


@pytest.mark.parametrize("preset", ["blond", "black"])
def test_objective_is_the_excess(preset: str) -> None:
    """The grids' sum of squares against adaptive cubature, untrained. The azimuthal laws are linear between the nodes
    of their tables, and tensor rules see those kinks to a few per mille of the excess; the
    sparser nodes of the training to a few per cent."""
    proposal = untrained(preset)
    targets = make_targets(bsdf(preset), proposal, SOME)
    fine = make_targets(bsdf(preset), proposal, SOME, dtype=torch.float64, theta_nodes=6, azimuth_nodes=10)
    rows, columns = torch.tensor([0, 2]), torch.tensor([1, 2])
    integrand, some = dsfit.Integrand(bsdf(preset)), SOME[rows, columns]
    exact = dsfit.excess(integrand, proposal, some, 1e-3).value
    torch.testing.assert_close(all_excesses(fine, proposal)[rows, columns], exact, rtol=5e-3, atol=1e-6)
    coarse = all_excesses(targets, proposal)[rows, columns].double()
    torch.testing.assert_close(coarse, exact, rtol=5e-2, atol=1e-4)
    held = held_out(integrand, proposal, some, check=1)
    torch.testing.assert_close(held.excess, exact, rtol=5e-3, atol=1e-6)
    assert held.disagreement < 5e-3


def test_objective_follows_the_integrand_of_any_convention() -> None:
    """The tabulated BSDF is the BSDF: its values at the nodes, as printed and with shares that add up."""
    for convention in ("printed", "consistent"):
        other = bsdf().replace(convention=convention)
        theta, phi, _, target = best_density(dsfit.Integrand(other), SOME[0, 1:3], 3, 6)
        norm = dsfit.reference(dsfit.Integrand(other), SOME[0, 1:3], 1e-3).norm
        for j, k in ((25, 3), (40, 17), (60, 22)):
            omega = torch.stack([theta[j].expand(2), -phi[j, k].expand(2)], dim=-1)
            value = dsfit.Integrand(other)(omega, SOME[0, 1:3]).norm(dim=-1) * torch.cos(theta[j])
            torch.testing.assert_close(target[j, k], value / norm, rtol=1e-3, atol=1e-12)


def test_objective_has_the_gradient_of_differences() -> None:
    proposal = changed(0.2)
    targets = make_targets(bsdf(), proposal, SOME, dtype=torch.float64)
    parameters = list(proposal.parameters())
    generator = torch.Generator().manual_seed(4)
    step = [1e-5 * torch.randn(p.shape, generator=generator, dtype=torch.float64) for p in parameters]
    gradient = torch.autograd.grad(torch.log1p(excess_at(targets, proposal) / 0.01).mean(), parameters)
    slope = sum(float((g * s).sum()) for g, s in zip(gradient, step, strict=True))
    ends = []
    for sign in (1, -1):
        moved = copy.deepcopy(proposal)
        with torch.no_grad():
            for p, s in zip(moved.parameters(), step, strict=True):
                p.add_(sign * s)
            ends.append(float(torch.log1p(excess_at(targets, moved) / 0.01).mean()))
    assert (ends[0] - ends[1]) / 2 == pytest.approx(slope, rel=1e-4)


def test_training_lowers_the_excess_of_unseen_contexts() -> None:
    proposal = untrained("brown")
    found = amortise(bsdf("brown"), start=proposal, steps=80, **SMALL)
    unseen = training_contexts(TRAINING, 6, 6, torch.Generator().manual_seed(77))
    targets = make_targets(bsdf("brown"), proposal, unseen)
    before, after = (all_excesses(targets, p).flatten() for p in (proposal, found.proposal))
    assert float(after.median()) < 0.5 * float(before.median())
    assert float(after.mean()) < 0.7 * float(before.mean())
    assert found.steps == 80 and found.contexts == 72 and len(found.excess) == 72
    assert found.history[-1].objective < found.history[0].objective
    assert set(found.seconds) == {"proposal", "targets", "training", "total"}
    assert not any(p.requires_grad for p in found.proposal.parameters())
    assert all(p.requires_grad for p in proposal.parameters()), "the given proposal stays as it is"


def test_equal_seeds_give_equal_results() -> None:
    options = {"start": untrained(), "steps": 3, "inclinations": 3, "pairs": 2}
    first, again, other = (amortise(bsdf(), seed=seed, **options) for seed in (5, 5, 6))
    assert first.excess == again.excess and first.excess != other.excess
    for p, q in zip(first.proposal.parameters(), again.proposal.parameters(), strict=True):
        torch.testing.assert_close(p, q, rtol=0, atol=0)


def test_no_steps_leave_the_proposal_as_it_is() -> None:
    found = amortise(bsdf(), start=changed(0.2), steps=0, inclinations=3, pairs=2)
    assert found.steps == 0 and not found.history
    for p, q in zip(found.proposal.parameters(), changed(0.2).parameters(), strict=True):
        torch.testing.assert_close(p, q, rtol=0, atol=0)


def test_training_goes_on_where_gradients_are_off_and_with_a_time_limit() -> None:
    with torch.no_grad():
        found = amortise(bsdf(), start=untrained(), seconds=0.2, inclinations=3, pairs=2)
    assert found.steps >= 1


def test_held_out_contexts_are_what_they_say() -> None:
    context = held_out_contexts()
    assert len(context) == 558 and float(context.theta_r.abs().max()) == pytest.approx(math.radians(89))
    assert bool((context.v[context.n == 0] == 1).all()) and float(context.n.max()) == 30
    for share in (context.v == 0, context.v == torch.exp(-context.n)):
        assert int(share.sum()) >= 180
    again = held_out_contexts()
    assert bool((again.v == context.v).all())


def test_excess_is_unknown_where_no_light_is_left() -> None:
    context = dsfit.Context(0.3, n=torch.tensor([2.0, 1e5], dtype=torch.float64))
    found = held_out(dsfit.Integrand(bsdf()), untrained(), context, check=0)
    assert found.excess.isnan().tolist() == [False, True]


def test_held_out_uses_cubature_where_there_is_no_furnace() -> None:
    from dsfit.scene.lights import ConstantLight

    integrand = dsfit.Integrand(bsdf(), ConstantLight([1.0, 0.5, 0.25]))
    found = held_out(integrand, untrained(), SOME[0, :1])
    exact = dsfit.excess(integrand, untrained(), SOME[0, :1], 1e-2)
    torch.testing.assert_close(found.excess, exact.value)
    assert math.isnan(found.disagreement) and found.plain()["contexts"] == 1


@pytest.mark.parametrize(
    ("field", "options"),
    [
        ("seconds, steps", {"seconds": 1.0, "steps": 1}),
        ("steps", {"steps": -1}),
        ("steps", {"steps": 2.5}),
        ("seconds", {"seconds": -1.0}),
        ("inclinations", {"inclinations": 0}),
        ("pairs", {"pairs": True}),
        ("scale", {"scale": 0.0}),
        ("defensive", {"defensive": 1.0}),
        ("seed", {"seed": -1}),
        ("hidden", {"hidden": (0,)}),
        ("stream", {"stream": "all"}),
        ("start", {"start": "blond"}),
    ],
)
def test_bad_options_are_refused(field: str, options: dict[str, Any]) -> None:
    with pytest.raises(dsfit.InputError) as error:
        amortise(bsdf(), **options)
    assert error.value.field == field


def test_other_fibres_are_refused() -> None:
    bent = dsfit.DualScattering(dsfit.Fiber.preset("blond", eccentricity=0.9))
    with pytest.raises(dsfit.InputError, match="round"):
        amortise(bent)
    with pytest.raises(dsfit.InputError, match="start"):
        amortise(bsdf("black"), start=untrained("blond"))
    with pytest.raises(dsfit.InputError, match="check"):
        held_out(dsfit.Integrand(bsdf()), untrained(), check=-1)
    with pytest.raises(dsfit.InputError, match="integrand"):
        held_out(bsdf(), untrained())
