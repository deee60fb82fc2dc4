"""Weights: partition of unity, zeros, extreme logs, gradients, known values, registry."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from dsfit.errors import InputError
from dsfit.mis import HEURISTICS, Balance, Cutoff, Maximum, Optimal, Power, heuristic

PLAIN = [Balance(), Power(2.0), Power(0.5), Power(7.0), Maximum(), Cutoff(0.1), Cutoff(0.0), Cutoff(1.0)]


def some_logs(seed: int = 0, strategies: int = 4, points: int = 500, scale: float = 3.0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    log_p = scale * torch.randn(strategies, points, generator=generator, dtype=torch.float64)
    zero = torch.rand(strategies, points, generator=generator) < 0.4
    zero[:, :5] = True  # points that nobody reaches
    return torch.where(zero, -torch.inf, log_p)


@pytest.mark.parametrize("rule", PLAIN, ids=str)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_partition_of_unity(rule: object, dtype: torch.dtype) -> None:
    log_p, counts = some_logs().to(dtype), torch.tensor([3.0, 1.0, 0.0, 10.0], dtype=dtype)
    weights = rule.weights(log_p, counts)
    reached = (log_p[counts > 0] > -torch.inf).any(dim=0)
    assert weights.dtype == dtype and bool((weights >= 0).all())
    torch.testing.assert_close(
        weights.sum(dim=0), reached.to(dtype), rtol=0, atol=1e-6 if dtype.itemsize == 4 else 1e-14
    )
    assert not bool(weights[log_p == -torch.inf].any()) and not bool(weights[2].any())
    assert bool(reached.any()) and not bool(reached.all())


@pytest.mark.parametrize("rule", PLAIN, ids=str)
def test_extreme_densities(rule: object) -> None:
    """Densities of 1e-300 and 1e300, and logs far beyond what exp can hold: only ratios count."""
    log_p = some_logs(scale=0.7)
    counts = torch.tensor([3.0, 1.0, 2.0, 10.0], dtype=torch.float64)
    expected = rule.weights(log_p, counts)
    for shift in (-690.8, 690.8, -1e5, 1e5):
        torch.testing.assert_close(rule.weights(log_p + shift, counts), expected, rtol=1e-8, atol=1e-10)
    apart = torch.tensor([[690.0], [-690.0]], dtype=torch.float64)
    torch.testing.assert_close(rule.weights(apart, torch.ones(2)), torch.tensor([[1.0], [0.0]], dtype=torch.float64))


def test_values_by_definition() -> None:
    p, n = torch.tensor([0.5, 2.0, 0.1], dtype=torch.float64), torch.tensor([4.0, 1.0, 5.0], dtype=torch.float64)
    q, log_p = n * p, torch.log(p)[:, None]
    for rule, expected in (
        (Balance(), q / q.sum()),
        (Power(3.0), q**3 / (q**3).sum()),
        (Maximum(), torch.tensor([0.5, 0.5, 0.0])),
        (Cutoff(0.5), torch.tensor([0.5, 0.5, 0.0])),
        (Cutoff(0.2), q / q.sum()),
    ):
        torch.testing.assert_close(rule.weights(log_p, n)[:, 0], expected.double())
    single = Balance().weights(torch.tensor([[-800.0, 3.0]], dtype=torch.float64), torch.tensor([7.0]))
    torch.testing.assert_close(single, torch.ones(1, 2, dtype=torch.float64))


@pytest.mark.parametrize("rule", PLAIN, ids=str)
def test_gradients_are_finite(rule: object) -> None:
    log_p = some_logs().requires_grad_()
    weights = rule.weights(log_p, torch.tensor([3.0, 1.0, 2.0, 10.0]))
    if not weights.requires_grad:  # piecewise constant
        assert isinstance(rule, Maximum)
        return
    weights.square().sum().backward()
    assert bool(torch.isfinite(log_p.grad).all())
    smooth = (torch.randn(3, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(1))).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: rule.weights(x, torch.tensor([3.0, 1.0, 2.0])), smooth)


def test_optimal_weights_sum_to_one_and_give_the_estimator() -> None:
    """sum_s w_s = 1, and w_s F / (c_s p_s) = alpha_s / c_s + (F - alpha . p) / P."""
    log_p, counts = some_logs(strategies=3), torch.tensor([3.0, 1.0, 4.0], dtype=torch.float64)
    generator = torch.Generator().manual_seed(2)
    value = torch.randn(500, 2, generator=generator, dtype=torch.float64)
    alpha = torch.randn(3, 2, generator=generator, dtype=torch.float64)
    weights = Optimal().weights(log_p, counts, value, alpha)
    reached = (log_p > -torch.inf).any(dim=0)
    torch.testing.assert_close(weights.sum(dim=0)[reached], torch.ones_like(value[reached]), rtol=1e-9, atol=1e-9)
    p, c = torch.exp(log_p), counts / counts.sum()
    mix = (c[:, None] * p).sum(dim=0)
    for s in range(3):
        at = (p[s] > 0) & (value != 0).all(dim=-1)
        direct = weights[s] * value / (c[s] * p[s])[:, None]
        expected = alpha[s] / c[s] + (value - p.T @ alpha) / mix[:, None]
        torch.testing.assert_close(direct[at], expected[at], rtol=1e-8, atol=1e-8)


def test_registry() -> None:
    assert set(HEURISTICS) == {"balance", "power", "maximum", "cutoff", "optimal"}
    assert heuristic("power", beta=3) == heuristic({"kind": "power", "beta": 3}) == Power(3)
    assert heuristic("power") == Power(2.0) and heuristic(Cutoff(0.3)) == Cutoff(0.3)
    for bad in (
        lambda: heuristic("balanced"),
        lambda: heuristic({"beta": 2}),
        lambda: heuristic("power", gamma=1),
        lambda: heuristic("power", beta=0),
        lambda: heuristic("cutoff", alpha=1.5),
        lambda: heuristic(Balance(), beta=2),
        lambda: heuristic("optimal", rcond=-1),
        lambda: heuristic("optimal").weights(torch.zeros(2, 3), torch.ones(2)),
        lambda: heuristic("optimal").log_weights(torch.zeros(2, 3), torch.ones(2)),
    ):
        with pytest.raises(InputError):
            bad()


@pytest.mark.parametrize("counts", [[-1.0, 2.0], [0.0, 0.0], [float("nan"), 1.0], [1.0], [1.0, float("inf")]])
def test_bad_counts(counts: list[float]) -> None:
    with pytest.raises(InputError, match="counts"):
        Balance().weights(torch.zeros(2, 3), torch.tensor(counts))
