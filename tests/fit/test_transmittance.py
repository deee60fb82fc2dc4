"""Truncated Gaussians fitted to a_f(theta)^n."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest
import torch

from dsfit.errors import InputError
from dsfit.fit.transmittance import fit_transmittance

pytest.importorskip("jax")
DEG = math.pi / 180


class Fake:
    def __init__(self, a_f):
        self.a_f = a_f

    def averages(self, theta):
        return SimpleNamespace(a_f=self.a_f(theta)[..., None].expand(*theta.shape, 3))


def test_gaussian_attenuation_is_found_exactly():
    centre, width = 0.1, 1.0
    rows = fit_transmittance(Fake(lambda t: 0.8 * torch.exp(-((t - centre) ** 2) / (2 * width**2))), [1, 4, 25, 400])
    for row in rows:
        assert row.converged
        assert row.centre == pytest.approx(centre, abs=1e-5)
        assert row.width == pytest.approx(width / math.sqrt(row.n), rel=1e-4)
        assert row.excess < 1e-8
        # With its centre at 0 the best width is wider and the excess larger.
        assert row.width_centred > row.width and row.excess_centred > 10 * row.excess
    assert [row.excess_centred for row in rows] == sorted(row.excess_centred for row in rows)


def test_cosine_attenuation_makes_the_cosine_law_exact_at_one():
    rows = fit_transmittance(Fake(torch.cos), [1, 2])
    assert rows[0].excess_cosine == pytest.approx(0.0, abs=1e-12) and rows[0].excess > 1e-3
    assert rows[0].std == pytest.approx(math.sqrt(math.pi**2 / 4 - 2), rel=1e-9)  # 39.2 degrees
    # cos^2 against cos / 2: int (2 cos^2 / pi)^2 / (cos / 2) - 1 = (8 / pi^2) int cos^3 - 1 = 32 / (3 pi^2) - 1
    assert rows[1].excess_cosine == pytest.approx(32 / (3 * math.pi**2) - 1, rel=1e-9)


def test_no_fibres_is_uniform_and_large_n_does_not_underflow():
    rows = fit_transmittance(Fake(lambda t: 0.7 * torch.cos(t) ** 0.25), [0, 1e5])
    assert rows[0].std == pytest.approx(math.pi / math.sqrt(12), rel=1e-9) and rows[0].excess < 1e-6
    assert rows[1].width == pytest.approx(2 / math.sqrt(1e5), rel=1e-2) and math.isfinite(rows[1].excess_cosine)


def test_bad_input():
    with pytest.raises(InputError, match="n_values"):
        fit_transmittance(Fake(torch.cos), [1, -1])
    with pytest.raises(InputError, match="a_f"):
        fit_transmittance(Fake(lambda t: 0 * t), [1])
    with pytest.raises(InputError, match="a_f"):
        fit_transmittance(Fake(lambda t: -torch.cos(t)), [1])


@pytest.mark.parametrize(
    "sigma, table",
    [
        # FORMULAS section D, mean and std in degrees; n = 1 there is off by 0.3 at most (its grid was coarser).
        (0.0, {5: (5.0, 32.5), 10: (5.7, 27.3), 20: (6.2, 22.1), 50: (6.6, 15.8)}),
        (0.432, {5: (5.6, 30.2), 10: (6.5, 23.5), 20: (6.7, 17.5), 50: (6.5, 11.4)}),
    ],
)
def test_real_fibres(sigma, table):
    from dsfit.bsdf.dual_scattering import DualScattering
    from dsfit.bsdf.fiber import Fiber

    bsdf = DualScattering(Fiber.preset("nonabsorbing", sigma_a=[sigma]))
    rows = fit_transmittance(bsdf, [1, *table])
    for row in rows[1:]:
        mean, std = table[int(row.n)]
        assert (row.mean / DEG, row.std / DEG) == (pytest.approx(mean, abs=0.06), pytest.approx(std, abs=0.06))
        assert row.converged and row.excess < 0.05 and row.excess < row.excess_centred < row.excess_cosine
        assert row.centre == pytest.approx(row.mean, abs=1.5 * DEG)
    assert [row.width for row in rows] == sorted((row.width for row in rows), reverse=True)
