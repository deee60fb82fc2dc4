"""From the moments of every stratum to the estimate, its standard error and the consistency test."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dsfit.mis.heuristics import Heuristic, Optimal
from dsfit.mis.moments import Moments
from dsfit.mis.optimal import cross_fit
from dsfit.mis.statistics import homogeneity_p_value, smallest, t_p_value

_MAX_RELATIVE = 0.25
"""Means with a larger relative error are left out of the test between strategies: they are too skew."""


@dataclass(frozen=True)
class Stratum:
    """Samples of one strategy, or of the whole mixture in the one-sample model; cells `[blocks, *batch]`.

    Fields:
        term: moments of z `[C]`, or of (g, r) `[C + S]` for the optimal heuristic.
        test: per strategy whose samples are here, if wanted, moments of the U numbers that `consistency` compares.
        plain: moments of |F| / P, if wanted.
        largest: max |z| `[*batch]`.
    """

    term: Moments
    test: dict[int, Moments]
    plain: Moments | None
    largest: Tensor


def combine(
    strata: list[Stratum], shares: Tensor, fractions: Tensor, rule: Heuristic, quasi: bool
) -> tuple[Tensor, Tensor]:
    """Value and standard error `[*batch, C]`.

    With shares c_s: `value = sum_s c_s mean_s`. Error of independent samples: `se^2 = sum_s c_s^2 var_s / n_s`, since
    strategies are strata; of replicates: the standard error of their mean.

    Args:
        strata: one per strategy with samples, or one for the mixture.
        shares: c_s `[strata]`; 1 for the mixture.
        fractions: c_k of all strategies `[S]`.
        rule: the heuristic.
        quasi: whether blocks are replicates of a point set.
    """
    if isinstance(rule, Optimal):
        return _combine_optimal(strata, shares, fractions, rule, quasi)
    if quasi:
        return _replicated(sum(c * stratum.term.mean for c, stratum in zip(shares, strata, strict=True)))
    pooled = [stratum.term.pool() for stratum in strata]
    value = sum(c * moments.mean for c, moments in zip(shares, pooled, strict=True))
    squared = [c.square() * m.variance / m.count.unsqueeze(-1) for c, m in zip(shares, pooled, strict=True)]
    return value, torch.sqrt(sum(squared).detach())


def _replicated(values: Tensor) -> tuple[Tensor, Tensor]:
    return values.mean(dim=0), (values.var(dim=0) / values.shape[0]).sqrt().detach()


def _combine_optimal(
    strata: list[Stratum], shares: Tensor, fractions: Tensor, rule: Optimal, quasi: bool
) -> tuple[Tensor, Tensor]:
    """Fold k uses the alpha of the other folds.

    Folds count equally, which keeps the mean unbiased when their sizes differ. The error comes from the residuals
    g - r . alpha under the alpha of the other folds, so the fit does not flatter it.
    """
    channels = strata[0].term.mean.shape[-1] - fractions.shape[0]
    second = sum(c * stratum.term.second.detach() for c, stratum in zip(shares, strata, strict=True))
    alpha = cross_fit(second, fractions, channels, rule.rcond)
    # rows of `direction` turn (g, r) into residuals: [I, -alpha]
    identity = torch.eye(channels, dtype=alpha.dtype, device=alpha.device)
    direction = torch.cat([identity.expand(*alpha.shape[:-2], -1, -1), -alpha], dim=-2)
    values, squared = alpha.sum(dim=-2), 0.0
    for c, stratum in zip(shares, strata, strict=True):
        term = stratum.term
        values = values + c * torch.einsum("...i,...ic->...c", term.mean, direction)
        deviation = (term.mean - term.pool().mean).detach()
        spread = deviation.unsqueeze(-1) * deviation.unsqueeze(-2)
        scatter = term.scatter.detach() + term.count[..., None, None] * spread
        residual = torch.einsum("...ic,...ij,...jc->...c", direction, scatter, direction).sum(dim=0).clamp_min(0)
        total, folds = term.count.sum(dim=0), term.count.shape[0]
        degrees = torch.where(total > 1, total - 1, torch.nan)
        harmonic = (1 / term.count).sum(dim=0) / folds**2
        squared = squared + c.square() * residual / degrees.unsqueeze(-1) * harmonic.unsqueeze(-1)
    if quasi:
        return _replicated(values)
    return values.mean(dim=0), torch.sqrt(squared)


def consistency(strata: list[Stratum], shares: Tensor, replicated: bool) -> Tensor:
    """`Estimate.consistency_p_value` `[*batch]`.

    Args:
        strata: as for `combine`; between them they hold test moments of the U strategies with samples, in order.
        shares: c_s of those strategies `[U]`.
        replicated: take the means of replicates, not the samples, as the independent numbers.
    """
    plain = [stratum.plain for stratum in strata]
    # strategies have separate blocks
    within = smallest([homogeneity_p_value(m.mean[..., 0], m.scatter[..., 0], m.count) for m in plain])
    groups = [cells for stratum in strata for cells in stratum.test.values()]
    if len(groups) < 2:
        return within
    pooled = [cells.pool() for cells in groups]
    mean = torch.stack([m.mean for m in pooled])
    count = torch.stack([m.count for m in pooled]).unsqueeze(-1)
    squared = torch.stack([m.variance for m in pooled]) / count
    degrees = count - 1
    coarse = squared
    if replicated:
        blocks = groups[0].count.shape[0]
        squared = torch.stack([cells.mean.var(dim=0) / blocks for cells in groups])
        degrees = torch.full_like(degrees, blocks - 1)
    tests = []
    for s in range(len(groups) if len(groups) > 2 else 1):  # of two strategies, one against the other is all there is
        weight = torch.where(torch.arange(len(groups), device=shares.device) == s, 0.0, shares / (1 - shares[s]))
        weight = weight.reshape(-1, *[1] * (mean.ndim - 2))
        rest = (weight * mean[..., s]).sum(dim=0)
        valid = torch.ones_like(rest, dtype=torch.bool)
        for centre, error in (
            (mean[s, ..., s], coarse[s, ..., s]),
            (rest, (weight.square() * coarse[..., s]).sum(dim=0)),
        ):
            valid = valid & (error < _MAX_RELATIVE**2 * centre.square())
        weight = torch.cat([weight[:s], torch.ones_like(weight[:1]), weight[s + 1 :]])
        parts = weight.square() * squared[..., s]
        tests.append(t_p_value(mean[s, ..., s] - rest, parts, degrees[..., 0], valid, rest))
    between = smallest(tests)
    return torch.where(torch.isfinite(between), between, within)
