"""Averages in float32, at grazing and where they underflow; derivatives in shares that are 0 or 1."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from torch import Tensor

import dsfit

DEG = math.pi / 180
EDGE = 89.999 * DEG


def _angles(dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor, Tensor]:
    return tuple(torch.tensor(x, dtype=dtype) for x in ([-0.3, 0.5], [0.4, -0.6], [-2.8, 1.0]))  # type: ignore[return-value]


@pytest.fixture(scope="module")
def blond() -> dsfit.DualScattering:
    return dsfit.DualScattering(dsfit.Fiber.preset("blond"))


@pytest.mark.parametrize("share", [0.0, 1.0, 0.4])
def test_derivative_in_the_lit_share(blond: dsfit.DualScattering, share: float) -> None:
    """dF/dv = (F_direct - F_scatter) cos(theta_i), also where one of them is multiplied by 0 throughout."""
    angles = _angles()
    cosine = torch.cos(angles[0]).unsqueeze(-1)
    expected = ((blond.direct(*angles) - blond.scatter(*angles, 3.0)) * cosine).sum(-1)
    v = torch.full((2,), share, dtype=torch.float64, requires_grad=True)
    (found,) = torch.autograd.grad(blond(*angles, 3.0, v).sum(), v)
    torch.testing.assert_close(found, expected)
    along = torch.func.jvp(lambda x: blond(*angles, 3.0, x).sum(-1), (v.detach(),), (torch.ones(2).double(),))[1]
    torch.testing.assert_close(along, expected)


def test_derivative_in_a_back_scattering_of_zero(blond: dsfit.DualScattering) -> None:
    """dF_direct/dd_b = f_back + d_b ... at d_b = 0, by a difference."""
    angles = _angles()
    d_b = torch.zeros((), dtype=torch.float64, requires_grad=True)
    (found,) = torch.autograd.grad(blond.replace(d_b=d_b).direct(*angles).sum(), d_b)
    step = 1e-6
    numeric = (blond.replace(d_b=step).direct(*angles) - blond.replace(d_b=0.0).direct(*angles)).sum() / step
    torch.testing.assert_close(found, numeric, rtol=1e-5, atol=0)


@pytest.mark.parametrize("eta", [1.0078125, 1.5])
def test_averages_of_float32_are_those_of_float64_rounded(eta: float) -> None:
    """The fibre and the inclinations are exact in float32; near grazing and for a_f near 1 that takes care."""
    fiber = dsfit.Fiber(sigma_a=[0.0], eta=eta, alpha=[-0.0078125] * 3, beta=[0.015625] * 3)
    bsdf = dsfit.DualScattering(fiber)
    theta = torch.tensor([EDGE, -EDGE, 0.1, -0.7], dtype=torch.float32)
    single, double = bsdf.averages(theta), bsdf.averages(theta.double())
    for field in dataclasses.fields(dsfit.Averages):
        found, expected = getattr(single, field.name), getattr(double, field.name)
        assert found.dtype == torch.float32
        torch.testing.assert_close(found.double(), expected, rtol=1e-7, atol=1e-30, msg=field.name)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_averages_that_underflow_leave_no_nan(dtype: torch.dtype) -> None:
    """Narrow lobes that leave the reachable inclinations: every share is 0, and F is 0, with zero derivatives."""
    fiber = dsfit.Fiber(sigma_a=[1e4], eta=3.0, alpha=[-0.125, 0.0625, 0.1875], beta=[1e-4] * 3)
    bsdf = dsfit.DualScattering(fiber)
    leaves = [torch.tensor([x], dtype=dtype, requires_grad=True) for x in (EDGE, -89.99 * DEG, -2.9)]
    average = bsdf.averages(leaves[0].detach())
    assert float(average.a_f) == 0 and float(average.beta_f) > 0 and float(average.sigma_b) > 0
    value = bsdf(*leaves, 0.3, 0.3)
    assert float(value.detach()) == 0
    for slope in torch.autograd.grad(value.sum(), leaves):
        assert float(slope) == 0


@pytest.mark.parametrize("theta", [EDGE, -EDGE, 89.9 * DEG])
def test_averages_at_grazing_against_a_fine_sum(theta: float) -> None:
    """a_f + a_b = int c_M M cos cos / cos^2 E dtheta_o, with a fine sum in log distance from the far end."""
    fiber = dsfit.Fiber(sigma_a=[0.125], eta=1.5, alpha=[-0.125, 0.0625, 0.1875], beta=[0.125, 0.0625, 0.25])
    bsdf = dsfit.DualScattering(fiber)
    inclination = torch.tensor([theta], dtype=torch.float64)
    average = bsdf.averages(inclination)
    s = torch.linspace(math.log(1e-14), math.log(math.pi), 100_001, dtype=torch.float64)
    distance = torch.exp(s)  # from theta_o = -+pi/2, opposite to theta_in
    side = math.copysign(1.0, theta)
    half = (math.pi / 2 - abs(theta)) / 2  # of theta_in from grazing
    theta_h = -side * (half - distance / 2)
    lobes = torch.exp(-0.5 * ((theta_h[:, None] - fiber.alpha) / fiber.beta) ** 2) / fiber.beta / math.sqrt(2 * math.pi)
    cos_diff = torch.sin(half + distance / 2)
    shares = bsdf._cached_shares._energies
    inside = math.pi / 2 - (half + distance / 2)
    energy = torch.stack([table(inside).sum(-1) for table in shares], dim=-1)
    kernel = 0.5 * (lobes * energy).sum(-1) * torch.sin(distance) * math.cos(theta) / cos_diff**2 * distance
    total = torch.trapezoid(kernel, s)
    torch.testing.assert_close((average.a_f + average.a_b)[0, 0], total, rtol=2e-11, atol=0)
