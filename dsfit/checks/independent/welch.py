"""Means with standard errors and degrees of freedom, from weights or from ensembles, and their comparison."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

ROUNDING = 1e-9
"""Least standard error: of functions that are constant on both sides, such as an indicator of all that is drawn."""


@dataclass(frozen=True)
class Sample:
    """Estimates of J means: value, squared standard error, and degrees of freedom of the latter, `[J]` or scalar."""

    mean: np.ndarray
    variance: np.ndarray
    degrees: np.ndarray | float

    @staticmethod
    def of_independent(values: np.ndarray) -> Sample:
        """From independent values, `[E]` or `[E, J]`."""
        count = len(values)
        return Sample(values.mean(axis=0), values.var(axis=0, ddof=1) / count, count - 1)

    @staticmethod
    def of_weights(weight: np.ndarray, values: np.ndarray) -> Sample:
        """Self-normalised importance sampling: weights `[n]`, values `[n, J]`.

        mean = sum w h / sum w, variance = sum a with a = w^2 (h - mean)^2 / (sum w)^2 (delta method). Its degrees of
        freedom follow from the scatter of its own terms, 2 / (sum a^2 / (sum a)^2 - 1/n): n for normal values, few
        where few large weights make it up.
        """
        total = weight.sum()
        mean = weight @ values / total
        terms = (weight[:, None] * (values - mean) / total) ** 2
        variance = terms.sum(axis=0)
        scatter = ((terms / np.maximum(variance, 1e-300)) ** 2).sum(axis=0) - 1 / len(weight)
        return Sample(mean, variance, 2 / np.maximum(scatter, 2 / len(weight)))

    @staticmethod
    def of_ensembles(inside: np.ndarray, values: np.ndarray) -> Sample:
        """Means over what is `inside` `[E, n]` of values `[E, n, J]`, with the scatter between the E ensembles.

        A ratio estimator, as ensembles have unequal numbers inside: the variance is that of
        `(mean(h 1) - mean * mean(1)) / overall mean(1)` between ensembles, which are independent of each other.
        """
        share = inside.mean(axis=1)
        sums = np.einsum("en,enj->ej", inside.astype(float), values) / inside.shape[1]
        mean = sums.mean(axis=0) / share.mean()
        influence = (sums - mean * share[:, None]) / share.mean()
        return Sample(mean, influence.var(axis=0, ddof=1) / len(share), len(share) - 1)


def welch(a: Sample, b: Sample) -> np.ndarray:
    """Two-sided p-values that means are equal, by Welch's t with Satterthwaite's degrees of freedom."""
    variance = a.variance + b.variance + ROUNDING**2
    spread = np.asarray(a.variance**2 / a.degrees + b.variance**2 / b.degrees)
    degrees = variance**2 / np.maximum(spread, variance**2 * 1e-12)
    return 2 * stats.t.sf(np.abs(a.mean - b.mean) / np.sqrt(variance), np.maximum(degrees, 1))


def smallest_p(p: np.ndarray) -> float:
    """The smallest of several p-values, corrected for having taken it (Sidak).

    On the safe side if they depend on each other the way functions of the same samples do.
    """
    least = float(np.min(p))
    return float(-np.expm1(len(p) * np.log1p(-least))) if least < 1 else 1.0
