"""Fresnel, folds and lobes keep their digits where the textbook forms cancel."""

from __future__ import annotations

import math

import pytest
import torch

import dsfit
from dsfit.bsdf.fresnel import fresnel
from dsfit.bsdf.snell import Caustic, exit_trt_slope


@pytest.mark.parametrize("eta", [1.0001, 1.01, 1.55, 3.0])
def test_fresnel_of_float32_follows_float64(eta: float) -> None:
    """Reflectance and transmittance and their derivatives, from grazing to normal incidence."""
    cosine = torch.tensor([1e-12, 1e-8, 1e-4, 1e-2, 0.2, 0.7, 0.99])
    index = torch.full_like(cosine, eta)
    for which in range(2):
        found = []
        for dtype in (torch.float32, torch.float64):
            leaves = [x.to(dtype).requires_grad_() for x in (index, cosine)]
            value = fresnel(*leaves)[which]
            found.append([value.detach(), *torch.autograd.grad(value.sum(), leaves)])
        for single, double in zip(*found, strict=True):
            torch.testing.assert_close(single.double(), double, rtol=2e-5 if eta < 1.1 else 5e-4, atol=1e-12)


def test_fresnel_shares_add_up() -> None:
    cosine = torch.linspace(0, 1, 101, dtype=torch.float64)
    for eta in (1.0001, 1.5, 3.0):
        reflected, transmitted = fresnel(torch.tensor(eta, dtype=torch.float64), cosine)
        assert torch.equal(reflected + transmitted, torch.ones_like(cosine))
        assert bool((reflected >= 0).all()) and bool((transmitted >= 0).all())


def test_slope_of_trt_near_an_index_of_two() -> None:
    """4 kappa cos g / cos g_t - 2 = 4 (kappa - 1/2) - 3 g^2 / 4 + ..., which is all that float32 can tell apart."""
    kappa = torch.tensor(0.5 + 2.0**-20)
    gamma = torch.tensor([0.0, 1e-4, 1e-3], requires_grad=True)
    exact = exit_trt_slope(kappa.double(), gamma.detach().double())
    torch.testing.assert_close(exit_trt_slope(kappa, gamma).detach().double(), exact, rtol=1e-5, atol=0)
    assert float(Caustic.at(kappa).gamma) == pytest.approx(math.sqrt(2.0**-18 / 0.75), rel=1e-5)


@pytest.mark.parametrize("model", ["marschner", "simplified"])
def test_pi_of_float32_is_not_negative(model: str) -> None:
    """Rounded to float32, pi is too large, and its cos(phi/2) is negative; the lobes are even and periodic."""
    bsdf = dsfit.DualScattering(dsfit.Fiber.preset("blond", dtype=torch.float32), azimuthal=model)
    phi = torch.tensor([math.pi, -math.pi])
    assert float(phi[0]) > math.pi
    value = bsdf.azimuthal(torch.full_like(phi, 0.3), phi)
    assert bool((value >= 0).all()) and bool((value[:, 0] > 0).all())
