"""What the fuzz tests found, one plain test each."""

from __future__ import annotations

import torch

from dsfit import Context, DualScattering, Fiber
from dsfit.proposals import GaussianLobe, Mixture, Product, UniformAzimuth, UniformSphere


def test_averages_at_grazing_inclination_in_float32() -> None:
    """Rounded to float32, pi/2 is too large, and the last panel of the tables has no width."""
    bsdf = DualScattering(Fiber.preset("blond"), precision="table")
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
