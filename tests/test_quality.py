"""The reference is right, its bound is honest, and the excess agrees with what it is defined by."""

from __future__ import annotations

import math

import pytest
import torch

import dsfit
from dsfit.cubature import integrate
from dsfit.proposals import UniformSphere
from dsfit.quadrature import PiecewiseChebyshev
from dsfit.quality import quadrature_nodes
from dsfit.scene import ConstantLight, VonMisesFisherLights

DEG = math.pi / 180
CASES = {
    "direct": ({}, "marschner", 0.3, 0.0),
    "deep": ({}, "marschner", -0.8, 4.0),
    "grazing": ({}, "marschner", 80 * DEG, 0.0),
    "caustic": ({}, "raw", 0.2, 0.0),
    "needle": ({"beta": [0.1 * DEG] * 3, "caustic_width": 2 * DEG}, "marschner", 0.6, 0.0),
    "elliptic": ({"eccentricity": 0.88}, "marschner", 0.3, 0.0),
    "closed form azimuths": ({}, "simplified", 0.3, 2.0),
}


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_error_bound_holds(case: tuple) -> None:
    overrides, model, theta_r, n = case
    fiber = dsfit.Fiber.preset("blond", **overrides)
    integrand = dsfit.Integrand(dsfit.DualScattering(fiber, azimuthal=model))
    context = dsfit.Context(theta_r, phi_r=0.7, n=n)
    fine = dsfit.reference(integrand, context, 1e-8)
    assert fine.converged and bool((fine.error <= 1e-8 * fine.value).all())
    for rtol in (1e-3, 1e-5):
        coarse = dsfit.reference(integrand, context, rtol)
        assert bool(((coarse.value - fine.value).abs() <= coarse.error + fine.error).all())
        assert float((coarse.norm - fine.norm).abs()) <= float(coarse.norm_error + fine.norm_error)


def test_reference_against_plain_tensor_quadrature() -> None:
    """An independent rule: 900 x 1600 midpoints in (sin theta, phi), no knowledge of the integrand."""
    integrand = dsfit.Integrand(dsfit.DualScattering(dsfit.Fiber.preset("brown"), precision="table"))
    context = dsfit.Context(0.5, n=3.0)
    exact = dsfit.reference(integrand, context, 1e-6).value
    s = (torch.arange(900, dtype=torch.float64) + 0.5) / 450 - 1
    phi = (torch.arange(1600, dtype=torch.float64) + 0.5) * (2 * math.pi / 1600)
    omega = torch.stack(torch.meshgrid(torch.asin(s), phi, indexing="ij"), dim=-1)
    total = integrand(omega, context).sum((0, 1)) * (2 / 900) * (2 * math.pi / 1600)
    torch.testing.assert_close(total, exact, rtol=2e-5, atol=0)


def test_narrow_light_is_seen() -> None:
    """A lobe of light 0.1 degrees wide: the integral is the integrand at its centre times its power."""
    bsdf = dsfit.DualScattering(dsfit.Fiber.preset("blond"))
    center = torch.tensor([[-0.2, 2.2]], dtype=torch.float64)
    kappa = VonMisesFisherLights.kappa_of_width(0.1 * DEG)
    light = VonMisesFisherLights(center, kappa, intensity=1.0)
    context = dsfit.Context(0.3)
    found = dsfit.reference(dsfit.Integrand(bsdf, light), context, 1e-6)
    point = dsfit.Integrand(bsdf)(center[0], context)
    assert found.converged
    torch.testing.assert_close(found.value, point, rtol=1e-3, atol=0)


def test_batch_equals_loop_and_light_scales() -> None:
    bsdf = dsfit.DualScattering(dsfit.Fiber.preset("black"))
    context = dsfit.Context(torch.tensor([[0.1], [1.0]], dtype=torch.float64), n=torch.tensor([0.0, 2.0]))
    batch = dsfit.reference(dsfit.Integrand(bsdf, ConstantLight(2.0)), context, 1e-6)
    assert batch.value.shape == (2, 2, 3) and batch.m_star.shape == (2, 2)
    one = dsfit.reference(dsfit.Integrand(bsdf), dsfit.Context(1.0, n=2.0), 1e-6)
    torch.testing.assert_close(batch.value[1, 1], 2 * one.value, rtol=1e-10, atol=0)


