"""Expected numbers n against counted ones N: bias, scatter, what images make of them, and standard errors of each."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

EDGES = (0.0, 0.1, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, math.inf)
ALBEDOS = (0.3, 0.7)
GROUPS = 20
"""Of rays, one of which the jackknife leaves out at a time."""
_RAYS_IN_BIN = 60
LEAST_IN_BIN = 10


def compare(n: Tensor, exact: Tensor) -> dict[str, float]:
    """All numbers for rays with expected n and counted N, `[K]` each.

    mean_n, mean_N, bias: means, and mean_n / mean_N - 1.
    few: mean of n - N over rays that are to meet few fibres, n <= 1.
    scatter: RMS of N about its mean at given n, over that of Poisson numbers of that mean; `deviation` not divided.
    zero, exp: share of rays with N = 0, and mean of exp(-n).
    power_a, mean_power_a: mean of a^N, and of its mean exp(-n (1 - a)) for Poisson numbers, for every a of `ALBEDOS`.
    wrong, wrongly_lit, wrongly_dark: share of rays that the thesis's rule, lit where n <= 1/2, gets wrong.
    brier_poisson, brier_threshold: mean square of v - [N = 0], with v = exp(-n) and by the rule.
    """
    lit, called = exact == 0, n <= 0.5
    hit = lit.to(n)
    deviation, poisson = spread(n, exact)
    found = {
        "mean_n": n.mean(),
        "mean_N": exact.mean(),
        "bias": n.mean() / exact.mean() - 1,
        "few": (n - exact)[n <= 1].mean(),
        "deviation": deviation,
        "scatter": deviation / poisson,
        "zero": hit.mean(),
        "exp": torch.exp(-n).mean(),
        "wrong": (called != lit).to(n).mean(),
        "wrongly_lit": (called & ~lit).to(n).mean(),
        "wrongly_dark": (~called & lit).to(n).mean(),
        "brier_poisson": (torch.exp(-n) - hit).square().mean(),
        "brier_threshold": (called.to(n) - hit).square().mean(),
    }
    for a in ALBEDOS:
        found[f"power_{a:g}"] = (a**exact).mean()
        found[f"mean_power_{a:g}"] = torch.exp(-n * (1 - a)).mean()
    return {name: float(value) for name, value in found.items()}


def brief(n: Tensor, exact: Tensor) -> dict[str, float]:
    """Bias, mean exp(-n) less the share of N = 0, and mean square of exp(-n) - [N = 0]."""
    hit, v = (exact == 0).to(n), torch.exp(-n)
    found = {"bias": n.mean() / exact.mean() - 1, "exp_less_zero": (v - hit).mean(), "brier": (v - hit).square().mean()}
    return {name: float(value) for name, value in found.items()}


def with_errors(prefix: str, statistics: Callable[..., dict[str, float]], *values: Tensor) -> dict[str, float]:
    """`statistics(*values)` as `PREFIX.NAME`, and their standard errors as `error.PREFIX.NAME`, by the jackknife over
    groups of rays; an error is one ray's share at least, where no ray of a kind was met."""
    rays = len(values[0])
    group = torch.arange(rays) % min(GROUPS, rays)
    parts = [statistics(*(value[group != k] for value in values)) for k in range(int(group.max()) + 1)]
    found = statistics(*values)
    factor = math.sqrt(len(parts) - 1)
    errors = {name: factor * float(np.std([part[name] for part in parts])) for name in found}
    named = {f"error.{prefix}.{name}": max(error, 1 / rays) for name, error in errors.items()}
    return {f"{prefix}.{name}": value for name, value in found.items()} | named


def bins(n: Tensor, exact: Tensor) -> dict[str, np.ndarray]:
    """By bin of n, whose ends are `EDGES`: rays, mean n, share of N = 0 and its standard error; where there are fewer
    than ten rays both are 0 and the error 1, as nothing is known there."""
    rows = []
    for low, high in zip(EDGES[:-1], EDGES[1:], strict=True):
        inside = (n >= low) & (n < high)
        count = int(inside.sum())
        if count < LEAST_IN_BIN:
            rows.append((count, 0.0, 0.0, 1.0))
            continue
        share = float((exact[inside] == 0).to(n).mean())
        error = math.sqrt(max(share * (1 - share), 1 / count) / count)
        rows.append((count, float(n[inside].mean()), share, error))
    names = ("bins.rays", "bins.n", "bins.zero", "error.bins.zero")
    return dict(zip(names, np.array(rows).T, strict=True))


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
