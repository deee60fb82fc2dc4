"""Box-Muller with redraw has the law of the inverse CDF, everywhere, and stops."""

from __future__ import annotations

import math

import pytest
import torch
from scipy import stats

from dsfit.context import Context
from dsfit.errors import InputError
from dsfit.proposals import BoxMullerLobe, GaussianLobe
from dsfit.proposals.gaussian_lobe import truncated_box_muller
from dsfit.special import log_normal_mass
from tests.proposals.cases import DEG


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(11)


def cdf(x: torch.Tensor, mean: float, std: float, low: float, high: float) -> torch.Tensor:
    a, b = torch.tensor((low - mean) / std).double(), torch.tensor((high - mean) / std).double()
    return torch.exp(log_normal_mass(a, (x - mean) / std) - log_normal_mass(a, b))


@pytest.mark.parametrize("theta_r", [0.0, 80 * DEG, 89.9 * DEG, -89.9 * DEG])
@pytest.mark.parametrize("max_tries", [1, 64])
def test_same_law(theta_r: float, max_tries: int) -> None:
    """Kolmogorov-Smirnov against the exact CDF; one try only leaves most of the work to the inverse CDF."""
    alpha, beta = -7.5 * DEG, 7.5 * DEG
    law = BoxMullerLobe(alpha, beta)(Context(theta_r, dtype=torch.float64))
    theta_i = law.draw((20_000,), generator(), max_tries)
    assert bool((theta_i.abs() <= math.pi / 2).all())
    low, high = theta_r / 2 - math.pi / 4, theta_r / 2 + math.pi / 4
    u = cdf((theta_i + theta_r) / 2, alpha, beta, low, high)
    assert stats.kstest(u.clamp(0, 1).numpy(), "uniform").pvalue > 1e-3


def test_density_is_shared() -> None:
    context, theta = Context([0.2, 1.4]), torch.tensor([[-0.3], [0.8]], dtype=torch.float64)
    got, expected = (kind(0.1, 0.2)(context).log_prob(theta) for kind in (BoxMullerLobe, GaussianLobe))
    assert torch.equal(got, expected)


def test_batch_with_hopeless_windows_and_reproducibility() -> None:
    """A window 1e4 standard deviations away never accepts a normal number: the inverse CDF answers at once."""
    mean = torch.tensor([0.0, 0.0, 0.0], dtype=torch.float64)
    std = torch.tensor([1e-4, 0.1, 0.3], dtype=torch.float64)
    low, high = mean + torch.tensor([1.0, 0.2, -0.1]).double(), mean + 1.5
    x = truncated_box_muller((1000,), mean, std, low, high, generator=generator())
    assert x.shape == (1000, 3) and bool(((x >= low) & (x <= high)).all())
    assert torch.equal(x, truncated_box_muller((1000,), mean, std, low, high, generator=generator()))
    single = truncated_box_muller((7,), mean.float(), std.float(), low.float(), high.float(), generator=generator())
    assert single.dtype == torch.float32
    with pytest.raises(InputError, match="max_tries"):
        truncated_box_muller((1,), mean, std, low, high, generator=generator(), max_tries=0)
