"""Expected numbers n against counted ones N: bias, scatter, and what images make of them."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

EDGES = (0.0, 0.1, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, math.inf)
ALBEDOS = (0.3, 0.7)
_RAYS_IN_BIN = 60


def compare(n: Tensor, exact: Tensor, few: Tensor, *, bins: bool = True) -> dict[str, Any]:
    """All numbers for rays with expected n and counted N, `[K]` each; `few` `[K]` says which are expected to meet few.

    mean_n, mean_N, error: means, and the standard error of their difference.
    few: mean of n - N over those that are to meet few, and its standard error.
    scatter, poisson: RMS of N about its mean at given n, and what Poisson numbers of that mean have.
    zero, exp: share of rays with N = 0, and mean of exp(-n).
    powers: mean of a^N, and of its mean exp(-n (1 - a)) for Poisson numbers, by a.
    rule: share of rays that the thesis's rule, n <= 1/2, calls lit; that it gets wrong; wrongly lit; wrongly dark.
    brier: mean square of v - [N = 0], by rule.
    """
    lit, called = exact == 0, n <= 0.5
    hit = lit.to(n)
    scatter, poisson = spread(n, exact)
    rest = (n - exact)[few]
    result: dict[str, Any] = {
        "mean_n": float(n.mean()),
        "mean_N": float(exact.mean()),
        "error": float((n - exact).std()) / math.sqrt(len(n)),
        "few": [float(rest.mean()), float(rest.std()) / math.sqrt(max(len(rest), 1))],
        "scatter": scatter,
        "poisson": poisson,
        "zero": float(hit.mean()),
        "exp": float(torch.exp(-n).mean()),
        "powers": {f"{a:g}": [float((a**exact).mean()), float(torch.exp(-n * (1 - a)).mean())] for a in ALBEDOS},
        "rule": {
            "lit": float(called.to(n).mean()),
            "wrong": float((called != lit).to(n).mean()),
            "wrongly_lit": float((called & ~lit).to(n).mean()),
            "wrongly_dark": float((~called & lit).to(n).mean()),
        },
        "brier": {
            "poisson": float((torch.exp(-n) - hit).square().mean()),
            "threshold": float((called.to(n) - hit).square().mean()),
        },
    }
    if bins:
        result["bins"] = [
            _bin(n, exact, (n >= low) & (n < high)) for low, high in zip(EDGES[:-1], EDGES[1:], strict=True)
        ]
    return result


def _bin(n: Tensor, exact: Tensor, inside: Tensor) -> dict[str, float] | None:
    """Means of the rays in a bin of n; None where there are fewer than ten."""
    count = int(inside.sum())
    if count < 10:
        return None
    n, exact = n[inside], exact[inside]
    return {
        "rays": count,
        "n": float(n.mean()),
        "N": float(exact.mean()),
        "zero": float((exact == 0).to(n).mean()),
        "exp": float(torch.exp(-n).mean()),
    }


def spread(n: Tensor, exact: Tensor) -> tuple[float, float]:
    """RMS of N about its mean at given n, and the root of that mean's mean, which Poisson numbers have.

    The mean at given n is a straight line in each of many bins of equal numbers of rays; two degrees of freedom a bin
    are allowed for.
    """
    order = torch.argsort(n)
    square = freedom = fitted = 0.0
    for part in order.tensor_split(max(1, len(n) // _RAYS_IN_BIN)):
        x, y = n[part] - n[part].mean(), exact[part]
        variance = x.square().sum()
        slope = (x * y).sum() / variance if float(variance) > 0 else 0.0
        line = y.mean() + slope * x
        square += float((y - line).square().sum())
        freedom += max(len(part) - 2, 0)
        fitted += float(line.sum())
    return math.sqrt(square / max(freedom, 1.0)), math.sqrt(max(fitted, 0.0) / len(n))
