"""The best that the chapter's proposals can do together: fractions optimised on quadrature nodes, over all heuristics
and both models."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

if TYPE_CHECKING:
    from dsfit.experiment.methods import Setting

HEURISTICS = ("balance", "power", "maximum", "cutoff")
"""What `best_mix` tries unless told which. Not "optimal": it is balance with control variates, another kind of
estimator, whose variance may fall below what any density can reach; ask for it by name."""
LEAST = 1e-3
"""Strategies with a smaller share than this are dropped: a few hundred samples would not reach them."""


@dataclass(frozen=True)
class BestMix:
    """What `best_mix` finds; `tried` maps "heuristic, model" to the excess reached."""

    fractions: list[float]
    heuristic: Any
    model: str
    excess: float
    tried: dict[str, float]


def balance_fractions(
    log_p: Tensor, squared: Tensor, tolerance: float = 1e-3, steps: int = 5000
) -> tuple[Tensor, float]:
    """Fractions c that minimise M(c) = sum_q a_q / sum_k c_k p_kq, and a proven bound on how far M(c) is above its
    minimum.

    M is convex on the simplex, so the minimum over all proposals is the minimum over all subsets of them too (He and
    Owen 2014). Steps are multiplicative, c_k <- c_k sqrt(g_k / M) normalised, with g_k = -dM/dc_k = sum_q a_q p_kq /
    P_q^2; M never rises (Torsney 1983). By convexity and sum_k c_k g_k = M, M(c) - min M <= max_k g_k - M: the
    relative gap that is returned, at most `tolerance` if the steps sufficed.

    Args:
        log_p: `[K, Q]` log densities at the nodes.
        squared: `[Q]` quadrature weight times |F|^2.
    """
    top = log_p.amax(dim=0)
    shape = torch.exp(
        torch.where(torch.isfinite(top), log_p - top, 0.0)
    )  # p / largest p: no overflow, and a cancels below
    a = torch.where(squared > 0, squared * torch.exp(-torch.where(torch.isfinite(top), top, 0.0)), 0.0)
    c = torch.full((len(log_p),), 1 / len(log_p), dtype=log_p.dtype)
    gap = float("inf")
    for _ in range(steps):
        mix = c @ shape
        share = a / mix
        value = share.sum()
        slope = shape @ (share / mix)
        gap = float(slope.max() / value - 1)
        if gap <= tolerance:
            break
        c = c * torch.sqrt(slope / value)
        c = c / c.sum()
    return c, gap


def best_mix(setting: Setting, strategies: Sequence[nn.Module], rule: Any = None) -> BestMix:
    """The combination of least variance per sample, over heuristics (or with `rule` alone) and both models.

    Fractions are the convex optimum of the balance heuristic's second moment, equal ones, and for balance with fixed
    counts also a local optimum of its variance. For "optimal" only the first two are tried: its variance at the nodes
    can be driven below the truth.
    """
    from dsfit.mis.variance import best_fractions, mis_variance

    nodes, log_p = setting.nodes, setting.log_p(strategies)
    squared = nodes.weight * nodes.value.square().sum(-1)
    convex, _ = balance_fractions(log_p, squared)
    candidates = [convex, torch.full_like(convex, 1 / len(convex))]
    found: list[tuple[float, list[float], Any, str]] = []
    tried: dict[str, float] = {}
    for heuristic in HEURISTICS if rule is None else (rule,):
        for model in ("multi", "one"):
            extra = []
            if heuristic == "balance" and model == "multi":
                extra = [best_fractions(nodes.value, nodes.weight, log_p, heuristic, model=model, steps=30)[0]]
            entries = []
            for fractions in [*candidates, *extra]:
                kept = torch.where(fractions < LEAST, 0.0, fractions)
                kept = kept / kept.sum()
                used = kept > 0
                quality = mis_variance(nodes.value, nodes.weight, log_p[used], kept[used], heuristic, model=model)
                entries.append((float(quality.variance_excess), kept.tolist(), heuristic, model))
            best = min(entries, key=lambda entry: entry[0])
            tried[f"{heuristic}, {model}"] = best[0]
            found.append(best)
    excess, fractions, heuristic, model = min(found, key=lambda entry: entry[0])
    return BestMix(fractions, heuristic, model, excess, tried)
