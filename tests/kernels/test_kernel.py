"""What kernels take and refuse, what terms leave out, extremes, and adapters."""

from __future__ import annotations

import copy
import math

import pytest
import torch

import dsfit
from dsfit.bsdf.terms import TERMS, Terms
from dsfit.context import Context
from dsfit.errors import InputError
from dsfit.kernels import HairKernel
from dsfit.scene.lights import ConstantLight
from tests.kernels import cases

MODES = ["eager", pytest.param("compiled", marks=pytest.mark.skipif(not cases.has_compiler(), reason="no compiler"))]


def with_terms(terms: Terms) -> HairKernel:
    """The shared kernel with other terms and the same tables."""
    kernel = copy.copy(cases.kernel())
    kernel.halves = {"direct": terms.direct, "scattered": terms.scattered}
    kernel._programs = {}
    return kernel


@pytest.mark.parametrize("mode", MODES)
def test_extremes_are_finite(mode: str) -> None:
    half = torch.tensor(math.pi / 2)
    theta_r = torch.tensor([-half, -1.55, 0.0, 1.55, half]).repeat(9)
    n = torch.tensor([0.0, 3.0, 1e4]).repeat_interleave(5).repeat(3)
    v = torch.tensor([0.0, 0.5, 1.0]).repeat_interleave(15)
    kernel = cases.kernel(mode=mode)
    contexts = kernel.prepare(theta_r, n, v)
    corners = torch.tensor([0.0, 1e-7, 0.5, 1 - 6e-8, 1.0])
    u = torch.cartesian_prod(corners, corners, corners)[:, None].expand(-1, 45, -1).contiguous()
    theta_i, phi, pdf, value = kernel.sample_eval(contexts, u)
    for x in (theta_i, phi, pdf, value):
        assert bool(torch.isfinite(x).all())
    assert bool((theta_i.abs() <= half).all()) and bool((phi.abs() <= math.pi + 1e-6).all())
    assert bool((pdf > 0).all()) and bool((value >= 0).all())
    angles = torch.cartesian_prod(torch.stack([-half, -half / 3, half]), torch.tensor([-9.0, 0.0, math.pi, 3.2]))
    theta_i, phi = (x[:, None].expand(-1, 45).contiguous() for x in angles.unbind(-1))
    assert bool(torch.isfinite(kernel.eval(contexts, theta_i, phi)).all())
    assert bool(torch.isfinite(kernel.log_prob(contexts, theta_i, phi)).all())


def test_angles_are_periodic() -> None:
    kernel, context = cases.kernel(), cases.contexts(20)
    contexts, (theta_i, phi) = kernel.prepare_context(context), cases.directions(4, 20)
    turned = kernel.eval(contexts, theta_i, phi + 2 * math.pi)
    assert torch.allclose(turned, kernel.eval(contexts, theta_i, phi), rtol=1e-3, atol=1e-5)


def test_terms_leave_out_exactly_what_they_say() -> None:
    context = cases.contexts(60, v=0.4)
    theta_i, phi = cases.directions(8, 60)
    whole = cases.kernel().eval(cases.kernel().prepare_context(context), theta_i, phi)
    total = torch.zeros_like(whole)
    for name in TERMS:
        for terms in (Terms((name,), ()), Terms((), (name,))):
            kernel = with_terms(terms)
            value = kernel.eval(kernel.prepare_context(context), theta_i, phi)
            c = context.to(torch.float64)
            wanted = cases.bsdf().replace(terms=terms)(theta_i.double(), c.theta_r, phi.double(), c.n, c.v)
            assert torch.allclose(value.double(), wanted, rtol=2e-3, atol=2e-3 * float(wanted.max()))
            total = total + value
    assert torch.allclose(total, whole, rtol=1e-5, atol=1e-7)


@pytest.mark.slow
def test_grey_terms_compute_one_channel() -> None:
    bsdf = dsfit.DualScattering(dsfit.Fiber(sigma_a=(0.2, 0.2, 0.2)), precision="table")
    kernel = HairKernel(bsdf, cases.mixture(), terms=Terms(grey=True), mode="eager")
    context, (theta_i, phi) = cases.contexts(10), cases.directions(3, 10)
    value = kernel.eval(kernel.prepare_context(context), theta_i, phi)
    assert value.shape == (3, 10, 3) and kernel.computed_channels == 1
    assert value.stride(-1) == 0
    c = context.to(torch.float64)
    wanted = bsdf(theta_i.double(), c.theta_r, phi.double(), c.n, c.v)
    assert torch.allclose(value.double(), wanted, rtol=2e-3, atol=1e-3 * float(wanted.max()))


