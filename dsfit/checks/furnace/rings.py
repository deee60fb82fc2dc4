"""White furnace and ring light: do the weights add up to the integral, in total and in every ring?

A sampler whose directions are not what its density says can still be right in total. With X drawn from the density p
and the weight w = |f(X)| / p(X), the weighted counts `W_k = mean of w 1[X in cell k]` have mean `I_k = int_k |f|` and
covariance `(diag(S) - I I^T) / N`, `S_k = int_k |f|^2 / p`, all known by quadrature if sampler and density agree.
The statistic `(W - I)^T Cov^-1 (W - I)` is then chi-square distributed. Each cell is a light that shines from there
alone; with rings it is the ring light of published hair BSDF tests, all rings at once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from scipy import special, stats
from torch import Tensor

from dsfit.checks.furnace.draws import Draws, draw
from dsfit.checks.furnace.nodes import CAP, IntegrandLike, NodeDensity, Rule, partition_nodes
from dsfit.checks.furnace.partition import Partition
from dsfit.context import Context
from dsfit.proposals.base import Proposal

EFFECTIVE = 40.0
"""Fewest effective samples of a cell, `N I^2 / S` and `1 / skewness^2`; neighbours are merged until they have them."""


@dataclass(frozen=True)
class WhiteFurnace:
    """An estimate under light of radiance 1, against quadrature.

    Attributes:
        value, error: int f domega and the quadrature's bound, `[C]`.
        estimate: mean of f / p, `[C]`.
        standard_error: of the estimate if sampler and density agree, from int f^2 / p, `[C]`.
        z: (estimate - value) in standard errors, the quadrature's bound included, `[C]`.
        p_value: of the largest |z|, corrected for the skewness of the weights and for taking the largest.
        invalid: samples that were no directions; they make p_value 0.
    """

    value: Tensor
    error: Tensor
    estimate: Tensor
    standard_error: Tensor
    z: Tensor
    p_value: float
    invalid: int


@dataclass(frozen=True)
class WeightedCounts:
    """Weighted counts of samples per cell (ring, wedge), against quadrature.

    Attributes:
        expected, error: int min(|f|, cap int |f| p) domega over each cell and its bound, `[K]`; int |f| where no weight
            is capped.
        sampled: mean weight that fell into each cell, `[K]`.
        standard_error: of `sampled` if sampler and density agree, `[K]`.
        group: for every cell the group it was merged into, -1 if it was left out, `[K]`.
        untested: share of int |f| that was capped or left out.
        statistic, degrees: chi-square over the groups.
        p_value: 0 if samples were no directions.
        invalid: how many were not.
    """

    expected: Tensor
    error: Tensor
    sampled: Tensor
    standard_error: Tensor
    group: Tensor
    untested: float
    statistic: float
    degrees: int
    p_value: float
    invalid: int


def white_furnace(density: NodeDensity, draws: Draws) -> WhiteFurnace:
    """z-scores of the mean weight of every channel.

    The standard error is that under the hypothesis, from quadrature, not from the samples: samples that miss a peak
    would understate it.
    """

    def columns(rule: Rule, p: Tensor) -> Tensor:
        f = rule.value
        ratio = torch.where(f != 0, f / draws.mixed(p)[:, None], 0.0)
        return torch.cat([f, f * ratio, f * ratio**2], dim=-1)

    sums, bounds = density.integrate(columns)
    value, second, third = sums.sum(0).chunk(3)
    error, second = bounds.sum(0)[: len(value)], second + bounds.sum(0)[len(value) : 2 * len(value)]
    estimate = draws.weights().sum(0) / draws.samples
    variance = (second - value**2).clamp_min(0.0)
    standard_error = torch.sqrt(variance / draws.samples)
    spread = torch.sqrt(standard_error**2 + error**2)
    difference = estimate - value
    tiny = 1e-9 * value.abs() + torch.finfo(value.dtype).tiny
    z = torch.where(spread > tiny, difference / spread.clamp_min(tiny), 0.0)
    z = torch.where((spread <= tiny) & (difference.abs() > tiny), math.inf, z)
    central = third - 3 * second * value + 2 * value**3
    skew = torch.where(variance > tiny**2, central / variance.clamp_min(1e-300) ** 1.5, 0.0) / math.sqrt(draws.samples)
    p_value = 0.0 if draws.invalid else _smallest(z, skew)
    return WhiteFurnace(value, error, estimate, standard_error, z, p_value, draws.invalid)


def _smallest(z: Tensor, skew: Tensor) -> float:
    """Two-sided p-value of the largest of |z|, Šidák-corrected (conservative: channels go together)."""
    p_values = []
    for score, asymmetry in zip(z.tolist(), skew.tolist(), strict=True):
        if not math.isfinite(score) or not math.isfinite(asymmetry):
            return 0.0
        tails = skew_tail(score, asymmetry), skew_tail(-score, -asymmetry)
        p_values.append(min(1.0, 2 * min(tails)))
    return -math.expm1(len(p_values) * math.log1p(-min(min(p_values), 1 - 1e-16)))


def skew_tail(z: float, skew: float) -> float:
    """P(Z > z) of Pearson's type III law of mean 0, variance 1 and this skewness: what a sum of many skew weights is
    closer to than to the normal law. A gamma law of shape 4 / skew^2, shifted and scaled; skewness is cut at 2."""
    skew = min(max(skew, -2.0), 2.0)
    if abs(skew) < 1e-3:
        return float(special.ndtr(-z))
    shape = 4 / skew**2
    x = shape + z * math.copysign(math.sqrt(shape), skew)
    return float(special.gammaincc(shape, max(x, 0.0)) if skew > 0 else special.gammainc(shape, max(x, 0.0)))


def weighted_counts(
    density: NodeDensity, draws: Draws, cells: Tensor | None = None, cap: float = CAP
) -> WeightedCounts:
    """The chi-square test of weighted counts over all cells at once.

    Weights are capped at `cap int |f|`, in the samples and in the quadrature alike: what is compared is
    `int_k min(|f|, cap int |f| p)`, so that no single sample decides, whatever the tails of p.

    Args:
        density: of the proposal at nodes of the partition, `partition_nodes(...).with_density(distribution.log_prob)`.
        draws: samples of it.
        cells: for every cell of the partition the number of the cell that it is counted in, `[cells]`:
            `partition.rings()` or `partition.wedges()`; left out, each counts for itself.
        cap: largest weight in units of the mean.
    """
    partition = density.nodes.partition
    cells = torch.arange(partition.count) if cells is None else cells
    count = int(cells.max()) + 1
    largest = cap * density.nodes.total()

    def columns(rule: Rule, p: Tensor) -> Tensor:
        norm, mixed = torch.linalg.vector_norm(rule.value, dim=-1), draws.mixed(p)
        weight = torch.where(norm < largest * mixed, norm / mixed, largest)
        capped = torch.where(norm > 0, weight * mixed, 0.0)
        return torch.stack([capped, capped * weight, capped * weight**2, capped * weight**3, norm], dim=-1)

    sums, bounds = (_collected(x, cells, count) for x in density.integrate(columns))
    weight = torch.linalg.vector_norm(draws.weights(), dim=-1).clamp_max(largest)
    where = cells[partition.cell(draws.omega, draws.context)]
    sampled = torch.zeros(count, dtype=weight.dtype).index_add_(0, where, weight) / draws.samples
    sums[:, 1] += bounds[:, 1]  # a variance is a small difference where p is good: grant the quadrature its error
    return _compare(sums, bounds[:, 0], sampled, draws)


def _collected(x: Tensor, cells: Tensor, count: int) -> Tensor:
    return torch.zeros(count, x.shape[-1], dtype=x.dtype).index_add_(0, cells, x)


def _compare(moments: Tensor, error: Tensor, sampled: Tensor, draws: Draws) -> WeightedCounts:
    """`moments[k]` are int_k w^m q for m = 1..4 with q the density of the samples, and int_k |f|."""
    samples = draws.samples
    expected, second = moments[:, 0], moments[:, 1]
    standard_error = torch.sqrt(((second - expected**2) / samples).clamp_min(0.0))
    group = merge_cells(moments[:, :3], samples)
    used = group >= 0
    columns = torch.cat([moments[:, :4], error[:, None], sampled[:, None]], dim=-1)[used]
    mean, square, _, fourth, bound, found = _collected(columns, group[used], int(group.max()) + 1).unbind(-1)
    covariance = (torch.diag(square) - mean[:, None] * mean) / samples
    # the quadrature's bounds, as if they were independent errors, and as if they were one
    covariance = covariance + torch.diag(bound**2) + bound[:, None] * bound
    statistic, degrees = quadratic_form(found - mean, covariance)
    excess = float((fourth / (samples * square**2)).sum())  # rare large weights widen the law of the statistic
    p_value = scaled_chi_square(statistic, degrees, 2 * degrees + excess) if degrees else 1.0
    return WeightedCounts(
        expected=expected,
        error=error,
        sampled=sampled,
        standard_error=standard_error,
        group=group,
        untested=1 - float(mean.sum() / moments[:, 4].sum().clamp_min(1e-300)),
        statistic=statistic,
        degrees=degrees,
        p_value=0.0 if draws.invalid or not math.isfinite(statistic) else p_value,
        invalid=draws.invalid,
    )


def scaled_chi_square(statistic: float, degrees: int, variance: float) -> float:
    """Upper tail of the multiple of a chi-square law that has this mean and variance (Satterthwaite)."""
    return float(stats.chi2.sf(statistic * 2 * degrees / variance, 2 * degrees**2 / variance))


def merge_cells(moments: Tensor, samples: int, least: float = EFFECTIVE) -> Tensor:
    """Group number of every cell `[K]`, -1 for cells that are left out. Nothing that was sampled enters.

    A group's weighted count needs `least` effective samples by variance, `N I^2 / S`, and by skewness, `N S^3 / T^2`.
    Cells that have them stand alone. The others are pooled from the largest weights down, as cells of smaller weights
    only ever help; a cell that all smaller ones cannot help enough is hit too rarely for the weight it carries, and is
    left out.

    Args:
        moments: int_k w^(m - 1) |f| for m = 1, 2, 3, `[K, 3]`: I, S, T.
        samples: N.
    """
    rows = moments.tolist()

    def effective(i: float, s: float, t: float) -> float:
        return 0.0 if min(i, s, t) <= 0 else samples * min(i * (i / s), s * (s / t) * (s / t))

    alone = [k for k, row in enumerate(rows) if effective(*row) >= least]
    group = torch.full((len(rows),), -1)
    group[alone] = torch.arange(len(alone))
    lone = set(alone)
    rest = [k for k, row in enumerate(rows) if k not in lone and min(row) > 0]
    rest.sort(key=lambda k: -rows[k][2] / rows[k][1])
    current, start = len(alone), 0
    while start < len(rest):
        pool = [0.0, 0.0, 0.0]
        for end in range(start, len(rest)):
            pool = [a + b for a, b in zip(pool, rows[rest[end]], strict=True)]
            if effective(*pool) >= least:
                group[rest[start : end + 1]] = current
                current, start = current + 1, end + 1
                break
        else:
            start += 1
    return group


def quadratic_form(difference: Tensor, covariance: Tensor) -> tuple[float, int]:
    """`d^T C^-1 d` and the rank of C.

    Infinite where d leaves the range of C (with weights all equal the total has no variance, and must be right to
    rounding), and where C has negative variances: `int f^2/p < (int f)^2` takes a p that integrates to more than 1.
    """
    variance = covariance.diagonal()
    if not bool(difference.isfinite().all() and covariance.isfinite().all() and (variance >= 0).all()):
        return math.inf, 0
    scale = torch.sqrt(variance).clamp_min(1e-150)
    values, vectors = torch.linalg.eigh(covariance / (scale[:, None] * scale))
    along = vectors.T @ (difference / scale)
    used = values > 1e-10
    if bool((values < -1e-6).any()) or bool((along[~used].abs() > 1e-4).any()):
        return math.inf, int(used.sum())
    return float((along[used] ** 2 / values[used]).sum()), int(used.sum())


def ring_light(
    integrand: IntegrandLike,
    proposal: Proposal,
    context: Context,
    partition: Partition | None = None,
    samples: int = 16384,
    *,
    generator: torch.Generator,
    beside: float = 0.0,
    rtol: float = 1e-4,
) -> WeightedCounts:
    """The ring light test of one proposal in one call.

    Args:
        integrand: F cos(theta_i) per steradian; any function `f(omega_i, context) -> [..., C]`.
        proposal: what is tested, as `proposal(context)` returns a `Distribution`.
        context: a single context.
        partition: rings, wedges, or both; left out, 36 rings of 5 degrees. `Partition.ring(theta, half_width)` is one
            narrow ring.
        samples: directions.
        generator: of the uniforms.
        beside: share of the uniform sphere, for proposals that do not cover the integrand or whose weights have no
            variance; see `draw`.
        rtol: of the quadrature.
    """
    partition = Partition.even(36) if partition is None else partition
    nodes = partition_nodes(integrand, context, partition, rtol)
    draws = draw(integrand, proposal, context, samples, generator=generator, beside=beside)
    with torch.no_grad():
        return weighted_counts(nodes.with_density(proposal(context).log_prob), draws)
