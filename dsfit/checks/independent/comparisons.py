"""One proposal against the ensembles: marginals, means of test functions, and the ratio of integrals."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import expit

from dsfit.checks.independent.chains import Chains
from dsfit.checks.independent.resampling import Weighted, effective
from dsfit.checks.independent.welch import ROUNDING, Sample, smallest_p, welch

_FRONT = np.pi / 2
_DEGREES = 60  # of freedom, of the standard errors from weights; a cell of 30 effective samples has them


@dataclass(frozen=True)
class Comparison:
    """Two estimates of the same numbers.

    Attributes:
        names: of the numbers.
        p: p-value of each, by Welch's t.
        z: differences in standard errors.
        relative_error: largest standard error in units of the spread of what is averaged, which bounds what the
            comparison can see.
    """

    names: tuple[str, ...]
    p: np.ndarray
    z: np.ndarray
    relative_error: float

    @property
    def p_value(self) -> float:
        """The smallest p-value, corrected for having taken it."""
        return smallest_p(self.p)

    @property
    def worst(self) -> str:
        """Name of the number that differs most."""
        return self.names[int(np.argmin(self.p))]


@dataclass(frozen=True)
class Region:
    """Where a proposal can be judged: `w = |F| / p <= limit int |F| domega`.

    There, N samples of the proposal are worth N share / limit at least, and weights are bounded. What the proposal
    misses, or hardly ever draws, is left out on both sides. The region depends on the density alone, so leaving it out
    does not bias the comparison whatever the density.

    Attributes:
        weight: of the proposal's samples, 0 outside, largest 1, `[N]`.
        inside: of the ensembles' places `[E, n]`.
        share: share of p* inside, by the ensembles.
        ess: effective number of the weighted samples inside.
    """

    weight: np.ndarray
    inside: np.ndarray
    share: float
    ess: float


def region(weighted: Weighted, log_norm: float, limit: float) -> Region:
    """The part of the sphere where the proposal's weights are at most `limit` times int |F| domega."""
    bound = math.log(limit) + log_norm
    log_weight = np.where(weighted.log_weight <= bound, weighted.log_weight, -np.inf)
    inside = (weighted.other_log_weight <= bound) & ~np.isneginf(weighted.other_log_weight)
    top = log_weight.max(initial=-np.inf)
    weight = np.exp(log_weight - top) if np.isfinite(top) else np.zeros_like(log_weight)
    return Region(weight, inside, float(inside.mean()), effective(log_weight))


def test_functions(place: np.ndarray, phi_half: bool = True) -> tuple[tuple[str, ...], np.ndarray]:
    """Values `[..., J]` of functions of (theta, phi) `[..., 2]`; the last one, an indicator, on demand."""
    theta, phi = place[..., 0], place[..., 1]
    columns = {
        "sin theta": np.sin(theta),
        "cos 2 theta": np.cos(2 * theta),
        "cos phi": np.cos(phi),
        "sin phi": np.sin(phi),
        "cos 2 phi": np.cos(2 * phi),
        "sin theta cos phi": np.sin(theta) * np.cos(phi),
    }
    if phi_half:
        columns["|phi| > pi/2"] = (np.abs(phi) > _FRONT).astype(float)
    return tuple(columns), np.stack(list(columns.values()), axis=-1)


test_functions.__test__ = False  # not a test of pytest's


def means(weighted: Weighted, place: np.ndarray, where: Region) -> Comparison:
    """Means of `test_functions` under p* restricted to the region, by weights and by the ensembles."""
    names, own = test_functions(weighted.place)
    return _compare(names, own, test_functions(place)[1], where)


