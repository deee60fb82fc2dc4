"""Truncated Gaussians fitted to a_f(theta)^n."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest
import torch

from dsfit.errors import InputError
from dsfit.fit.transmittance import CENTRES, WIDTHS, fit_transmittance
from dsfit.frame import HALF_PI
from dsfit.proposals import TransmittanceGaussian
from dsfit.quadrature import panel_points
from dsfit.special import truncated_normal_log_prob

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


def test_cosines_count_like_attenuation():
    """a_f = cos once per fibre is the same target as one more cosine of the measure."""
    measured = fit_transmittance(Fake(torch.cos), [0, 1], cosines=1.0)
    plain = fit_transmittance(Fake(torch.cos), [1, 2])
    for one, other in zip(measured, plain, strict=True):
        assert one.std == pytest.approx(other.std, rel=1e-12) and one.width == pytest.approx(other.width, rel=1e-6)
        assert one.excess_cosine == pytest.approx(other.excess_cosine, abs=1e-12)


def test_no_fibres_is_uniform_and_large_n_does_not_underflow():
    rows = fit_transmittance(Fake(lambda t: 0.7 * torch.cos(t) ** 0.25), [0, 1e5])
    assert rows[0].std == pytest.approx(math.pi / math.sqrt(12), rel=1e-9) and rows[0].excess < 1e-6
    assert rows[1].width == pytest.approx(2 / math.sqrt(1e5), rel=1e-2) and math.isfinite(rows[1].excess_cosine)


def test_bad_input():
    with pytest.raises(InputError, match="n_values"):
        fit_transmittance(Fake(torch.cos), [1, -1])
    with pytest.raises(InputError, match="cosines"):
        fit_transmittance(Fake(torch.cos), [1], cosines=-1.0)
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


def valley(theta):
    """Least near the normal plane and rising towards both ends, as a_f of black hair."""
    return 0.04 + 0.07 * torch.sin(theta - 0.1) ** 2 * torch.where(theta < 0, 1.0, 0.6)


def test_attenuation_without_a_hill_stays_within_bounds():
    rows = fit_transmittance(Fake(valley), [0.5, 2, 5, 20, 100])
    for row in rows:
        assert row.converged and all(math.isfinite(x) for x in (row.excess, row.excess_centred, row.centre, row.width))
        assert CENTRES[0] <= row.centre <= CENTRES[1] and WIDTHS[0] <= row.width <= WIDTHS[1]
        assert row.excess <= row.excess_centred * (1 + 1e-6) and row.excess < row.excess_cosine
        # It can be handed to the law whose parameters these are.
        TransmittanceGaussian(row.width, row.centre, variable="in")
    # No Gaussian about 0 rises towards the ends: the widest is the best.
    assert "width_centred" in rows[2].at_bounds and rows[2].width_centred == pytest.approx(WIDTHS[1], rel=1e-2)
    assert "centre" in rows[1].at_bounds


def test_fit_is_the_best_of_a_fine_grid():
    (row,) = fit_transmittance(Fake(valley), [20])
    edge = torch.tensor(HALF_PI, dtype=torch.float64)
    theta, weight = (x.reshape(-1) for x in panel_points(torch.linspace(-HALF_PI, HALF_PI, 41).double(), 16))
    best = valley(theta) ** 20
    best = best / (weight * best).sum()
    widths = torch.logspace(-2, 1, 200, dtype=torch.float64)
    for centre in torch.linspace(*CENTRES, 60, dtype=torch.float64):
        log_p = truncated_normal_log_prob(theta, centre, widths[:, None], -edge, edge)
        excess = (weight * best**2 * torch.exp(-log_p)).sum(-1) - 1
        assert row.excess <= float(excess.min()) + 1e-6


@pytest.mark.slow
def test_black_hair():
    from dsfit.bsdf.dual_scattering import DualScattering
    from dsfit.bsdf.fiber import Fiber

    for row in fit_transmittance(DualScattering(Fiber.preset("black")), [1, 5, 20, 50]):
        assert row.converged and row.excess < row.excess_centred < row.excess_cosine and row.excess < 3.5
        assert row.at_bounds == ("centre", "width_centred")
