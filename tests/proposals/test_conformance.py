"""What every proposal has to pass: normalisation, samples that follow the density, shapes, gradients, extremes."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor
from torch.func import functional_call, jacfwd, jacrev

from dsfit.context import Context
from dsfit.frame import HALF_PI, to_vector
from dsfit.proposals.base import Proposal
from tests.proposals.cases import DEG, Case, all_cases
from tests.proposals.grid import cell_masses, chi_square, counts

CASES = all_cases()
ANGLES = (0.0, 46 * DEG, 80 * DEG, 89.9 * DEG, -75 * DEG)
CELLS = (24, 16)
SAMPLES = 50_000
# Šidák: every p-value above this keeps the whole family at 1 %.
LEVEL = -math.expm1(math.log1p(-0.01) / (len(CASES) * len(ANGLES)))

every_case = pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)


def contexts(case: Case, theta_r: float | tuple[float, ...], dtype: torch.dtype = torch.float64) -> Context:
    return Context(torch.tensor(theta_r, dtype=dtype), case.phi_r, case.n)


def uniforms(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> Tensor:
    u = torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    eps = torch.finfo(dtype).eps
    return u.to(dtype).clamp(eps, 1 - eps)


@every_case
def test_normalised_and_sampled_as_claimed(case: Case) -> None:
    """Integral over the sphere 1 to 1e-8; chi-square of samples against the cell-integrated density."""
    for k, theta_r in enumerate(ANGLES):
        context = contexts(case, theta_r)
        with torch.no_grad():
            distribution = case.build()(context)
            masses = cell_masses(
                distribution, context, CELLS, case.theta_peaks(theta_r), list(case.phi_peaks), case.phi_breaks
            )
            assert abs(float(masses.sum()) - 1) < 1e-8, theta_r
            omega = distribution.sample(uniforms(SAMPLES, distribution.dimension, seed=k + 1))
            p_value = chi_square(counts(omega, context, CELLS), masses)
        assert p_value > LEVEL, (theta_r, p_value)


@every_case
def test_sample_with_log_prob_is_consistent(case: Case) -> None:
    context = contexts(case, (*ANGLES, 0.3))
    distribution = case.build()(context)
    u = uniforms(500, 6, distribution.dimension)
    omega, log_prob = distribution.sample_with_log_prob(u)
    assert omega.shape == (500, 6, 2) and log_prob.shape == (500, 6)
    assert log_prob.isfinite().all()
    assert bool((omega[..., 0].abs() <= HALF_PI).all()) and bool((omega[..., 1].abs() <= math.pi * (1 + 1e-15)).all())
    torch.testing.assert_close(distribution.sample(u), omega, rtol=0, atol=0)
    torch.testing.assert_close(distribution.log_prob(omega), log_prob, rtol=1e-9, atol=1e-9)


@every_case
def test_batch_equals_loop(case: Case) -> None:
    angles = torch.tensor([[0.0, 1.2, -0.4], [1.57, -1.3, 0.6]], dtype=torch.float64)
    n = torch.tensor([0.0, 2.5, 20.0], dtype=torch.float64)
    context = Context(angles, case.phi_r, n)
    proposal = case.build()
    distribution = proposal(context)
    assert distribution.batch_shape == angles.shape
    u = uniforms(7, 3, 2, 3, distribution.dimension)
    omega, log_prob = distribution.sample_with_log_prob(u)
    assert omega.shape == (7, 3, 2, 3, 2) and log_prob.shape == (7, 3, 2, 3)
    for i in range(2):
        for j in range(3):
            single = proposal(context[i, j])
            one, one_log = single.sample_with_log_prob(u[:, :, i, j])
            torch.testing.assert_close(one, omega[:, :, i, j], rtol=1e-11, atol=1e-11)
            torch.testing.assert_close(one_log, log_prob[:, :, i, j], rtol=1e-9, atol=1e-9)


@every_case
def test_float32(case: Case) -> None:
    """dtype is kept and values agree with float64 where neither rounding of the angles nor a jump decides."""
    narrow, wide = contexts(case, (0.0, 0.8, -1.2), torch.float32), contexts(case, (0.0, 0.8, -1.2))
    proposal = case.build()
    u = uniforms(300, 3, proposal(wide).dimension, dtype=torch.float32)
    omega, log_prob = proposal(narrow).sample_with_log_prob(u)
    assert omega.dtype == torch.float32 and log_prob.dtype == torch.float32
    assert omega.isfinite().all() and log_prob.isfinite().all()
    exact, exact_log = proposal(wide).sample_with_log_prob(u.double())
    close = (to_vector(omega.double()) - to_vector(exact)).norm(dim=-1) < 1e-4
    assert float(close.double().mean()) > 0.99  # u by an edge of a mixture may select its neighbour
    error = (proposal(wide).log_prob(omega.double()) - log_prob.double()).abs()
    assert float(error.detach().quantile(0.99)) < 1e-3
    assert float((log_prob.double() - exact_log)[close].detach().abs().median()) < 1e-3


def _functions(case: Case) -> tuple[Proposal, dict[str, Tensor], Context, Tensor, Tensor]:
    proposal = case.build()
    context = contexts(case, (0.0, 0.7, -1.3))
    dimension = proposal(context).dimension
    omega = torch.stack([(uniforms(40, 3, seed=5) - 0.5) * 2.6, (uniforms(40, 3, seed=6) - 0.5) * 6], dim=-1)
    u = 0.002 + 0.996 * uniforms(40, 3, dimension, seed=7)
    return proposal, {k: v.detach().clone() for k, v in proposal.named_parameters()}, context, omega, u


def _central(function, parameters: dict[str, Tensor], name: str, step: float = 1e-6) -> Tensor:
    """Jacobian `[*out, *parameter]` by central differences."""
    value = parameters[name]
    columns = []
    for k in range(value.numel()):
        shift = torch.zeros(value.numel(), dtype=value.dtype)
        shift[k] = step
        up, down = (function({**parameters, name: value + side * shift.reshape(value.shape)}) for side in (1, -1))
        columns.append((up - down) / (2 * step))
    return torch.stack(columns, dim=-1).reshape(*columns[0].shape, *value.shape)


@every_case
def test_gradients(case: Case) -> None:
    """log_prob and sample in every parameter: forward mode, reverse mode and differences agree."""
    proposal, parameters, context, omega, u = _functions(case)

    def log_prob(values: dict[str, Tensor]) -> Tensor:
        found = functional_call(proposal, values, (context,)).log_prob(omega)
        return torch.where(found.isfinite(), found, 0.0)

    def sample(values: dict[str, Tensor]) -> Tensor:  # as unit vectors, which do not jump at phi = pi
        return to_vector(functional_call(proposal, values, (context,)).sample(u))

    if not parameters:
        assert not proposal.constrained()
        return
    for function, tolerance in ((log_prob, 1e-5), (sample, 1e-6)):
        forward, reverse = jacfwd(function)(parameters), jacrev(function)(parameters)
        for name in parameters:
            torch.testing.assert_close(forward[name], reverse[name], rtol=1e-8, atol=1e-9)
            torch.testing.assert_close(forward[name], _central(function, parameters, name), rtol=tolerance, atol=1e-6)


@every_case
def test_gradient_in_u(case: Case) -> None:
    """Samples are differentiable in the uniforms, but for jumps between components."""
    proposal, _, context, _, u = _functions(case)
    distribution = proposal(context)

    def sample(x: Tensor) -> Tensor:
        return to_vector(distribution.sample(x))

    tracked = u.clone().requires_grad_()
    weight = torch.tensor([1.0, 0.7, -0.4], dtype=torch.float64)
    (gradient,) = torch.autograd.grad((sample(tracked) * weight).sum(), tracked, allow_unused=True)
    gradient = torch.zeros_like(u) if gradient is None else gradient
    step = 1e-7
    for k in range(u.shape[-1]):
        shift = torch.zeros_like(u)
        shift[..., k] = step
        with torch.no_grad():
            slope = ((sample(u + shift) - sample(u - shift)) * weight).sum(dim=-1) / (2 * step)
        smooth = slope.abs() < 1e5
        assert float(smooth.double().mean()) > 0.97
        torch.testing.assert_close(gradient[..., k][smooth], slope[smooth], rtol=1e-4, atol=1e-4)


@every_case
def test_density_is_the_inverse_jacobian_of_the_sampler(case: Case) -> None:
    """Where two uniforms give one direction, `p |d(sin theta, phi) / du| = 1` everywhere: sharper than chi-square."""
    proposal, _, context, _, u = _functions(case)
    distribution = proposal(context)
    if distribution.dimension != 2 or not case.one_to_one:
        pytest.skip("the map from uniforms to directions is not one to one")
    u = u.clone().requires_grad_()
    omega, log_prob = distribution.sample_with_log_prob(u)
    rows = []
    for value in (torch.sin(omega[..., 0]), omega[..., 1]):
        (row,) = torch.autograd.grad(value.sum(), u, retain_graph=True)
        rows.append(row)
    determinant = rows[0][..., 0] * rows[1][..., 1] - rows[0][..., 1] * rows[1][..., 0]
    torch.testing.assert_close(-torch.log(determinant.abs()), log_prob.detach(), rtol=1e-7, atol=1e-7)


@every_case
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["float64", "float32"])
def test_extremes_are_finite(case: Case, dtype: torch.dtype) -> None:
    """Widths from 1e-4 to 10, azimuths from 1e-3 to 50, viewing directions to 89.999 degrees: values and gradients."""
    edge = 89.999 * DEG
    context = Context(torch.tensor([edge, -edge, HALF_PI, 0.0, 1.0], dtype=dtype), case.phi_r, case.n, dtype=dtype)
    u = torch.cat([uniforms(60, 5, 8, dtype=dtype), torch.full((1, 5, 8), torch.finfo(dtype).eps, dtype=dtype)])
    u = torch.cat([u, 1 - u[-1:]])
    grid = torch.cartesian_prod(torch.linspace(-1.57, 1.57, 9), torch.linspace(-3.14, 3.14, 9)).to(dtype)[:, None]
    for build in (case.build, *case.extremes):
        proposal = build()
        distribution = proposal(context)
        omega, log_prob = distribution.sample_with_log_prob(u[..., : distribution.dimension])
        elsewhere = distribution.log_prob(grid.expand(-1, 5, -1))
        assert omega.isfinite().all() and not elsewhere.isnan().any() and not (elsewhere == math.inf).any()
        # In float32 a sample can round out of a jump or to the pole, never to NaN.
        assert not log_prob.isnan().any() and float(log_prob.isfinite().double().mean()) > 0.99
        parameters = list(proposal.parameters())
        if parameters:
            for value in (omega, log_prob, torch.where(elsewhere.isfinite(), elsewhere, 0.0)):
                gradients = torch.autograd.grad(value.sum(), parameters, retain_graph=True, allow_unused=True)
                assert all(g is None or g.isfinite().all() for g in gradients)


@every_case
def test_learnable_values_are_reported(case: Case) -> None:
    """constrained() lists every parameter, inside its bounds."""
    proposal = case.build()
    found = proposal.constrained()
    assert len(found) == len(list(proposal.parameters()))
    for value, low, high in found.values():
        assert bool((value > low).all()) and bool((value < high).all())


@every_case
def test_log_prob_with_jacobian(case: Case) -> None:
    """The Jacobian that fits use is that of log_prob, 0 where the density is 0."""
    proposal, parameters, context, omega, _ = _functions(case)

    def log_prob(values: dict[str, Tensor]) -> Tensor:
        found = functional_call(proposal, values, (context,)).log_prob(omega)
        return torch.where(found.isfinite(), found, 0.0)

    value, jacobian = proposal.log_prob_with_jacobian(context, omega)
    torch.testing.assert_close(value, proposal(context).log_prob(omega).detach(), rtol=1e-12, atol=1e-12)
    assert set(jacobian) == set(parameters)
    expected = jacfwd(log_prob)(parameters) if parameters else {}
    for k in range(3):  # a single context takes another path
        one_value, one = proposal.log_prob_with_jacobian(context[k], omega[:, k])
        torch.testing.assert_close(one_value, value[:, k], rtol=1e-11, atol=1e-11)
        for name in parameters:
            torch.testing.assert_close(one[name], jacobian[name][:, k], rtol=1e-9, atol=1e-11)
            zero = value.isinf()
            torch.testing.assert_close(jacobian[name][~zero], expected[name][~zero], rtol=1e-9, atol=1e-11)
            assert not bool(jacobian[name][zero].any())
