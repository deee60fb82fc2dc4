"""N^G where its integrand is narrow or its window's edge meets phi = 0."""

from __future__ import annotations

import math

import pytest
import torch

import dsfit
from dsfit.bsdf.attenuation import attenuation
from dsfit.bsdf.glint import Glint
from dsfit.bsdf.scattered import beyond_pi
from dsfit.bsdf.snell import Caustic, Refraction, exit_trt

ONE = torch.ones((), dtype=torch.float64)


@pytest.mark.parametrize("width", [0.002, 0.02, 0.09, 0.11])
@pytest.mark.parametrize("diff", [0.5, 0.7])
def test_narrow_glints(width: float, diff: float) -> None:
    """N^G_TRT against a midpoint sum over offsets; the removal at -phi_c lies inside an interval of the fast rule."""
    fiber = dsfit.Fiber(sigma_a=[0.125], eta=1.5, caustic_width=width)
    phi = 0.6 * ONE
    bent = Refraction.at(fiber.eta, diff * ONE)
    glint = Glint.of(fiber, bent, Caustic.at(bent.kappa), "geometric")
    count = 200_000
    gamma = (torch.arange(count, dtype=torch.float64) + 0.5) * (math.pi / count) - math.pi / 2
    leaves = exit_trt(bent.kappa, gamma)
    inside = (leaves - phi).abs() < math.pi / 2
    carried = attenuation(2, bent, fiber.sigma_a, torch.sin(gamma), torch.cos(gamma), "geometric")[..., 0]
    mass = (carried * torch.cos(gamma) * glint.removal(leaves) * inside).sum() * (math.pi / count) / 2
    expected = (mass + glint.added_mass(phi)[0]) / math.pi
    found = dsfit.DualScattering(fiber).azimuthal_scattered(diff * ONE, phi)[2, 0]
    torch.testing.assert_close(found, expected, rtol=3e-6, atol=0)


@pytest.mark.parametrize("model", ["marschner", "raw", "simplified"])
def test_derivative_at_a_right_angle(model: str) -> None:
    """At phi = pi/2 the window's edge is at 0, and both its edges move."""
    bsdf = dsfit.DualScattering(dsfit.Fiber(sigma_a=[0.125], eta=1.5), azimuthal=model)
    points = torch.tensor([-1.0, 0.0, 1.0], dtype=torch.float64) * 1e-5 + math.pi / 2
    points.requires_grad_()
    value = bsdf.azimuthal_scattered(torch.full_like(points, 0.3), points)
    for p in range(3):
        (slope,) = torch.autograd.grad(value[:, p].sum(), points, retain_graph=True)
        numeric = (value[2, p, 0] - value[0, p, 0]) / 2e-5
        torch.testing.assert_close(slope[1], numeric.detach(), rtol=1e-4, atol=1e-9)


def test_distance_from_pi_keeps_its_digits_in_float32() -> None:
    phi = torch.tensor([3.14, 3.1415925, math.pi])
    expected = [float(x) - math.pi for x in phi]
    assert beyond_pi(phi).double().tolist() == pytest.approx(expected, rel=1e-6)


def test_transmittance_of_many_fibres_is_a_power() -> None:
    bsdf = dsfit.DualScattering(dsfit.Fiber.preset("blond"), d_f=1.0)
    theta = torch.tensor([0.3], dtype=torch.float64)
    base = bsdf.averages(theta).a_f
    for n in (0.0, 0.5, 400.0, 1e4):
        found = bsdf.transmittance(theta, torch.tensor([n], dtype=torch.float64))
        torch.testing.assert_close(found, base**n, rtol=1e-15, atol=0)
