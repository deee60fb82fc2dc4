"""The peer with VEGAS: unbiased by either estimator, at most the samples asked for, its map a density."""

from __future__ import annotations

import math

import pytest
import torch

import dsfit
from dsfit.race.peers import vegas as peer_module
from dsfit.race.peers.vegas import Vegas
from dsfit.race.peers.vegas_map import MapDistribution
from tests.race.peers_support import CONTEXTS, estimates, is_centred, ready, root_mean_square

pytest.importorskip("vegas")


@pytest.mark.parametrize(
    ("estimator", "uniforms"), [("stratified", "random"), ("map", "random"), ("stratified", "sobol")]
)
def test_unbiased_and_a_bias_of_a_few_percent_is_seen(estimator: str, uniforms: str) -> None:
    found = estimates(ready(Vegas(estimator=estimator), uniforms))
    assert is_centred(found)
    assert not is_centred(1.05 * found)


def test_a_forgotten_cosine_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(peer_module, "cos_inclination", torch.ones_like)
    assert not is_centred(estimates(ready(Vegas()), runs=24))


def test_sobol_points_lower_the_error() -> None:
    plain, quasi = (root_mean_square(estimates(ready(Vegas(estimator="map"), k), runs=24)) for k in ("random", "sobol"))
    assert bool((quasi < 0.5 * plain).all())


@pytest.mark.parametrize("samples", [64, 100, 256, 1000])
def test_no_more_evaluations_than_asked_for(samples: int, monkeypatch: pytest.MonkeyPatch) -> None:
    sampler = ready(Vegas())
    spent = []
    right = peer_module._Adapted.values
    monkeypatch.setattr(peer_module._Adapted, "values", lambda self, x: spent.append(len(x)) or right(self, x))
    assert samples >= sampler.least
    sampler.estimate(samples, torch.Generator().manual_seed(1))
    assert 0.8 * samples * 4 <= sum(spent) <= samples * 4


@pytest.mark.parametrize("even", [True, False])
def test_the_map_is_a_density(even: bool) -> None:
    """Constant on every product of increments, so midpoints integrate it exactly; samples agree with log_prob."""
    generator = torch.Generator().manual_seed(4)

    def ends(low: float, high: float) -> torch.Tensor:
        steps = 0.1 + torch.rand(2, 9, generator=generator, dtype=torch.float64)
        inner = torch.nn.functional.pad((steps / steps.sum(-1, keepdim=True)).cumsum(-1), (1, 0))
        return low + (high - low) * inner.clamp(0, 1)

    context = dsfit.Context([0.1, -0.7], 0.4)
    theta, phi = ends(-math.pi / 2, math.pi / 2), ends(0.0 if even else -math.pi, math.pi)
    law = MapDistribution(context, theta, phi, even)
    middle, across = (theta[:, 1:] + theta[:, :-1]) / 2, (phi[:, 1:] + phi[:, :-1]) / 2
    omega = torch.stack(torch.broadcast_tensors(middle.T[:, None], 0.4 - across.T[None, :]), dim=-1)
    width = (theta[:, 1:] - theta[:, :-1]).T[:, None] * (phi[:, 1:] - phi[:, :-1]).T[None, :]
    mass = (torch.exp(law.log_prob(omega)) * torch.cos(omega[..., 0]) * width).sum((0, 1)) * (2 if even else 1)
    torch.testing.assert_close(mass, torch.ones(2, dtype=torch.float64))
    drawn, log_p = law.sample_with_log_prob(torch.rand(500, 2, 2, generator=generator, dtype=torch.float64))
    torch.testing.assert_close(law.log_prob(drawn), log_p)
    ratio = torch.exp(-log_p) / (4 * math.pi)
    assert bool(((ratio.mean(0) - 1).abs() < 4 * ratio.std(0) / 500**0.5).all())


def test_equal_generators_give_equal_estimates() -> None:
    sampler = ready(Vegas())
    one, two = (sampler.estimate(128, torch.Generator().manual_seed(8)) for _ in range(2))
    torch.testing.assert_close(one, two, rtol=0, atol=0)
    assert one.shape == (len(CONTEXTS), 3)


@pytest.mark.parametrize(
    ("options", "field"),
    [({"iterations": 0}, "iterations"), ({"evaluations": 10}, "evaluations"), ({"estimator": "plus"}, "estimator")],
)
def test_bad_options_are_named(options: dict, field: str) -> None:
    with pytest.raises(dsfit.InputError, match=f"vegas.{field}"):
        Vegas(**options)