def test_contexts_are_served_by_the_half_they_need() -> None:
    kernel = cases.kernel()
    assert [kernel.prepare(torch.zeros(2), 1.0, v).need for v in (1.0, 0.0, 0.5)] == ["direct", "scattered", "both"]
    context = cases.contexts(30, v=1.0)
    theta_i, phi = cases.directions(4, 30)
    short = kernel.prepare_context(context)
    joined = Context(*(torch.cat([getattr(context, k), torch.tensor([x])]) for k, x in _EXTRA))
    long = kernel.prepare_context(joined)[:30]
    assert short.need == "direct" and long.need == "both"
    assert torch.allclose(kernel.eval(short, theta_i, phi), kernel.eval(long, theta_i, phi), rtol=1e-5, atol=1e-7)
    assert torch.allclose(kernel.log_prob(short, theta_i, phi), kernel.log_prob(long, theta_i, phi), atol=1e-5)


_EXTRA = (("theta_r", 0.3), ("phi_r", 0.0), ("n", 2.0), ("v", 0.5))


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"fiber": dsfit.Fiber.preset("blond", eccentricity=0.9)}, "eccentricity"),
        ({"fiber": dsfit.Fiber(sigma_a=torch.rand(2, 3))}, "fiber"),
        ({"azimuthal": "raw"}, "azimuthal"),
        ({"convention": "printed"}, "convention"),
    ],
)
def test_what_tables_do_not_serve_is_refused(changes: dict, field: str) -> None:
    arguments = {"fiber": dsfit.Fiber.preset("blond"), **changes}
    with pytest.raises(InputError, match=field):
        HairKernel(dsfit.DualScattering(**arguments), mode="eager")


def test_other_bad_input_is_refused() -> None:
    kernel, bsdf = cases.kernel(), cases.bsdf()
    contexts = kernel.prepare(torch.zeros(4))
    with pytest.raises(InputError, match="mode"):
        HairKernel(bsdf, mode="fast")
    with pytest.raises(InputError, match="proposal"):
        HairKernel(bsdf, dsfit.StructuredProposal(bsdf, Context(0.1)), mode="eager")
    with pytest.raises(InputError, match="glint"):
        HairKernel(bsdf, cases.mixture(), terms=Terms(glint=False), mode="eager")
    with pytest.raises(InputError, match="float32"):
        kernel.sample(contexts, torch.rand(2, 4, 3, dtype=torch.float64))
    for shape in ((2, 5), (4,), (0, 4)):
        with pytest.raises(InputError, match="directions"):
            kernel.eval(contexts, torch.zeros(shape), torch.zeros(shape))
    with pytest.raises(InputError, match="theta_r"):
        kernel.prepare(torch.tensor([2.0]))


def test_adapters_stand_for_integrand_and_proposal() -> None:
    kernel = cases.kernel()
    context = Context(torch.tensor([[0.2, -0.5]]), 0.7, 2.0, 0.3).to(torch.float64)
    distribution = kernel.proposal()(context)
    u = cases.uniforms(6, 1, 2).double()
    omega, log_prob = distribution.sample_with_log_prob(u)
    assert omega.shape == (6, 1, 2, 2) and omega.dtype == torch.float64
    reference = cases.mixture()(context).log_prob(omega)
    assert torch.allclose(log_prob, reference, atol=1e-4)
    value, wanted = kernel.integrand()(omega, context), dsfit.Integrand(cases.bsdf())(omega, context)
    assert value.shape == wanted.shape and torch.allclose(value, wanted, rtol=2e-3, atol=1e-3)
    assert torch.allclose(kernel.integrand(ConstantLight(2.0))(omega, context), 2 * value)
    generator = torch.Generator().manual_seed(1)
    estimate = dsfit.estimate(kernel.integrand(), kernel.proposal(), context, 256, generator=generator)
    assert bool(torch.isfinite(torch.as_tensor(estimate.value)).all())
