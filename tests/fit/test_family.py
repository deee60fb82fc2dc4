"""Training for a family of fibres: targets that agree with the quadrature, training that helps unseen fibres."""

from __future__ import annotations

import pytest
import torch

import dsfit
from dsfit.errors import InputError
from dsfit.fit.amortise.family import TrainedFamily, family_excess, train_family
from dsfit.fit.amortise.family_targets import FamilyTargets, family_targets
from dsfit.fit.amortise.train import TRAINING
from dsfit.proposals.family import FamilyProposal
from dsfit.proposals.fiber_family import FiberFamily


@pytest.fixture(scope="module")
def proposal() -> FamilyProposal:
    return FamilyProposal(FiberFamily(absorption=(0.1, 2.0), eccentric=0.3), hidden=(16,))


@pytest.fixture(scope="module")
def targets(proposal: FamilyProposal) -> FamilyTargets:
    generator = torch.Generator().manual_seed(1)
    drawn = proposal.family.draw(4, generator)
    assert [b.fiber.is_round for b in drawn].count(False) >= 1
    return family_targets(proposal, drawn, TRAINING, 5, 4, generator)


@pytest.fixture(scope="module")
def unseen(proposal: FamilyProposal) -> FamilyTargets:
    generator = torch.Generator().manual_seed(2)
    return family_targets(proposal, proposal.family.draw(3, generator), TRAINING, 4, 4, generator)


@pytest.fixture(scope="module")
def trained(proposal: FamilyProposal, targets: FamilyTargets) -> TrainedFamily:
    return train_family(proposal, targets=targets, steps=40, seed=3)


def test_targets_are_densities(targets: FamilyTargets) -> None:
    grid = targets.targets
    mass = (grid.weight[..., None] * grid.target).sum((1, 2))
    torch.testing.assert_close(mass, torch.ones_like(mass), rtol=0, atol=1e-4)
    assert len(targets) == 20 and targets.floor.shape == (20, 4)
    assert bool((targets.floor >= -1e-6).all()) and bool((targets.floor[targets.fiber == 0] < 0.05).all())


def test_excess_agrees_with_adaptive_quadrature(proposal: FamilyProposal) -> None:
    bsdf = dsfit.DualScattering(dsfit.Fiber.preset("brown"), precision="table")
    generator = torch.Generator().manual_seed(4)
    made = family_targets(proposal, [bsdf], TRAINING, 1, 1, generator, dtype=torch.float64)
    found = family_excess(proposal, made)
    context = made.targets.context.reshape(-1)
    exact = dsfit.excess(dsfit.Integrand(bsdf), FamilyProposal().of(bsdf), context, 1e-2)
    torch.testing.assert_close(found.reshape(-1), exact.value, rtol=0.05, atol=1e-4)


def test_training_helps_fibres_that_it_did_not_see(
    proposal: FamilyProposal, trained: TrainedFamily, targets: FamilyTargets, unseen: FamilyTargets
) -> None:
    for judged, factor in ((targets, 0.8), (unseen, 0.95)):
        before, after = (family_excess(p, judged) for p in (proposal, trained.proposal))
        assert float(torch.log1p(100 * after).mean()) < factor * float(torch.log1p(100 * before).mean())
    assert trained.history[-1].objective < trained.history[0].objective or len(trained.history) == 1
    assert trained.views == 20 and trained.contexts == 80 and set(trained.seconds) == {"targets", "training"}
    assert trained.excess == sorted(trained.excess) and len(trained.excess) == 80


def test_given_proposal_stays_as_it_was(proposal: FamilyProposal, trained: TrainedFamily) -> None:
    assert not proposal.network.weights[-1].any() and trained.proposal.network.weights[-1].any()
    assert not any(p.requires_grad for p in trained.proposal.parameters())


def test_same_seed_same_result(proposal: FamilyProposal, targets: FamilyTargets) -> None:
    first, second = (train_family(proposal, targets=targets, steps=5, seed=7).proposal for _ in range(2))
    other = train_family(proposal, targets=targets, steps=5, seed=8).proposal
    for a, b in zip(first.parameters(), second.parameters(), strict=True):
        assert torch.equal(a, b)
    assert not torch.equal(first.network.weights[-1], other.network.weights[-1])


def test_fibres_are_drawn_by_the_seed(proposal: FamilyProposal) -> None:
    made = train_family(proposal, fibers=1, inclinations=1, pairs=2, steps=1, seed=5)
    assert made.views == 1 and made.contexts == 2 and made.seconds["targets"] > 0


@pytest.mark.parametrize(
    "options", [{"steps": -1}, {"fibers": 0}, {"pairs": 1.5}, {"inclinations": True}, {"scale": 0.0}, {"scale": "x"}]
)
def test_bad_input_is_told(proposal: FamilyProposal, options: dict) -> None:
    with pytest.raises(InputError):
        train_family(proposal, **options)


def test_something_else_is_told() -> None:
    with pytest.raises(InputError):
        train_family("hair")  # type: ignore[arg-type]


@pytest.mark.slow
def test_excess_of_an_eccentric_fibre_is_the_mean_over_orientations(proposal: FamilyProposal) -> None:
    """Direct light, which the adaptive quadrature evaluates without tables; a mean over 4 orientations of either."""
    bsdf = dsfit.DualScattering(dsfit.Fiber(sigma_a=(0.05, 0.1, 0.2), eccentricity=0.88))
    stream = dsfit.ContextStream(theta="angle", direct=1.0)
    made = family_targets(proposal, [bsdf], stream, 1, 1, torch.Generator().manual_seed(4), dtype=torch.float64)
    used = float(family_excess(proposal, made))
    one = made.targets.context.reshape(-1)[0]
    turned = [dsfit.Context(one.theta_r, (k + 0.5) * torch.pi / 4, one.n, one.v) for k in range(4)]
    member = proposal.of(bsdf, extrapolate=True)
    exact = [float(dsfit.excess(dsfit.Integrand(bsdf), member, context, 1e-2).value) for context in turned]
    assert abs(sum(exact) / 4 - used) < 0.05 * used + 1e-4, (exact, used)