def marginals(
    weighted: Weighted, place: np.ndarray, log_size: np.ndarray, where: Region, count: int = 16
) -> Comparison:
    """Distribution functions of theta_i, phi and log |F| at `count - 1` quantiles each.

    A Kolmogorov-Smirnov test whose standard errors come from the weights and from the scatter between ensembles, at
    points, because neither sample is one of independent values. theta_h = (theta_i + theta_r) / 2 has the same
    distribution function as theta_i; log |F| sees theta and phi together.

    Args:
        place, log_size: of the ensembles, `[E, n, 2]` and `[E, n]`.
    """
    own = {"theta": weighted.place[:, 0], "phi": weighted.place[:, 1], "log |F|": weighted.log_size}
    other = {"theta": place[..., 0], "phi": place[..., 1], "log |F|": log_size}
    names, first, second = [], [], []
    levels = np.arange(1, count) / count
    for name in own:
        inside = other[name][where.inside]
        if len(inside) == 0:
            continue
        for level, point in zip(levels, np.quantile(inside, levels), strict=True):
            names.append(f"{name} at quantile {level:.2f}")
            first.append(own[name] <= point)
            second.append(other[name] <= point)
    if not names:
        return Comparison(("nothing",), np.ones(1), np.zeros(1), float("inf"))
    return _compare(tuple(names), np.stack(first, -1).astype(float), np.stack(second, -1).astype(float), where)


def _compare(names: tuple[str, ...], own: np.ndarray, other: np.ndarray, where: Region) -> Comparison:
    if where.ess < 2 or where.inside.sum() < 2:
        return Comparison(names, np.ones(len(names)), np.zeros(len(names)), float("inf"))
    a, b = Sample.of_weights(where.weight, own), Sample.of_ensembles(where.inside, other)
    # a standard error made of a few large weights is no standard error
    known = np.broadcast_to(a.degrees, a.mean.shape) >= _DEGREES
    known |= a.variance + b.variance < ROUNDING**2
    if known.mean() < 0.5:
        return Comparison(names, np.ones(len(names)), np.zeros(len(names)), float("inf"))
    spread = np.maximum(other[where.inside].std(axis=0), ROUNDING)
    found = _judged(names, a, b, np.where(known, spread, np.inf))
    return Comparison(names, np.where(known, found.p, 1.0), np.where(known, found.z, 0.0), found.relative_error)


def _judged(names: tuple[str, ...], a: Sample, b: Sample, spread: np.ndarray) -> Comparison:
    error = np.sqrt(a.variance + b.variance + ROUNDING**2)
    relative = np.where(spread > ROUNDING, error / spread, 0.0)
    return Comparison(names, welch(a, b), (a.mean - b.mean) / error, float(np.max(relative)))


def against_quadrature(chains: Chains, place: np.ndarray, share: np.ndarray, tolerance: float = 1e-3) -> Comparison:
    """Means of the smooth test functions by the ensembles and by a quadrature: places `[Q, 2]`, shares of p* `[Q]`.

    `tolerance` is the quadrature's error, in units of each function's spread.
    """
    every = chains.place.transpose(1, 0, 2, 3).reshape(chains.ensembles, -1, 2)
    names, values = test_functions(every, phi_half=False)
    spread = np.maximum(values.std(axis=(0, 1)), ROUNDING)
    exact = Sample(share @ test_functions(place, phi_half=False)[1], (tolerance * spread) ** 2, 1e9)
    return _judged(names, Sample.of_independent(values.mean(axis=1)), exact, spread)


@dataclass(frozen=True)
class Bridge:
    """int |F| domega from samples of a proposal and of p*.

    Attributes:
        log_norm, log_error: log of the integral and its standard error.
        degrees: degrees of freedom of the standard error.
        importance: int |F| domega by importance sampling alone, and its relative standard error.
        p_region: p-value that importance sampling inside the region agrees with it.
    """

    log_norm: float
    log_error: float
    degrees: float
    importance: tuple[float, float]
    p_region: float

    def against(self, norm: float, error: float) -> tuple[float, float]:
        """p-value and z-score that the integral is `norm` within its error bound."""
        known = Sample(np.array([math.log(norm)]), np.array([(error / norm) ** 2]), 1e9)
        own = Sample(np.array([self.log_norm]), np.array([self.log_error**2]), self.degrees)
        z = (self.log_norm - math.log(norm)) / math.hypot(self.log_error, error / norm)
        return float(welch(own, known)[0]), z


