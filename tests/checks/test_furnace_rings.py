"""Weighted counts: exact quadrature, false alarms at their nominal rate, and samplers that must be caught."""

from __future__ import annotations

import functools
import math

import numpy as np
import pytest
import torch
from scipy import stats
from torch import Tensor

import dsfit
from dsfit.checks.furnace import (
    ConstantIntegrand,
    FlippedInclination,
    Folded,
    Partition,
    PartitionNodes,
    PermutedRings,
    ScaledDensity,
    draw,
    partition_nodes,
    ring_light,
    weighted_counts,
    white_furnace,
)
from dsfit.checks.furnace.rings import merge_cells, quadratic_form, skew_tail
from dsfit.frame import HALF_PI, to_vector
from dsfit.proposals import UniformSphere, chapter_proposals
from dsfit.proposals.base import Proposal
from dsfit.proposals.printed import PRINTED
from dsfit.scene.lights import Light

CONTEXT = dsfit.Context(0.4, 0.7)


@functools.cache
def hair() -> dsfit.Integrand:
    """Single scattering of a blond fibre, one channel: what these tests need, and quick."""
    return dsfit.Integrand(dsfit.DualScattering(dsfit.Fiber.preset("blond", sigma_a=[0.07]), d_b=0.0))


@functools.cache
def hair_nodes(theta_r: float = 0.4) -> PartitionNodes:
    return partition_nodes(hair(), dsfit.Context(theta_r, 0.7), Partition.even(18, 6))


def lobe(omega: Tensor, context: dsfit.Context) -> Tensor:
    """A smooth lobe about a fixed direction, two channels: cheap enough for hundreds of repetitions."""
    axis = to_vector(torch.tensor([0.5, 1.2], dtype=torch.float64))
    cosine = (to_vector(omega) * axis).sum(-1)
    return torch.stack([torch.exp(6 * (cosine - 1)), 0.1 + 0 * cosine], dim=-1)


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


class RingLight(Light):
    """Radiance 1 between two inclinations, for an expected answer from `dsfit.reference`."""

    channels = 1
    label = "ring"

    def __init__(self, low: float, high: float) -> None:
        super().__init__()
        self.low, self.high = low, high

    def forward(self, omega_i: Tensor) -> Tensor:
        inside = (omega_i[..., 0] >= self.low) & (omega_i[..., 0] < self.high)
        return inside.to(omega_i).unsqueeze(-1)

    def proposal(self) -> Proposal:
        return UniformSphere()

    def breakpoints(self) -> tuple[list[float], list[float]]:
        return [self.low, self.high], []


def test_rings_integrate_to_what_a_ring_light_gives() -> None:
    nodes = hair_nodes()
    sums, bounds = nodes.integrate(lambda rule: rule.value)
    rings = torch.zeros(18, dtype=torch.float64).index_add_(0, nodes.partition.rings(), sums[:, 0])
    whole = dsfit.reference(hair(), CONTEXT, 1e-7).value
    assert float((rings.sum() / whole - 1).abs()) < 1e-5
    for k in (3, 7, 8):
        low, high = (float(nodes.partition.theta[j]) for j in (k, k + 1))
        lit = dsfit.reference(dsfit.Integrand(hair().bsdf, RingLight(low, high)), CONTEXT, 1e-6).value
        assert abs(float(rings[k] - lit)) < 1e-5 * float(whole) + float(bounds.sum())


def test_constant_integrand_by_hand() -> None:
    partition = Partition(torch.tensor([-HALF_PI, -0.3, 0.8, HALF_PI], dtype=torch.float64), Partition.even(1, 5).phi)
    nodes = partition_nodes(ConstantIntegrand(), CONTEXT, partition)
    sums, _ = nodes.integrate(lambda rule: rule.value)
    wanted = torch.sin(partition.theta).diff()[:, None] * partition.phi.diff() / (4 * math.pi)
    torch.testing.assert_close(sums[:, 0], wanted.flatten(), rtol=1e-6, atol=0)
    assert Partition.ring(0.5, 0.02).shape == (3, 1) and Partition.ring(HALF_PI, 0.02).shape == (2, 1)


