"""Running moments and the tests of equal means, against numpy and scipy."""

from __future__ import annotations

import pytest
import torch
from scipy import stats

from dsfit.mis.moments import Moments
from dsfit.mis.statistics import f_tail, homogeneity_p_value, smallest, t_p_value


@pytest.mark.parametrize("full", [False, True])
def test_pieces_agree_with_the_whole_far_from_zero(full: bool) -> None:
    """Mean 1e8, spread 1: sum of squares minus square of sum would lose all digits."""
    y = 1e8 + torch.randn(1000, 3, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    running: Moments | None = None
    for piece in y.split([1, 99, 400, 500]):
        running = Moments.of(piece, full=full).merge(running)
    expected = torch.stack([torch.cov(y[:, k].T) for k in range(3)])
    expected = expected if full else torch.diagonal(expected, dim1=-2, dim2=-1)
    torch.testing.assert_close(running.variance, expected, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(running.mean, y.mean(dim=0), rtol=1e-15, atol=0)
    pooled = running.pool()
    flat = y.reshape(-1, 2)
    torch.testing.assert_close(pooled.variance, torch.cov(flat.T) if full else flat.var(dim=0), rtol=1e-6, atol=1e-6)


def test_masked_and_second_moment() -> None:
    generator = torch.Generator().manual_seed(1)
    y = torch.randn(300, 2, 2, generator=generator, dtype=torch.float64)
    mask = torch.rand(300, 2, generator=generator) < 0.3
    parts = [Moments.of(a, full=True, mask=b) for a, b in zip(y.split(100), mask.split(100), strict=True)]
    running = parts[2].merge(parts[1].merge(parts[0]))
    for k in range(2):
        kept = y[mask[:, k], k]
        assert float(running.count[k]) == len(kept)
        torch.testing.assert_close(running.mean[k], kept.mean(dim=0))
        torch.testing.assert_close(running.variance[k], torch.cov(kept.T))
        torch.testing.assert_close(running.second[k], kept.T @ kept / len(kept))
    assert bool(Moments.of(y[:1]).variance.isnan().all())


def test_p_values_against_scipy() -> None:
    generator = torch.Generator().manual_seed(2)
    f = torch.tensor([0.1, 1.0, 3.0, 30.0], dtype=torch.float64)
    expected = torch.from_numpy(stats.f.sf(f.numpy(), 3, 1e6))
    torch.testing.assert_close(f_tail(f, torch.tensor(3.0), torch.tensor(1e6)), expected)
    a = torch.randn(20, generator=generator, dtype=torch.float64) * 3
    b = torch.randn(50, generator=generator, dtype=torch.float64) + 0.5
    parts = torch.stack([a.var() / 20, b.var() / 50])
    ours = t_p_value(a.mean() - b.mean(), parts, torch.tensor([19.0, 49.0]), torch.tensor(True), b.mean())
    assert float(ours) == pytest.approx(stats.ttest_ind(a.numpy(), b.numpy(), equal_var=False).pvalue)
    blocks = [torch.randn(n, generator=generator, dtype=torch.float64) for n in (10, 12, 15)]
    mean = torch.stack([block.mean() for block in blocks])
    scatter = torch.stack([(block - block.mean()).square().sum() for block in blocks])
    ours = homogeneity_p_value(mean, scatter, torch.tensor([10.0, 12.0, 15.0]))
    assert float(ours) == pytest.approx(stats.f_oneway(*(block.numpy() for block in blocks)).pvalue)


def test_smallest_p_value_is_corrected() -> None:
    generator = torch.Generator().manual_seed(3)
    p = torch.rand(4, 2000, generator=generator, dtype=torch.float64)
    assert stats.kstest(smallest(list(p)).numpy(), "uniform").pvalue > 1e-3
    nan = torch.tensor([torch.nan, torch.nan])
    torch.testing.assert_close(smallest([nan, torch.tensor([0.2, torch.nan])])[0], torch.tensor(0.2))
    assert bool(smallest([nan, nan]).isnan().all())
