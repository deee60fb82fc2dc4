"""Both laws of how many fibres light meets: closed forms against 60 digits, sums and a Monte Carlo over the number."""

from __future__ import annotations

import functools
import math

import mpmath
import pytest
import torch
from torch import Tensor

import dsfit
from dsfit.bsdf.forward import event_count, log_transmittance, mean_exponential, transmittance

DEPTHS = (0.0, 1e-12, 1e-8, 1e-3, 0.3, 0.4999, 0.5, 1.0, 7.0, 100.0, 1e4)
SHARES = (0.0, 1e-30, 1e-6, 0.1, 0.5, 0.99, 1 - 1e-9, 1.0)


def _exact(a: float, n: float) -> tuple[mpmath.mpf, mpmath.mpf]:
    """tau and the count of events to 60 digits."""
    with mpmath.workdps(60):
        a, n = mpmath.mpf(a), mpmath.mpf(n)
        passed = mpmath.expm1(n * a) / mpmath.expm1(n) if n else a
        return passed, n * a / (1 - mpmath.exp(-n * a)) if n * a else mpmath.mpf(1)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_closed_forms_to_rounding(dtype: torch.dtype) -> None:
    eps = torch.finfo(dtype).eps
    for n in DEPTHS:
        for a in SHARES:
            a_f, count = torch.tensor(a, dtype=dtype), torch.tensor(n, dtype=dtype)
            passed, events = _exact(float(a_f), float(count))
            exponent = 1 + float(count) * (1 - float(a_f))  # its rounding is multiplied by its size
            if passed > torch.finfo(dtype).tiny * 1e10 or a == 0:
                found = float(transmittance(a_f, count, "poisson"))
                assert abs(found - float(passed)) <= 4 * eps * exponent * float(passed), (n, a)
            assert float(event_count(a_f, count, "poisson")) == pytest.approx(float(events), rel=4 * eps), (n, a)
            if a > 0:
                found = float(log_transmittance(torch.log(a_f), count, "poisson"))
                exact = float(mpmath.log(passed))
                assert abs(found - exact) <= 8 * eps * (1 + abs(exact) + abs(math.log(a))), (n, a)


def test_power_is_a_power() -> None:
    a, n = torch.tensor([0.0, 0.3, 1.0], dtype=torch.float64)[:, None], torch.tensor([0.0, 1.0, 2.5]).double()
    assert torch.allclose(transmittance(a, n, "power"), a**n, rtol=1e-15)
    assert torch.allclose(log_transmittance(torch.log(a[1:]), n, "power"), torch.log(a[1:] ** n), atol=1e-15)
    assert torch.equal(event_count(a, n, "power"), n)


def test_limits() -> None:
    a = torch.linspace(0, 1, 11, dtype=torch.float64)
    none = torch.zeros((), dtype=torch.float64)
    assert torch.equal(transmittance(a, none, "poisson"), a)  # what is scattered by next to nothing met one fibre
    assert torch.equal(event_count(a, none, "poisson"), torch.ones_like(a))
    many = torch.tensor(1e4, dtype=torch.float64)
    assert float(transmittance(torch.ones((), dtype=torch.float64), many, "poisson")) == 1.0
    assert float(event_count(a, many, "poisson")[5]) == pytest.approx(5e3, rel=1e-12)
    n = torch.logspace(-3, 3, 50, dtype=torch.float64)[:, None]
    passed = transmittance(a, n, "poisson")
    assert bool((passed.diff(dim=0) <= 1e-15).all()) and bool((passed.diff(dim=1) >= 0).all())
    # E[a^N] >= a^E[N] (Jensen), with E[N | N >= 1] fibres
    assert bool((passed >= a ** (n / -torch.expm1(-n)) * (1 - 1e-12)).all())


@pytest.mark.parametrize(("n", "a"), [(0.2, 0.7), (3.0, 0.9), (12.0, 0.5)])
def test_monte_carlo_over_the_number_of_fibres(n: float, a: float) -> None:
    """Light that meets N >= 1 fibres, is passed on by each, and is turned by each."""
    paths, beta, beta_f = 400_000, 0.13, 0.3
    generator = torch.Generator().manual_seed(3)
    number = torch.poisson(torch.full((paths,), n, dtype=torch.float64), generator=generator)
    number = number[number >= 1]
    assert len(number) / paths == pytest.approx(1 - math.exp(-n), abs=4 * math.sqrt(math.exp(-n) / paths))
    weight = a**number
    depth, share = torch.tensor(n, dtype=torch.float64), torch.tensor(a, dtype=torch.float64)
    error = float(weight.std()) / math.sqrt(len(weight))
    assert abs(float(weight.mean()) - float(transmittance(share, depth, "poisson"))) < 4 * error
    turned = torch.randn(len(number), generator=generator, dtype=torch.float64) * (beta**2 + number * beta_f**2).sqrt()
    variance = float((weight * turned**2).mean() / weight.mean())
    expected = beta**2 + float(event_count(share, depth, "poisson")) * beta_f**2
    spread = (weight * (turned**2 - variance)).std() / weight.mean() / math.sqrt(len(weight))
    assert abs(variance - expected) < 4 * float(spread)
    unweighted = beta**2 + n / -math.expm1(-n) * beta_f**2
    assert n < 1 or abs(variance - unweighted) > 4 * float(spread)  # the test would notice the other count


