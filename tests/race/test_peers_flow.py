"""The peer with a flow: unbiased however little it was trained, better when trained, its state kept with its time."""

from __future__ import annotations

import functools
import math
from pathlib import Path

import pytest
import torch

import dsfit
from dsfit.race.peer import Problem
from dsfit.race.peers.flow import ZukoFlow
from dsfit.race.peers.flow_density import FlowDistribution, FlowProposal
from dsfit.race.peers.flow_training import draw_pool
from dsfit.streams import ContextStream
from tests.race.peers_support import CONTEXTS, estimates, integrand, is_centred, problem, ready, root_mean_square

pytest.importorskip("zuko")

QUICK = {"seconds": 600.0, "bins": 8, "hidden": (32,)}


@functools.cache
def trained() -> ZukoFlow:
    """Two hundred steps: enough to tell."""
    peer = ZukoFlow(**QUICK, steps=200)
    peer.prepare(problem())
    return peer


def sampler(uniforms: str = "random"):  # noqa: ANN202
    peer = trained()
    peer.problem = problem(uniforms)
    return peer.at(CONTEXTS)


@pytest.mark.parametrize("uniforms", ["random", "sobol"])
def test_unbiased_and_a_bias_of_a_few_percent_is_seen(uniforms: str) -> None:
    found = estimates(sampler(uniforms))
    assert is_centred(found)
    assert not is_centred(1.06 * found)


def test_a_flow_that_forgets_its_slope_in_part_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    right = FlowDistribution.log_prob
    monkeypatch.setattr(FlowDistribution, "log_prob", lambda self, omega: 0.97 * right(self, omega))
    assert not is_centred(estimates(sampler()))


def test_sobol_points_lower_the_error() -> None:
    plain, quasi = (root_mean_square(estimates(sampler(kind))) for kind in ("random", "sobol"))
    assert bool((quasi < 0.8 * plain).all())


def test_training_lowers_loss_and_error() -> None:
    peer = ZukoFlow(**QUICK, steps=1)
    before = root_mean_square(estimates(ready(peer), runs=24))
    assert bool((root_mean_square(estimates(sampler(), runs=24)) < 0.5 * before).all())
    losses = torch.tensor(trained().losses)
    assert float(losses[-50:].mean()) < math.log(4 * math.pi) - 1  # the uniform sphere's, from which training starts


@pytest.mark.parametrize("transforms", [1, 2])
def test_normalised_and_drawn_as_claimed(transforms: int) -> None:
    proposal = FlowProposal(transforms, 6, (16,), 0.05, seed=4).double()
    with torch.no_grad():
        for value in proposal.parameters():
            value.mul_(2.0)  # further from uniform than first weights are
    context = dsfit.Context(0.5, 0.2, 2.0, 0.3)
    theta = (torch.arange(480, dtype=torch.float64) + 0.5) / 480 * math.pi - math.pi / 2
    phi = (torch.arange(360, dtype=torch.float64) + 0.5) / 360 * 2 * math.pi
    omega = torch.stack(torch.meshgrid(theta, phi, indexing="ij"), dim=-1)
    with torch.no_grad():
        density = torch.exp(proposal(context).log_prob(omega)) * torch.cos(theta)[:, None]
        u = torch.rand(20_000, 3, generator=torch.Generator().manual_seed(6), dtype=torch.float64)
        drawn, log_p = proposal(context).sample_with_log_prob(u)
    assert abs(float(density.mean()) * 2 * math.pi**2 - 1) < 1e-3
    ratio = torch.exp(-log_p) / (4 * math.pi)
    tests = ((1.0, 1.0), (torch.sin(drawn[:, 0]) ** 2, 1 / 3), (torch.cos(drawn[:, 1]) ** 2, 0.5))
    for test, exact in tests:
        found = test * ratio
        assert abs(float(found.mean()) - exact) < 4 * float(found.std()) / 20_000**0.5


def test_the_pool_is_weighted_to_the_integrand() -> None:
    """A weighted mean over the pool is the mean over contexts of the integrand's own: here, of cos(phi)."""
    pool = draw_pool(problem(), 1, torch.Generator().manual_seed(7))
    assert abs(float(pool.weight.mean()) - 1) < 1e-5
    few = [x.reshape(64, 256, *x.shape[1:])[:, :48] for x in (pool.weight, pool.omega)]
    context = pool.context[:48]
    line = (torch.arange(48) + 0.5) / 48
    grid = torch.cartesian_prod(math.pi * (line - 0.5), math.pi * line)
    value = integrand()(grid[:, None].expand(-1, 48, -1), context).norm(dim=-1) * torch.cos(grid[:, :1])
    exact = float(((value * torch.cos(grid[:, 1:])).sum(0) / value.sum(0)).mean())
    found = float((few[0] * torch.cos(few[1][..., 1])).mean())
    assert abs(found - exact) < 0.02


def test_contexts_without_light_do_not_spoil_the_pool() -> None:
    """Black hair behind thirty fibres: a_f^n underflows in float32."""
    dark = dsfit.Integrand(dsfit.DualScattering(dsfit.Fiber.preset("black"), precision="table"))
    stream = ContextStream(direct=0.0, n_mean=20.0, rule="threshold")
    pool = draw_pool(Problem(dark, stream), 1, torch.Generator().manual_seed(7))
    assert bool(pool.weight.isfinite().all())
    assert bool((pool.weight.reshape(64, 256) == 0).all(0).any()) and bool((pool.weight > 0).any())


def test_state_is_loaded_with_its_time_and_refused_elsewhere(tmp_path: Path) -> None:
    path = str(tmp_path / "flow.safetensors")
    first, second = (ZukoFlow(**QUICK, steps=2, state=path) for _ in range(2))
    first.prepare(problem())
    assert first.recorded_seconds == 0 and Path(path).exists()
    second.prepare(problem())
    assert second.recorded_seconds > 0
    u = torch.rand(5, 4, 3, generator=torch.Generator().manual_seed(1)).clamp(1e-6, 1 - 1e-6)
    torch.testing.assert_close(first.proposal(CONTEXTS).sample(u), second.proposal(CONTEXTS).sample(u), rtol=0, atol=0)
    with pytest.raises(dsfit.InputError, match="zuko_flow.state"):
        ZukoFlow(**QUICK, steps=3, state=path).prepare(problem())


def test_first_weights_leave_the_global_generator_alone() -> None:
    torch.manual_seed(5)
    before = torch.get_rng_state()
    FlowProposal(1, 4, (8,), 0.1, seed=1)
    assert torch.equal(before, torch.get_rng_state())


@pytest.mark.parametrize(
    ("options", "field"),
    [
        ({"seconds": 0.0}, "seconds"),
        ({"steps": 0}, "steps"),
        ({"transforms": 0}, "transforms"),
        ({"bins": 1}, "bins"),
        ({"hidden": (0,)}, "hidden"),
        ({"rate": -1.0}, "rate"),
        ({"defensive": 0.0}, "defensive"),
    ],
)
def test_bad_options_are_named(options: dict, field: str) -> None:
    with pytest.raises(dsfit.InputError, match=f"zuko_flow.{field}"):
        ZukoFlow(**options)
