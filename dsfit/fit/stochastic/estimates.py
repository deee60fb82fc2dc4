"""What samples say of a density: its second moment, its excess, and by how much another one is better, with errors.

With samples of q and m = h / (p q), n = |f| / q, c = p / q, whose means are M(p), N = int E|f| domega and 1,

    excess = M / N^2 - 1  is estimated by  mean(m) / N^2 - 2 mean(n) / N + mean(c)  =  mean((|f|/N - p)^2 / (p q)),

the last without noise. The terms added have known sums, so that the error vanishes with the excess itself instead of
staying at that of M. N is the estimate mean(n), which biases the result by O(excess / samples), and the standard error
follows from the influence of each sample, m / N^2 - 2 (1 + excess) n / N + c.

With one noisy draw the excess is that of the estimator with noise, and does not vanish for any p. With two draws, N
counts |f| and not |F|; these agree where noise is a factor without sign (all channels alike), else N is too large.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from dsfit.fit.objectives import LOG_FLOOR
from dsfit.fit.stochastic.samples import Draws


@dataclass(frozen=True)
class SampledExcess:
    """Estimates `[*batch]` for each context.

    Attributes:
        value, error: the excess M / N^2 - 1 with its standard error.
        log_moment, log_norm: log M and log N.
        leverage: share of the largest sample in the sum of squares behind `error`: near 1, a heavy tail, and the error
            says little.
    """

    value: Tensor
    error: Tensor
    log_moment: Tensor
    log_norm: Tensor
    leverage: Tensor


@torch.no_grad()
def sampled_excess(drawn: Draws, log_p: Tensor) -> SampledExcess:
    """Of the density with `log_p` `[N, *batch]` at the samples; see the module's text."""
    log_p, count = log_p.clamp_min(LOG_FLOOR), len(log_p)
    log_n = drawn.log_length - drawn.log_q
    log_norm = torch.logsumexp(log_n, 0) - math.log(count)
    norm = torch.where(log_norm > -math.inf, log_norm, 0.0)
    log_m = drawn.log_square - log_p - drawn.log_q
    m, n, c = torch.exp(log_m - 2 * norm), torch.exp(log_n - norm), torch.exp(log_p - drawn.log_q)
    excess = (m - 2 * n + c).mean(0)
    square = (m - 2 * (1 + excess) * n + c + 2 * excess).sub(excess).square()
    total = square.sum(0)
    error = torch.sqrt(total / max(count - 1, 1) / count)
    leverage = square.amax(0) / total.clamp_min(torch.finfo(torch.float64).tiny)
    return SampledExcess(excess, error, torch.logsumexp(log_m, 0) - math.log(count), log_norm, leverage)


@torch.no_grad()
def improvement(drawn: Draws, log_before: Tensor, log_after: Tensor) -> tuple[float, float]:
    """By which share of it the second moment fell, averaged over contexts, and the standard error of that.

    Both densities are judged on the same samples (common random numbers), which for densities that are alike leaves
    little of the error. `1 - M_after / M_before`, from differences that are control variates of each other:
    `(h/p_1 - h/p_2) / (q M_1) + (p_1 - p_2) / q`.
    """
    count = len(log_before)
    first, second = log_before.clamp_min(LOG_FLOOR), log_after.clamp_min(LOG_FLOOR)
    log_m = drawn.log_square - first - drawn.log_q
    scale = torch.logsumexp(log_m, 0) - math.log(count)
    scale = torch.where(scale > -math.inf, scale, 0.0)
    fell = torch.exp(log_m - scale) - torch.exp(drawn.log_square - second - drawn.log_q - scale)
    rows = fell + torch.exp(first - drawn.log_q) - torch.exp(second - drawn.log_q)
    contexts = rows.reshape(count, -1)
    error = contexts.std(0).square().sum() ** 0.5 / contexts.shape[1] / count**0.5 if count > 1 else math.inf
    return float(contexts.mean()), float(error)
