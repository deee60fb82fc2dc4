"""The exact-offset azimuths: their densities are N_p with A = 1, and their samples follow them, caustic and all."""

from __future__ import annotations

import math

import pytest
import torch
from scipy import stats

import dsfit
from dsfit.proposals import CosineHalf, OffsetAzimuth
from dsfit.quadrature import gauss_legendre


@pytest.mark.parametrize("theta_i", [0.0, -1.2, 1.4])
@pytest.mark.parametrize("lobe", ["R", "TT", "TRT"])
def test_samples_follow_the_density(lobe: str, theta_i: float) -> None:
    """Uniformity of the CDF at the samples, the CDF by fine quadrature that follows the edges of the support."""
    law = OffsetAzimuth(lobe, 1.55)(dsfit.Context(0.3))
    theta = torch.tensor(theta_i, dtype=torch.float64)
    u = torch.rand(4000, 1, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    phi = torch.sort(law.sample(u, theta).abs()).values
    from dsfit.bsdf.azimuthal import support_edges

    edges = support_edges(dsfit.Fiber(eta=1.55), (0.3 - theta) / 2)
    ends = torch.sort(torch.cat([phi, edges, torch.tensor([0.0, math.pi], dtype=torch.float64)])).values
    x, w = gauss_legendre(24)
    width = (ends[1:] - ends[:-1])[:, None]
    s = (1 + x) / 2  # sin^2 map: the density may have a square-root pole at either end
    nodes = ends[:-1, None] + width * torch.sin(math.pi / 2 * s) ** 2
    mass = (torch.exp(law.log_prob(nodes, theta)) * width * (math.pi / 2) * torch.sin(math.pi * s) * w / 2).sum(1)
    cumulative = 2 * torch.cat([torch.zeros(1, dtype=torch.float64), mass.cumsum(0)])
    assert abs(float(cumulative[-1]) - 1) < 1e-6
    at = cumulative[torch.searchsorted(ends, phi)]
    assert stats.kstest(at.numpy(), "uniform").pvalue > 0.01 / 9


def test_r_is_the_cosine_law() -> None:
    context, theta = dsfit.Context(0.3), torch.tensor(0.2, dtype=torch.float64)
    phi = torch.linspace(-3, 3, 50, dtype=torch.float64)
    found = OffsetAzimuth("R", 1.55)(context).log_prob(phi, theta)
    torch.testing.assert_close(found, CosineHalf()(context).log_prob(phi, theta))


@pytest.mark.parametrize("k", [1, 2])
def test_density_is_the_raw_lobe_without_attenuation(k: int) -> None:
    """N_p / A at the one root: N_TT and N_TRT differ from the density by the factor A in (0, 1]."""
    law = OffsetAzimuth(("R", "TT", "TRT")[k], 1.55)(dsfit.Context(0.3))
    bsdf = dsfit.DualScattering(dsfit.Fiber.preset("nonabsorbing"), azimuthal="raw")
    theta = torch.tensor(-0.5, dtype=torch.float64)
    phi = torch.linspace(0.01, 3.1, 40, dtype=torch.float64)
    density = torch.exp(law.log_prob(phi, theta))
    lobe = bsdf.azimuthal((0.3 - theta) / 2, phi)[:, k, 0]
    assert torch.equal(density > 0, lobe > 0)
    lit = density > 0
    assert bool((lobe[lit] / density[lit] <= 1).all()) and bool((lobe[lit] / density[lit] > 0).all())


def test_bad_input_is_named() -> None:
    with pytest.raises(dsfit.InputError, match="lobe"):
        OffsetAzimuth("TRRT", 1.55)
    with pytest.raises(dsfit.InputError, match="eta"):
        OffsetAzimuth("TT", 1.0)
