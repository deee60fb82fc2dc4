"""Kernels of a BSDF whose number of fibres is Poisson distributed."""

from __future__ import annotations

import copy
import functools
import math

import pytest
import torch

import dsfit
from dsfit.bsdf.conventions import Convention
from dsfit.context import Context
from dsfit.kernels import HairKernel
from dsfit.proposals import AmortisedProposal
from tests.kernels import cases

MODES = ["eager", pytest.param("compiled", marks=pytest.mark.skipif(not cases.has_compiler(), reason="no compiler"))]


@functools.cache
def poisson_bsdf(preset: str = "blond") -> dsfit.DualScattering:
    bsdf = copy.copy(cases.bsdf(preset))  # the same tables: none depends on the law
    bsdf.origin = bsdf
    bsdf.convention = Convention.named("consistent", transmittance="poisson")
    return bsdf


@functools.cache
def kernel(mode: str, preset: str = "blond") -> HairKernel:
    found = copy.copy(cases.kernel(preset))
    found.bsdf, found.backend, found._programs = poisson_bsdf(preset), mode, {}
    return found


def contexts(count: int) -> Context:
    """n from 1e-6 to 1e4, and 0."""
    plain = cases.contexts(count)
    n = torch.logspace(-6, 4, count)[torch.randperm(count, generator=torch.Generator().manual_seed(2))]
    n[:3] = 0.0
    return Context(plain.theta_r, 0.0, n, torch.rand(count, generator=torch.Generator().manual_seed(3)))


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("preset", ["blond", pytest.param("black", marks=pytest.mark.slow)])
def test_values_agree_with_the_bsdf(mode: str, preset: str) -> None:
    context = contexts(200)
    theta_i, phi = cases.directions(24, 200)
    served = kernel(mode, preset)
    found = served.eval(served.prepare_context(context), theta_i, phi).double()
    c = context.to(torch.float64)
    angles = (theta_i.double(), c.theta_r, phi.double())
    wanted = poisson_bsdf(preset)(*angles, c.n, c.v)
    error = (found - wanted).abs() / wanted.amax(0)
    assert float(error.max()) < 2e-3 and float(error.median()) < 1e-5
    unlit = Context(context.theta_r, 0.0, context.n, torch.zeros_like(context.n))
    found = served.eval(served.prepare_context(unlit), theta_i, phi).double()
    wanted = poisson_bsdf(preset)(*angles, c.n, 0.0)
    bright = wanted.amax(0) > 1e-30
    error = ((found - wanted).abs() / wanted.amax(0))[:, bright.all(-1)]
    assert float(error.max()) < 2e-3
    power = cases.bsdf(preset)(*angles, c.n, 0.0)
    assert float(((power - wanted).abs() / wanted.amax(0))[:, bright.all(-1)].max()) > 0.1


@pytest.mark.skipif(not cases.has_compiler(), reason="no compiler")
def test_compiled_and_eager_agree() -> None:
    context = contexts(100)
    u = cases.uniforms(5, 100)
    prepared = kernel("eager").prepare_context(context)
    wanted, found = (kernel(mode).sample_eval(prepared, u) for mode in ("eager", "compiled"))
    for a, b in zip(wanted, found, strict=True):
        close = (a - b).abs() <= 1e-4 * a.abs() + 1e-5
        assert float(close.double().mean()) > 0.999
    value = kernel("compiled").eval(prepared, *wanted[:2])
    assert torch.allclose(value, wanted[3], rtol=3e-4, atol=1e-6)


@pytest.mark.slow
def test_a_whole_kernel_and_its_proposal() -> None:
    """Built from the start; the estimate of the kernel's own draws is that of the float64 BSDF."""
    bsdf = dsfit.DualScattering(
        dsfit.Fiber.preset("brown"), precision="table", convention=Convention.named(transmittance="poisson")
    )
    served = HairKernel(bsdf, AmortisedProposal(bsdf, (8,)).requires_grad_(False))
    context = Context(torch.tensor([0.3, -0.9]), 0.0, torch.tensor([2.0, 9.0]), torch.exp(-torch.tensor([2.0, 9.0])))
    *_, pdf, value = served.sample_eval(served.prepare_context(context), cases.uniforms(40_000, 2))
    weight = (value / pdf.unsqueeze(-1)).double()
    error = weight.std(0) / math.sqrt(len(weight))
    exact = dsfit.reference(dsfit.Integrand(bsdf), context.to(torch.float64), rtol=1e-4).value
    assert bool(((weight.mean(0) - exact).abs() < 5 * error + 2e-3 * exact).all())
    size = torch.linalg.vector_norm(weight, dim=-1)
    assert bool((size.std(0) < 0.15 * size.mean(0)).all())  # an untrained proposal that follows the law
