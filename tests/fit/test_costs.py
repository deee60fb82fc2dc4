"""Measured costs and the fit that minimises variance times cost."""

from __future__ import annotations

import time

import pytest
import torch

from dsfit.context import Context
from dsfit.errors import InputError
from dsfit.fit import VarianceCost, fit
from dsfit.fit.costs import measure_costs
from dsfit.proposals.azimuth import WrappedGaussian
from dsfit.proposals.base import Product
from dsfit.proposals.gaussian_lobe import GaussianLobe
from dsfit.proposals.mixture import Mixture
from tests.fit.toys import Toy, nodes

ONE = Context(0.3)


def lobe(mean, std, gamma):
    return Product(GaussianLobe(mean, std), WrappedGaussian(gamma))


class Slow(Product):
    def forward(self, context):
        inner = super().forward(context)
        draw = inner.sample

        def sample(u):
            time.sleep(0.02)
            return draw(u)

        inner.sample = sample
        return inner


def test_measured_costs_tell_slow_from_fast():
    slow = Slow(GaussianLobe(0.0, 0.3), WrappedGaussian(0.5))
    mixture = Mixture([lobe(0.1, 0.2, 0.5), slow], defensive=0.1)
    costs = measure_costs(mixture, ONE, lambda omega, context: omega, samples=1000, repeats=2)
    assert len(costs.components) == 3 and costs.base > 0
    assert costs.components[1] > 20 and costs.components[1] > 2 * max(costs.components[0], costs.components[2])
    with pytest.raises(InputError, match="components"):
        measure_costs(Toy([0.0]), ONE)
    with pytest.raises(InputError, match="repeats"):
        measure_costs(mixture, ONE, repeats=0)


def test_a_dear_component_is_used_less():
    pytest.importorskip("jax")
    known = Mixture([lobe(-0.2, 0.2, 0.6), lobe(0.3, 0.3, 1.0)], defensive=0.05)
    omega, weight = nodes(50)
    with torch.no_grad():
        value = known(ONE).log_prob(omega).exp()[:, None]
    # Three colours that differ in direction: the variance cannot vanish, so cost matters.
    value = value * torch.stack([1 + omega[:, 0].sin(), torch.ones(len(omega)), 1 - omega[:, 0].sin()], -1)
    shares = []
    for cost in ([1.0, 1.0], [1.0, 20.0]):
        start = Mixture([lobe(-0.2, 0.25, 0.7), lobe(0.3, 0.35, 0.9)], defensive=0.05)
        found = fit(start, None, ONE, VarianceCost(cost), nodes=(omega, weight, value), max_steps=60)
        assert found.result.value < found.history[0].value
        shares.append(float(found.proposal.weights()[1]))
    assert shares[1] < 0.7 * shares[0]