def test_unconverged_is_said() -> None:
    integrand = dsfit.Integrand(dsfit.DualScattering(dsfit.Fiber.preset("blond")))
    assert not dsfit.reference(integrand, dsfit.Context(0.2), 1e-10, max_evaluations=20_000).converged
    with pytest.raises(dsfit.InputError, match="rtol"):
        dsfit.reference(integrand, dsfit.Context(0.2), 0.0)


def test_excess_is_the_second_moment() -> None:
    """excess = M(p)/M* - 1 with M by an independent sum over nodes; and 0 can only be approached from above."""
    integrand = dsfit.Integrand(dsfit.DualScattering(dsfit.Fiber.preset("blond")))
    context = dsfit.Context(0.3)
    nodes = quadrature_nodes(integrand, context, 1e-7)
    uniform = UniformSphere()
    moment = (nodes.weight * nodes.norm**2).sum() * 4 * math.pi
    expected = moment / (nodes.weight * nodes.norm).sum() ** 2 - 1
    found = dsfit.excess(integrand, uniform, context)
    torch.testing.assert_close(found.value, expected, rtol=1e-3, atol=0)
    torch.testing.assert_close(found.mass, torch.ones_like(found.mass), rtol=1e-3, atol=0)
    close = dsfit.excess(integrand, dsfit.StructuredProposal(integrand.bsdf, context), context)
    assert 0 < float(close.value) < 0.05 < float(found.value)


def test_nodes_of_even_integrands_cover_both_halves() -> None:
    integrand = dsfit.Integrand(dsfit.DualScattering(dsfit.Fiber.preset("blond")))
    context = dsfit.Context(0.3, phi_r=1.0)
    exact = dsfit.reference(integrand, context, 1e-6)
    for even in (False, True):
        # the rule of 10 x 10 points is what rtol speaks of; fits take a sparser one
        for count, rtol in ((10, 1e-4), (5, 5e-4)):
            nodes = quadrature_nodes(integrand, context, 1e-4, even=even, count=count)
            torch.testing.assert_close((nodes.weight[:, None] * nodes.value).sum(0), exact.value, rtol=rtol, atol=0)
        torch.testing.assert_close(nodes.weight.sum(), torch.tensor(4 * math.pi).double(), rtol=1e-4, atol=0)
    with pytest.raises(dsfit.InputError, match="context"):
        quadrature_nodes(integrand, dsfit.Context(torch.zeros(2)))


def test_cubature_of_a_square_root_edge() -> None:
    """int over the square of (phi - theta)^(-1/2) above the diagonal: 4/3 * 2^(3/2) on [0, 1] x [theta, theta + ..]."""

    def function(theta: torch.Tensor, phi: torch.Tensor) -> torch.Tensor:
        return (phi - theta).clamp_min(1e-300).rsqrt().unsqueeze(-1)

    def edges(theta: torch.Tensor) -> torch.Tensor:
        return torch.stack([theta, torch.ones_like(theta)], dim=-1)

    breaks = torch.tensor([0.0, 1.0], dtype=torch.float64)
    found = integrate(function, breaks, edges, 1e-10, 1_000_000)
    assert found.converged and abs(float(found.value[0]) - 4 / 3) <= float(found.error[0])


def test_piecewise_chebyshev_reaches_its_tolerance() -> None:
    def function(x: torch.Tensor) -> torch.Tensor:
        return torch.stack([torch.exp(-(((x - 0.3) / 0.01) ** 2)), torch.sin(9 * x)], dim=-1)

    table = PiecewiseChebyshev(function, torch.tensor([0.0, 1.0], dtype=torch.float64), tolerance=1e-12)
    x = torch.linspace(0, 1, 1001, dtype=torch.float64)
    assert float((table(x) - function(x)).abs().max()) < 1e-10
