"""A user's function as an integrand: known integrals, what is refused, and that unnamed peaks are the user's risk."""

from __future__ import annotations

import math

import pytest
import torch

import dsfit
from dsfit.proposals import UniformSphere


def power(omega: torch.Tensor, context: dsfit.Context) -> torch.Tensor:
    """cos^3(theta_i) (1 + cos(phi) / 2): integral 2 pi * 3 pi / 8."""
    theta_i, phi_i = omega.unbind(-1)
    return (torch.cos(theta_i) ** 3 * (1 + 0.5 * torch.cos(context.phi_r - phi_i)))[..., None]


@pytest.mark.parametrize("is_even", [True, False])
def test_a_known_integral_and_its_excess(is_even: bool) -> None:
    integrand = dsfit.FunctionIntegrand(power, is_even=is_even)
    context = dsfit.Context(theta_r=torch.tensor([0.0, 0.7]), phi_r=torch.tensor([0.0, 2.5]))
    found = dsfit.reference(integrand, context, 1e-9)
    expected = 0.75 * math.pi**2
    assert found.converged
    torch.testing.assert_close(found.value, torch.full((2, 1), expected, dtype=torch.float64), rtol=1e-9, atol=0)
    # int f^2 domega = (1 + 1/8) 2 pi int cos^7 dtheta = (9/8) 2 pi 32/35
    moment = 4 * math.pi * (9 / 8) * 2 * math.pi * 32 / 35
    excess = dsfit.excess(integrand, UniformSphere(), context)
    torch.testing.assert_close(
        excess.value, torch.full((2,), moment / expected**2 - 1, dtype=torch.float64), rtol=1e-6, atol=0
    )


def test_named_peaks_are_found_wherever_they_are() -> None:
    width = 1e-4

    def peak(omega: torch.Tensor, context: dsfit.Context) -> torch.Tensor:
        theta_i, phi_i = omega.unbind(-1)
        at = ((theta_i - 0.3217) / width) ** 2 + ((context.phi_r - phi_i - 1.234) / width) ** 2
        return torch.exp(-at / 2)[..., None]

    integrand = dsfit.FunctionIntegrand(peak, inclinations=[0.3217], azimuths=[1.234])
    found = dsfit.reference(integrand, dsfit.Context(theta_r=0.1), 1e-6)
    assert float(found.value) == pytest.approx(2 * math.pi * width**2 * math.cos(0.3217), rel=1e-6)


def test_estimates_agree_with_the_reference() -> None:
    integrand = dsfit.FunctionIntegrand(power, is_even=True)
    context = dsfit.Context(theta_r=0.2)
    found = dsfit.estimate(integrand, UniformSphere(), context, 4096, generator=torch.Generator().manual_seed(3))
    assert abs(float(found.value) - 0.75 * math.pi**2) < 4 * float(found.standard_error) < 0.4


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"channels": 0}, "channels"),
        ({"channels": True}, "channels"),
        ({"inclinations": [2.0]}, "inclinations"),
        ({"azimuths": [math.nan]}, "azimuths"),
    ],
)
def test_what_is_refused(changes: dict, named: str) -> None:
    with pytest.raises(dsfit.InputError, match=named):
        dsfit.FunctionIntegrand(power, **changes)


@pytest.mark.parametrize("wrong", [lambda omega, context: omega[..., 0], lambda omega, context: 1.0])
def test_a_result_of_another_shape_is_refused(wrong) -> None:
    with pytest.raises(dsfit.InputError, match="result"):
        dsfit.reference(dsfit.FunctionIntegrand(wrong), dsfit.Context(theta_r=0.2))
