"""What the fuzz tests found, one plain test each."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch

import dsfit
from dsfit import Context, DualScattering, Fiber, Integrand
from dsfit.errors import InputError
from dsfit.mis import heuristic, parse_allocation
from dsfit.proposals import GaussianLobe, Mixture, Product, UniformAzimuth, UniformSphere
from dsfit.random import uniforms


def test_averages_at_grazing_inclination_in_float32() -> None:
    """Rounded to float32, pi/2 is too large, and the last panel of the tables has no width."""
    bsdf = DualScattering(Fiber.preset("blond"))
    for sign in (-1, 1):
        theta = (sign * torch.tensor(torch.pi / 2, dtype=torch.float32)).requires_grad_()
        averages = bsdf.averages(theta)
        for name in ("a_f", "a_b", "beta_f", "A_b", "delta_b", "sigma_b"):
            value = getattr(averages, name)
            assert bool(torch.isfinite(value).all())
            (slope,) = torch.autograd.grad(value.sum(), theta, retain_graph=True)
            assert bool(torch.isfinite(slope)), name
        assert bool((averages.a_f > 0).all())
        assert bool(torch.isfinite(bsdf(theta, theta, torch.tensor(1.0), 3.0, 0.5)).all())


def test_no_samples_are_no_directions() -> None:
    empty = torch.empty(0, 3, dtype=torch.float64)
    narrow = Product(GaussianLobe(1.5, 2e-5), UniformAzimuth())
    for proposal in (narrow, Mixture([narrow, UniformSphere()])):
        direction, density = proposal(Context(0.0)).sample_with_log_prob(empty)
        assert direction.shape == (0, 2) and density.shape == (0,)


def test_uniforms_of_exactly_zero_or_one() -> None:
    """torch.rand returns an exact 0 once in 2^24 numbers of float32."""
    for dtype in (torch.float32, torch.float64):
        for proposal in (Product(GaussianLobe(0.1, 0.2), UniformAzimuth()), UniformSphere()):
            u = torch.tensor([[0.0, 0.0], [1.0, 1.0]], dtype=dtype)
            direction, density = proposal(Context(0.3, dtype=dtype)).sample_with_log_prob(u)
            assert bool(torch.isfinite(direction).all()) and bool(torch.isfinite(density).all())


@pytest.mark.parametrize(
    "call",
    [
        lambda: heuristic({"kind": "power", "beta": "2"}),
        lambda: heuristic("cutoff", alpha=[0.1]),
        lambda: parse_allocation(0.5, 1, 1),
        lambda: uniforms(3, 2, generator=torch.Generator()),
        lambda: Fiber.preset("blond", eta=torch.full((2,), 1.5), beta=torch.ones(3, 3)),
        lambda: Fiber.preset("blond", dtype=torch.float16),
        lambda: Context(torch.zeros(2), torch.zeros(3)),
        lambda: Context(1j),
        lambda: Context("x"),
        lambda: DualScattering(3.0),
        lambda: DualScattering(Fiber.preset("blond"))(0.1, float("nan"), 0.2),
        lambda: DualScattering(Fiber.preset("blond"))(0.1, 0.2, 0.2, n=-1.0),
        lambda: UniformSphere()(Context(0.0)).sample(torch.tensor([0.5, 1.5])),
        lambda: UniformSphere()(Context(0.0)).sample(torch.tensor([0.5, float("nan")])),
        lambda: UniformSphere()(Context(0.0)).log_prob(torch.tensor([0.5, float("inf")])),
        lambda: dsfit.reference(Integrand(DualScattering(Fiber.preset("blond"))), Context(torch.empty(0))),
        lambda: dsfit.estimate(None, None, Context(0.0), 4, generator=torch.Generator()),
        lambda: dsfit.fit(UniformSphere(), None, Context(0.0), nodes=3),
    ],
)
def test_one_clear_error(call: Callable[[], Any]) -> None:
    with pytest.raises(InputError, match="got .*allowed: "):
        call()


def test_unused_strategies_do_not_matter_whatever_their_densities() -> None:
    log_p = torch.tensor([[1e308], [-1e308], [-1e308]], dtype=torch.float64)
    for name in ("balance", "power", "maximum", "cutoff"):
        weights = heuristic(name).weights(log_p, torch.tensor([0.0, 1.0, 1.0], dtype=torch.float64))
        assert weights.flatten().tolist() == pytest.approx([0.0, 0.5, 0.5], abs=1e-12)