@pytest.mark.parametrize(("name", "beside"), [("uniform", 0.0), ("M_TRT", 0.0), ("TT", 0.5)])
def test_right_samplers_give_uniform_p_values(name: str, beside: float) -> None:
    """M_TRT covers this lobe badly: its weights are capped at 40 means. TT leaves it out, and has the sphere's help."""
    proposal = chapter_proposals(dsfit.Fiber.preset("blond"), learnable=False)[name]
    nodes = partition_nodes(lobe, CONTEXT, Partition.even(12, 6))
    density = nodes.with_density(proposal(CONTEXT).log_prob)
    p_values = []
    for seed in range(150):
        draws = draw(lobe, proposal, CONTEXT, 2000, generator=generator(seed), beside=beside)
        counts = [
            weighted_counts(density, draws, cells)
            for cells in (nodes.partition.rings(), nodes.partition.wedges(), None)
        ]
        assert min(x.degrees for x in counts) >= 3
        p_values.append([*(x.p_value for x in counts), white_furnace(density, draws).p_value])
    found = np.array(p_values)
    assert found[:, :3].min() > 1e-4
    for column in range(3):
        assert stats.kstest(found[:, column], "uniform").pvalue > 1e-3, column
    if name != "M_TRT":  # whose uncapped weights have no variance to speak of
        # the furnace is conservative: its channels go together, and it corrects for several
        assert found[:, 3].min() > 1e-4
        assert stats.kstest(found[:, 3], "uniform", alternative="greater").pvalue > 1e-3


def test_what_cannot_be_judged_is_left_out() -> None:
    """TT alone hits this lobe so rarely that no ring has samples to speak of."""
    proposal = chapter_proposals(dsfit.Fiber.preset("blond"), learnable=False)["TT"]
    found = ring_light(lobe, proposal, CONTEXT, Partition.even(12), 2000, generator=generator(1))
    assert found.untested > 0.9 and found.degrees == 0 and found.p_value == 1.0


@pytest.mark.parametrize("consistent", [False, True])
@pytest.mark.parametrize("control", [FlippedInclination, PermutedRings, Folded])
def test_wrong_directions_are_caught(control: type, consistent: bool) -> None:
    right = chapter_proposals(hair().bsdf.fiber, learnable=False)["M_TT"]
    wrong = control(right, consistent)
    density = hair_nodes().with_density(wrong(CONTEXT).log_prob)
    draws = draw(hair(), wrong, CONTEXT, 8000, generator=generator(3), beside=0.5)
    assert weighted_counts(density, draws, hair_nodes().partition.rings()).p_value < 1e-6
    good = draw(hair(), right, CONTEXT, 8000, generator=generator(3), beside=0.5)
    assert weighted_counts(density, good, hair_nodes().partition.rings()).p_value > 1e-3


def test_right_only_in_total_passes_the_furnace_and_fails_the_rings() -> None:
    """A lossless constant integrand cannot tell where directions go; the rings can."""
    nodes = partition_nodes(ConstantIntegrand(), CONTEXT, Partition.even(18))
    for wrong in (PermutedRings(UniformSphere()), Folded(UniformSphere())):
        density = nodes.with_density(wrong(CONTEXT).log_prob)
        draws = draw(ConstantIntegrand(), wrong, CONTEXT, 4000, generator=generator(1))
        furnace = white_furnace(density, draws)
        assert furnace.p_value > 0.1 and abs(float(furnace.estimate) - 1) < 1e-9
        assert weighted_counts(density, draws).p_value < 1e-6
    right = UniformSphere()
    assert ring_light(ConstantIntegrand(), right, CONTEXT, samples=4000, generator=generator(1)).p_value > 1e-3


