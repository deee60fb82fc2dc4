"""Mixtures without the components that do not pay: densities, variance, and what is left out."""

from __future__ import annotations

import pytest
import torch

import dsfit
from dsfit.checks.chi_square import chi_square
from dsfit.experiment.methods import structured_start
from dsfit.proposals import UniformSphere
from dsfit.scene.plan_proposal import PrunedProposal, prune

CONTEXT = dsfit.Context(0.5)
BLACK = dsfit.Integrand(dsfit.DualScattering(dsfit.Fiber.preset("black"), azimuthal="simplified"))


@pytest.fixture(scope="module")
def start() -> dsfit.StructuredProposal:
    return structured_start(BLACK, CONTEXT)  # type: ignore[return-value]


def test_what_a_plan_drops_goes_from_the_mixture(start: dsfit.StructuredProposal) -> None:
    """Lobes that nothing needs go; the density is normalised and is what is drawn; variance is quadrature's."""
    planned = dsfit.plan(BLACK, CONTEXT, 1e-2)
    found = planned.prune(start, CONTEXT, base=2.0)
    names = {name for _, name, _ in found.dropped}
    assert "TRT" in names and "R" not in names and "defensive" not in names and found.gain > 1
    checked = chi_square(found.proposal, CONTEXT, generator=torch.Generator().manual_seed(1))
    assert checked.p_value > 1e-3 and abs(checked.mass - 1) < 1e-3
    after = dsfit.excess(planned.integrand, found.proposal, CONTEXT, 1e-2)
    assert abs(float(after.value) - float(found.excess[0])) <= 1e-9
    assert float(after.mass) == pytest.approx(1.0, abs=1e-3)


def test_time_and_variance_decide(start: dsfit.StructuredProposal) -> None:
    """With components that cost nothing next to the rest none goes that lowers the variance; dear ones go."""
    cheap = prune(start, BLACK, CONTEXT, base=1e6)
    dear = prune(start, BLACK, CONTEXT, costs=[1.0, 1.0, 50.0, 50.0, 1.0, 1.0], base=0.0)
    assert cheap.gain >= 1 and dear.gain > 2
    assert {"TRT", "back"} <= {name for _, name, _ in dear.dropped}
    for found in (cheap, dear):
        share = sum(share for _, _, share in found.dropped)
        assert bool((1 + found.excess >= (1 - share) * (1 + found.excess_before) * (1 - 1e-6)).all())


def test_bad_input(start: dsfit.StructuredProposal) -> None:
    with pytest.raises(dsfit.InputError, match="proposal"):
        prune(UniformSphere(), BLACK, CONTEXT)
    with pytest.raises(dsfit.InputError, match="costs"):
        prune(start, BLACK, CONTEXT, costs=[1.0])
    with pytest.raises(dsfit.InputError, match="costs"):
        prune(start, BLACK, CONTEXT, costs=[0.0] * 6)
    with pytest.raises(dsfit.InputError, match="base"):
        prune(start, BLACK, CONTEXT, base=-1.0)


def test_numbers_where_there_are_no_names() -> None:
    """Any mixture: components are known by number, and one without a defensive share may lose its last."""
    mixture = dsfit.proposals.Mixture([UniformSphere(), UniformSphere()], [1.0, 1.0], defensive=0.0)
    found = prune(mixture, BLACK, CONTEXT)
    assert len(found.dropped) == 1 and found.gain == pytest.approx(10 / 9)
    torch.testing.assert_close(found.excess, found.excess_before)
    assert isinstance(found.proposal, PrunedProposal)
