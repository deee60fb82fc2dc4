"""Tests for equal means."""

from __future__ import annotations

import torch
from torch import Tensor


def f_tail(f: Tensor, degrees1: Tensor, degrees2: Tensor) -> Tensor:
    """P(F with (degrees1, degrees2) > f), float64."""
    from scipy.special import fdtrc  # here because importing dsfit should cost little more than importing torch

    arguments = torch.broadcast_tensors(degrees1.double(), degrees2.double(), f.double().clamp_min(0))
    tail = fdtrc(*(x.detach().cpu().numpy() for x in arguments))
    return torch.as_tensor(tail, dtype=torch.float64, device=f.device)


def t_p_value(difference: Tensor, parts: Tensor, degrees: Tensor, use: Tensor, scale: Tensor) -> Tensor:
    """Two-sided p-value that a difference of independent means is 0 (Welch 1947, Biometrika 34).

    Args:
        difference: `[...]`.
        parts: squared standard errors of the independent parts of the difference `[G, ...]`; their sum is its variance.
        degrees: degrees of freedom of each part `[G, ...]`.
        use: where to test `[...]`; nan elsewhere.
        scale: size of the means; errors below rounding of that are taken as rounding.
    """
    rounding = (64 * torch.finfo(scale.dtype).eps * scale.double()).square()
    difference, parts, degrees = difference.double(), parts.double(), degrees.double()
    variance = parts.sum(dim=0)
    use = use & torch.isfinite(variance)
    variance = torch.where(use, variance, 1.0).clamp_min(1e-300)
    freedom = variance.square() / (parts.square() / degrees.clamp_min(1)).sum(dim=0).clamp_min(1e-300)
    p = f_tail(difference.square() / (variance + rounding), torch.ones_like(variance), freedom)
    return torch.where(use, p, torch.nan)


def smallest(p_values: list[Tensor]) -> Tensor:
    """Smallest of several p-values, corrected for taking the smallest (Sidak); nan entries do not count."""
    stacked = torch.stack(p_values)
    valid = torch.isfinite(stacked)
    least, tests = torch.where(valid, stacked, 1.0).amin(dim=0), valid.sum(dim=0)
    return torch.where(tests > 0, -torch.expm1(tests * torch.log1p(-least)), torch.nan)


def homogeneity_p_value(mean: Tensor, scatter: Tensor, count: Tensor) -> Tensor:
    """Analysis of variance: p-value that blocks `[K, ...]` of samples with a common variance have equal means.

    `scatter` is each block's sum of squared deviations. nan with one block, no spare samples, or no spread at all.
    """
    mean, scatter, count = mean.double(), scatter.double(), count.double()
    total = count.sum(dim=0)
    centre = (mean * count).sum(dim=0) / total.clamp_min(1)
    between = (count * (mean - centre).square()).sum(dim=0)
    within, d1, d2 = scatter.sum(dim=0), torch.full_like(total, mean.shape[0] - 1), total - mean.shape[0]
    valid = (d1 > 0) & (d2 > 0) & (within > 1e-24 * total * centre.square())
    d1, d2, within = torch.where(valid, d1, 1.0), torch.where(valid, d2, 1.0), torch.where(valid, within, 1.0)
    return torch.where(valid, f_tail(between / d1 / (within / d2), d1, d2), torch.nan)