def test_a_density_of_wrong_scale_is_caught_by_both() -> None:
    wrong = ScaledDensity(chapter_proposals(hair().bsdf.fiber, learnable=False)["M_TRT"], 1.2)
    density = hair_nodes().with_density(wrong(CONTEXT).log_prob)
    draws = draw(hair(), wrong, CONTEXT, 20_000, generator=generator(5))
    assert white_furnace(density, draws).p_value < 1e-6
    assert weighted_counts(density, draws, hair_nodes().partition.wedges()).p_value < 1e-6


@pytest.mark.parametrize("name", PRINTED)
def test_printed_samplers_fail_the_ring_light(name: str) -> None:
    """At a grazing viewer too, where the clamp of eq (16) bites; there the furnace alone lets some of them pass."""
    p_values = []
    for theta_r in (0.4, 1.3):
        context, nodes = dsfit.Context(theta_r, 0.7), hair_nodes(theta_r)
        density = nodes.with_density(PRINTED[name]()(context).log_prob)
        draws = draw(hair(), PRINTED[name](), context, 8000, generator=generator(7), beside=0.5)
        for cells in (nodes.partition.rings(), nodes.partition.wedges()):
            p_values.append(weighted_counts(density, draws, cells).p_value)
    assert min(p_values) < 1e-6 / len(p_values), p_values


def test_directions_off_the_sphere_fail() -> None:
    class Broken(FlippedInclination):
        def change(self, omega: Tensor) -> Tensor:
            bad = omega[..., :1] > 1.4
            return torch.where(bad, omega + 0.3, omega)

    wrong = Broken(UniformSphere())
    found = ring_light(ConstantIntegrand(), wrong, CONTEXT, samples=2000, generator=generator(1))
    assert found.invalid > 0 and found.p_value == 0.0


def test_merging_and_the_statistic() -> None:
    moments = torch.tensor([[1.0, 1, 1], [1e-4, 1e-4, 1e-4], [1e-4, 1e-4, 1e-4], [1.0, 1e4, 1e9]]).double()
    group = merge_cells(moments, 10_000, least=1.5)
    assert group.tolist() == [0, 1, 1, -1]  # small cells are pooled; the one of rare huge weights is left out
    assert merge_cells(moments, 100, least=1.5).tolist() == [0, -1, -1, -1]
    covariance = torch.tensor([[1.0, -1.0], [-1.0, 1.0]]).double()  # the total cannot vary
    assert quadratic_form(torch.tensor([1.0, -1.0]).double(), covariance) == (pytest.approx(1.0), 1)
    assert quadratic_form(torch.tensor([1.0, 0.0]).double(), covariance)[0] == math.inf
    for z in (-3.0, 0.4, 4.0):
        for skew in (-1.0, -0.05, 0.0, 0.3, 2.0):
            wanted = stats.pearson3(skew).sf(z)
            assert skew_tail(z, skew) == pytest.approx(wanted, rel=1e-6, abs=1e-14), (z, skew)


def test_bad_input_is_named() -> None:
    batch = dsfit.Context(torch.zeros(2).double())
    with pytest.raises(dsfit.InputError, match="context"):
        partition_nodes(ConstantIntegrand(), batch, Partition.even(4))
    with pytest.raises(dsfit.InputError, match="context"):
        draw(ConstantIntegrand(), UniformSphere(), batch, 10, generator=generator(0))
    with pytest.raises(dsfit.InputError, match="beside"):
        draw(ConstantIntegrand(), UniformSphere(), CONTEXT, 10, generator=generator(0), beside=1.5)
    with pytest.raises(dsfit.InputError, match="rtol"):
        partition_nodes(ConstantIntegrand(), CONTEXT, Partition.even(4), rtol=0.0)
    with pytest.raises(dsfit.InputError, match="theta"):
        Partition(torch.tensor([-1.0, 1.0]).double(), Partition.even(1).phi)
