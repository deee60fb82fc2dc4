"""The peer with Cauchy lobes: unbiased, normalised, its azimuths' closed forms right, biases seen."""

from __future__ import annotations

import math

import pytest
import torch

import dsfit
from dsfit.proposals import ou_azimuth
from dsfit.proposals.ou import OuProposal
from dsfit.proposals.ou_lobes import ContextLobes
from dsfit.quadrature import gauss_legendre
from dsfit.race.peers.cauchy import OuCauchy
from tests.race.peers_support import CONTEXTS, estimates, integrand, is_centred, ready, root_mean_square


@pytest.mark.parametrize("uniforms", ["random", "sobol"])
def test_unbiased_and_a_bias_of_a_few_percent_is_seen(uniforms: str) -> None:
    found = estimates(ready(OuCauchy(), uniforms))
    assert is_centred(found)
    assert not is_centred(1.06 * found)


def test_a_density_that_is_not_what_is_drawn_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    right = ou_azimuth.wrapped_cauchy_log_prob
    monkeypatch.setattr(ou_azimuth, "wrapped_cauchy_log_prob", lambda x, scale: right(x, 1.5 * scale))
    assert not is_centred(estimates(ready(OuCauchy())))


def test_sobol_points_lower_the_error() -> None:
    plain, quasi = (root_mean_square(estimates(ready(OuCauchy(), kind))) for kind in ("random", "sobol"))
    assert bool((quasi < 0.7 * plain).all())


@pytest.mark.parametrize("k", [0, 3])
def test_normalised(k: int) -> None:
    found = dsfit.excess(integrand(), OuProposal(integrand().bsdf), CONTEXTS[k].to(torch.float64), 1e-2)
    assert abs(float(found.mass) - 1) < 1e-3 and float(found.value) < 2


@pytest.mark.parametrize("scale", [0.05, 0.7, 4.0])
def test_window_of_the_wrapped_cauchy_is_the_mass_of_a_half_circle(scale: float) -> None:
    width = torch.tensor(scale, dtype=torch.float64)
    distance = torch.linspace(0, math.pi, 7, dtype=torch.float64)
    x, w = gauss_legendre(400)
    around = distance[:, None] + 0.5 * math.pi * x
    mass = (torch.exp(ou_azimuth.wrapped_cauchy_log_prob(around, width)) * w).sum(-1) * (math.pi / 2)
    window = torch.exp(ou_azimuth.wrapped_cauchy_window(distance, width))
    torch.testing.assert_close(window * math.pi, mass, rtol=1e-8, atol=1e-8)


def test_scale_is_the_best_for_a_gaussian() -> None:
    """int g^2 / c over the line is least at 1 / sqrt 2."""
    x = torch.linspace(-12, 12, 20001, dtype=torch.float64)
    scales = ou_azimuth.SCALE * torch.tensor([0.97, 1.0, 1.03], dtype=torch.float64)[:, None]
    gauss, cauchy = torch.exp(-0.5 * x * x) / math.sqrt(2 * math.pi), scales / (math.pi * (x * x + scales**2))
    moment = torch.trapezoid(gauss**2 / cauchy, x)
    assert int(moment.argmin()) == 1 and abs(float(moment[1]) - math.sqrt(math.pi / 2)) < 1e-4


def test_shares_follow_what_is_lit() -> None:
    shares, _, widths = ContextLobes(integrand().bsdf)(dsfit.Context(0.2, 0.0, [0.0, 5.0, 20.0], [1.0, 0.0, 0.5]))
    shares = torch.exp(shares)
    torch.testing.assert_close(shares.sum(-1), torch.ones(3, dtype=torch.float64))
    assert not bool(shares[0, 3:6].any()) and not bool(shares[1, :3].any())
    assert bool((widths[2, 3:6] > widths[1, 3:6]).all()) and bool((widths[:, 3:6] >= widths[:, :3]).all())


def test_bad_options_are_named() -> None:
    with pytest.raises(dsfit.InputError, match="ou_cauchy.scale"):
        OuCauchy(scale=0.0)
    with pytest.raises(dsfit.InputError, match="ou_cauchy.glint_share"):
        OuCauchy(glint_share=1.0)
    with pytest.raises(dsfit.InputError, match="single fibre"):
        OuProposal(dsfit.DualScattering(dsfit.Fiber(sigma_a=[[0.1], [0.2]])))