def bridge(weighted: Weighted, where: Region, effective_samples: float) -> Bridge:
    """Optimal bridge between a proposal's density p and |F| (Meng and Wong 1996, Statistica Sinica 6, eq. 4.1).

    With l = |F| / p, n_1 samples of p and n_2 effective samples of p*, s_k = n_k / (n_1 + n_2), iterate

        r <- mean_p [l / (s_2 l + s_1 r)] / mean_p* [1 / (s_2 l + s_1 r)].

    Both averaged functions are bounded, so that heavy tails of l do no harm; and places that p never draws have l =
    inf and count as 0, so that p need not cover p*. Standard errors by the delta method: independent samples of p,
    and the scatter between ensembles.

    It scales with p: a density of the wrong scale gives an integral of the wrong scale, which only another method can
    tell. `p_region` compares two ratios of the same samples, and sees only densities that are not their sampler's.
    """
    seen = weighted.other_log_weight[np.isfinite(weighted.other_log_weight)]
    scale = float(np.median(seen)) if len(seen) else 0.0
    own, other = weighted.log_weight - scale, weighted.other_log_weight - scale
    n_1, n_2 = len(own), max(effective_samples, 1.0)
    s_1, s_2 = n_1 / (n_1 + n_2), n_2 / (n_1 + n_2)
    log_r = 0.0
    for _ in range(200):
        # l / (s_2 l + s_1 r) = expit(log(s_2 l / (s_1 r))) / s_2, and the other by the complement
        shift = math.log(s_2 / s_1) - log_r
        first, second = expit(own + shift) / s_2, expit(-(other + shift)) / s_1
        if not (first.mean() > 0 and second.mean() > 0):
            return Bridge(float("nan"), float("inf"), 1.0, _importance(weighted), 1.0)
        step = math.log(first.mean() / second.mean())  # the second already carries 1 / r
        log_r += step
        if abs(step) < 1e-12:
            break
    relative_first, relative_second = first / first.mean(), second.mean(axis=1) / second.mean()
    a = Sample.of_independent(relative_first)
    b = Sample.of_independent(relative_second)
    variance = float(a.variance + b.variance)
    degrees = variance**2 / (float(a.variance) ** 2 / a.degrees + float(b.variance) ** 2 / b.degrees)
    return Bridge(
        log_norm=log_r + scale,
        log_error=math.sqrt(variance),
        degrees=degrees,
        importance=_importance(weighted),
        p_region=_region_p(weighted, where, log_r + scale, relative_first, relative_second),
    )


def _importance(weighted: Weighted) -> tuple[float, float]:
    top = float(np.max(weighted.log_weight, initial=-np.inf))
    if not np.isfinite(top):
        return 0.0, float("inf")
    weight = np.exp(weighted.log_weight - top)
    mean = float(weight.mean())
    return mean * math.exp(top), float(weight.std(ddof=1) / math.sqrt(len(weight)) / mean)


def _region_p(weighted: Weighted, where: Region, log_norm: float, first: np.ndarray, second: np.ndarray) -> float:
    """The region's integral by importance sampling over its share by the ensembles is the whole integral, too.

    Both use the same samples, so that the differences of their influences are what has a standard error.
    """
    total, share = where.weight.mean(), where.inside.mean()
    if not (total > 0 and share > 0) or where.ess < 2:
        return 1.0
    top = np.max(np.where(where.weight > 0, weighted.log_weight, -np.inf))
    found = math.log(total) + float(top) - math.log(share)
    own = Sample.of_independent(where.weight / total - first)
    other = Sample.of_independent(where.inside.mean(axis=1) / share - second)
    gap = Sample(np.array([found - log_norm]), np.array([own.variance]), own.degrees)
    return float(welch(gap, Sample(np.zeros(1), np.array([other.variance]), other.degrees))[0])
