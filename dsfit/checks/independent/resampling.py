"""Sampling-importance-resampling from a proposal: p* from the proposal's own samples and density.

Weights |F| / p are used as they are; drawing again with their probabilities (Rubin 1988) would only add noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from arviz_stats.base import array_stats

from dsfit.checks.independent.chains import Size, to_omega, to_place
from dsfit.context import Context
from dsfit.proposals.base import Distribution
from dsfit.random import uniforms


@dataclass(frozen=True)
class Weighted:
    """Samples of a proposal, and what it says about other places.

    Attributes:
        place: (theta_i, phi) `[N, 2]` drawn from the proposal.
        log_size: log |F| there, `[N]`.
        log_weight: log(|F| / p) there with the p that came with the samples, `[N]`; -inf where |F| = 0.
        other_log_weight: log(|F| / p) at the places of the ensembles `[E, n]`, p by `log_prob`; inf where p = 0.
    """

    place: np.ndarray
    log_size: np.ndarray
    log_weight: np.ndarray
    other_log_weight: np.ndarray

    @property
    def ess(self) -> float:
        """Effective number of samples (sum w)^2 / sum w^2 (Kish 1965)."""
        return effective(self.log_weight)

    @property
    def tail_index(self) -> float:
        """Pareto k-hat of the weights (Vehtari et al. 2024, JMLR 25); above 0.7 their mean is not to be trusted.

        0 for weights that reach their largest value many times.
        """
        live = self.log_weight[np.isfinite(self.log_weight)]
        if len(live) < 100:
            return float("inf")
        weight = np.exp(live - live.max())
        if np.mean(weight == 1) > 0.01:
            return 0.0
        return float(array_stats.pareto_khat(weight[None], r_eff=1.0, tail="right"))


def effective(log_weight: np.ndarray) -> float:
    """(sum w)^2 / sum w^2."""
    top = np.max(log_weight, initial=-np.inf)
    if not np.isfinite(top):
        return 0.0
    weight = np.exp(log_weight - top)
    return float(weight.sum() ** 2 / (weight**2).sum())


def draw(
    law: Distribution, size: Size, context: Context, place: np.ndarray, log_size: np.ndarray, samples: int, seed: int
) -> Weighted:
    """`samples` weighted directions of a proposal, and its log weights at the ensembles' places `[E, n, 2]`."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        u = uniforms((samples,), law.dimension, generator=generator)
        omega, log_p = law.sample_with_log_prob(u)
        elsewhere = law.log_prob(to_omega(place, context))
        own = torch.log(size(omega))
    return Weighted(
        to_place(omega, context), own.numpy(), _ratio(own.numpy(), log_p.numpy()), _ratio(log_size, elsewhere.numpy())
    )


def _ratio(log_size: np.ndarray, log_p: np.ndarray) -> np.ndarray:
    """log(|F| / p); where |F| = 0, it is -inf whatever p is, unless that is no number."""
    with np.errstate(invalid="ignore"):
        return np.where(np.isneginf(log_size) & ~np.isnan(log_p), -np.inf, log_size - log_p)
