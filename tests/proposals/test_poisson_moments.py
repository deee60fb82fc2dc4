"""Proposals start from lobes of the law of transmittance that their BSDF has."""

from __future__ import annotations

import math

import pytest
import torch

import dsfit
from dsfit.bsdf.conventions import Convention
from dsfit.proposals import lobe_moments
from dsfit.proposals.lobe_moments import LobeMoments
from dsfit.proposals.ou_lobes import ContextLobes
from dsfit.proposals.quick_moments import QuickMoments
from dsfit.proposals.quick_tables import QuickScattering
from dsfit.proposals.structured import _Start

POISSON = Convention.named("consistent", transmittance="poisson")
POWER = dsfit.DualScattering(dsfit.Fiber(sigma_a=(0.5,)), azimuthal="simplified")


def test_moments_are_sums_over_the_number_of_fibres(monkeypatch: pytest.MonkeyPatch) -> None:
    theta_r = torch.tensor(0.4, dtype=torch.float64)
    numbers = torch.arange(1.0, 61.0, dtype=torch.float64)
    monkeypatch.setattr(lobe_moments, "_DEPTHS", tuple(numbers.tolist()))
    direct, single = lobe_moments._row(POWER, theta_r, True)
    energy, mode = single[:, 0].exp(), single[:, 1]
    for n in (0.5, 6.0):
        monkeypatch.setattr(lobe_moments, "_DEPTHS", (n,))
        again, found = lobe_moments._row(POWER.replace(convention=POISSON), theta_r, True)
        weight = torch.exp(numbers * math.log(n) - n - torch.lgamma(numbers + 1)) / -math.expm1(-n)
        total = (weight[:, None] * energy).sum(0)
        error = (found[0, 0] - total.log()).abs()
        assert float(error.max()) < 0.12 and int((error > 0.03).sum()) <= 1  # R's grazing part is the mixture's tail
        assert torch.allclose(again, direct, atol=1e-12)  # direct light meets no fibre
        assert torch.allclose(found[0, 1], (weight[:, None] * energy * mode).sum(0) / total, atol=0.06)


def test_a_structured_proposal_starts_from_the_law() -> None:
    bsdf = POWER.replace(convention=POISSON)
    context = dsfit.Context(torch.tensor([0.4, -1.0], dtype=torch.float64), 0.0, torch.tensor([1.0, 12.0]), 0.0)
    start = _Start(bsdf, context)
    n = context.n[:, None].expand(start.theta_i.shape)
    assert torch.allclose(start.passed, bsdf._transmittance(start.average, n), rtol=1e-12)
    assert torch.allclose(start.variance_f, bsdf._variance_f(start.average, n, n), rtol=1e-12)
    assert float((start.variance_f / start.average.beta_f**2 - context.n[:, None, None]).abs().max()) > 5


def test_energies_of_context_lobes_follow_the_law() -> None:
    theta = torch.tensor([0.0], dtype=torch.float64)
    a_f = POWER.averages(theta).a_f[0, 0]
    for n in (1.0, 30.0):
        context = dsfit.Context(theta, 0.0, n, 0.5)
        log_shares = (ContextLobes(POWER.replace(convention=c))(context)[0][0] for c in ("consistent", POISSON))
        power, poisson = (x[4] - x[1] for x in log_shares)  # TT scattered against TT
        tau = torch.expm1(n * a_f) / math.expm1(n)
        assert float(poisson - power) == pytest.approx(float(tau.log() - n * a_f.log()), rel=1e-4)


@pytest.mark.slow
def test_quick_moments_are_those_of_the_exact_tables() -> None:
    bsdf = dsfit.DualScattering(dsfit.Fiber.preset("brown"), convention=POISSON)
    exact, quick = LobeMoments(bsdf), QuickMoments(QuickScattering(bsdf))
    theta_r = torch.linspace(-1.2, 1.2, 25, dtype=torch.float64)
    for depth in (0.0, 1.0, 8.0, 40.0):
        for a, b in zip(exact(theta_r, theta_r * 0 + depth), quick(theta_r, theta_r * 0 + depth), strict=True):
            assert float((a[:, 0] - b[:, 0]).abs().max()) < 0.1  # log energies