def test_derivatives() -> None:
    a = torch.tensor([[1e-6], [0.2], [0.7], [0.999]], dtype=torch.float64, requires_grad=True)
    n = torch.tensor([1e-3, 0.4, 0.6, 5.0, 40.0], dtype=torch.float64, requires_grad=True)
    for function in (transmittance, event_count):
        assert torch.autograd.gradcheck(lambda a, n, f=function: f(a, n, "poisson"), (a, n), atol=1e-7)
        assert torch.autograd.gradgradcheck(lambda a, n, f=function: f(a, n, "poisson"), (a, n), atol=1e-6)


def test_derivative_of_the_mean_exponential_to_rounding() -> None:
    x = torch.logspace(-100, 4, 300, dtype=torch.float64).requires_grad_()
    (found,) = torch.autograd.grad(mean_exponential(x).sum(), x)
    with mpmath.workdps(250):
        at = [mpmath.mpf(value) for value in x.tolist()]
        exact = [float((mpmath.exp(-y) * (1 + y) - 1) / y**2) for y in at]
    assert torch.allclose(found, torch.tensor(exact, dtype=torch.float64), rtol=1e-14, atol=0)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_values_and_derivatives_are_finite_everywhere(dtype: torch.dtype) -> None:
    a = torch.tensor([0.0, 1e-30, 1e-3, 0.5, 1.0], dtype=dtype)[:, None].requires_grad_()
    n = torch.tensor([0.0, 1e-30, 1e-12, 0.5, 1.0, 1e4, 1e20], dtype=dtype).requires_grad_()
    for function in (transmittance, event_count):
        value = function(a, n, "poisson")
        gradients = torch.autograd.grad(value.sum(), (a, n))
        assert all(bool(torch.isfinite(x).all()) for x in (value, *gradients))


@functools.cache
def laws() -> tuple[dsfit.DualScattering, dsfit.DualScattering]:
    """The same fibre under both laws."""
    power = dsfit.DualScattering(dsfit.Fiber(sigma_a=(0.3, 0.9)), azimuthal="simplified")
    return power, power.replace(convention=dsfit.Convention.named("consistent", transmittance="poisson"))


def _sum_over_numbers(bsdf: dsfit.DualScattering, n: float, *angles: Tensor) -> Tensor:
    """E[F_scatter after N fibres | N >= 1], each number by the power law."""
    number = torch.arange(1.0, n + 12 * math.sqrt(n) + 15, dtype=torch.float64)
    weight = torch.exp(number * math.log(n) - n - torch.lgamma(number + 1)) / -math.expm1(-n)
    values = [w * bsdf.scatter(*angles, k.expand_as(angles[0])) for w, k in zip(weight, number, strict=True)]
    return torch.stack(values).sum(0)


@pytest.mark.parametrize("n", [0.3, 4.0])
def test_scattered_light_is_the_mean_over_the_number_of_fibres(n: float) -> None:
    power, poisson = laws()
    theta_i = torch.linspace(-1.5, 1.5, 121, dtype=torch.float64)
    theta_r, phi = torch.full_like(theta_i, 0.3), torch.full_like(theta_i, 2.8)
    exact = _sum_over_numbers(power, n, theta_i, theta_r, phi)
    found = poisson.scatter(theta_i, theta_r, phi, torch.full_like(theta_i, n))
    assert torch.allclose(found.sum(0), exact.sum(0), rtol=5e-3)  # energy over inclinations
    assert float(((found - exact).abs().amax(0) / exact.amax(0)).max()) < 0.06  # one Gaussian for a mixture of them
    other = power.scatter(theta_i, theta_r, phi, torch.full_like(theta_i, n))
    assert float((other.sum(0) / exact.sum(0) - 1).abs().min()) > 0.1
    table = poisson.transmittance(theta_i, torch.full_like(theta_i, n))
    assert torch.allclose(table, poisson.d_f * transmittance(poisson.averages(theta_i).a_f, torch.tensor(n), "poisson"))


def test_the_bsdf_is_differentiable_in_n() -> None:
    bsdf = laws()[1]
    n = torch.tensor([0.0, 1e-9, 0.5, 3.0], dtype=torch.float64, requires_grad=True)
    theta_i = torch.tensor([0.2, -1.0, 1.4, math.pi / 2], dtype=torch.float64)

    def value(n: Tensor) -> Tensor:
        return bsdf(theta_i, theta_i * 0 - 0.1, theta_i * 0 + 2.0, n, 0.25)

    (slope,) = torch.autograd.grad(value(n).sum(), n)
    step = 1e-6
    difference = (value(n.detach() + step) - value(n.detach())).sum(-1) / step
    assert torch.allclose(slope, difference, rtol=1e-4, atol=1e-9)
