"""Variances measured by Monte Carlo, with standard errors: the same samples serve every heuristic."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from dsfit.mis import Optimal, contribution, estimate, heuristic, split_counts
from dsfit.mis.estimators import draw, draw_mixture
from dsfit.random import uniforms
from experiments._mis_spot import Spot, proposals


@dataclass(frozen=True)
class Measured:
    """Relative variance N Var / |∫F|^2 and relative mean, each with its standard error over the repeats."""

    variance: float
    variance_se: float
    mean: float
    mean_se: float

    @staticmethod
    def of(values: Tensor, variances: Tensor, integral: Tensor) -> Measured:
        """From estimates `[R, C]` and N x their estimated variances `[R, C]`."""
        size = integral.square().sum()
        variance, mean = variances.sum(-1) / size, values.sum(-1) / integral.sum()
        root = len(mean) ** 0.5
        return Measured(*(float(x) for one in (variance, mean) for x in (one.mean(), one.std() / root)))


def measure(
    spot: Spot,
    names: Sequence[str],
    shares: Sequence[float],
    rules: Sequence[Any],
    model: str,
    samples: int,
    repeats: int,
    seed: int,
) -> list[Measured]:
    """One result for each rule, from `repeats` independent estimates of `samples` samples."""
    generator = torch.Generator().manual_seed(seed)
    optimal = {k for k, rule in enumerate(rules) if isinstance(heuristic(rule), Optimal)}
    plain = [rule for k, rule in enumerate(rules) if k not in optimal]
    sampled = _multi if model == "multi" else _one
    found = iter(sampled(spot, names, shares, plain, samples, repeats, generator))
    results = []
    for k, rule in enumerate(rules):
        if k not in optimal:
            results.append(Measured.of(*next(found), spot.integral))
            continue
        modules = [proposals(spot.preset)[name] for name in names]
        options = {"model": model, "allocation": list(shares), "generator": generator, "test": False}
        with torch.no_grad():
            one = estimate(spot.integrand, modules, spot.context.expand(repeats), samples, rule, **options)
        results.append(Measured.of(one.value, one.variance, spot.integral))
    return results


@torch.no_grad()
def _multi(
    spot: Spot,
    names: Sequence[str],
    shares: Sequence[float],
    rules: Sequence[Any],
    samples: int,
    repeats: int,
    generator: torch.Generator,
) -> list[tuple[Tensor, Tensor]]:
    """sum_s c_s mean_s z and sum_s c_s var_s z, for every rule `[R, C]`."""
    laws, counts = [spot.distributions[name] for name in names], split_counts(samples, shares)
    fractions = torch.tensor([n / samples for n in counts], dtype=torch.float64)
    totals: list[list[Tensor]] = [[torch.zeros(()), torch.zeros(())] for _ in rules]
    for s, n in enumerate(counts):
        u = uniforms((n, repeats), laws[s].dimension, generator=generator)
        omega, log_p = draw(laws, s, u)
        value = spot.integrand(omega, spot.context)
        for total, rule in zip(totals, rules, strict=True):
            z = contribution(value, log_p, s, fractions, heuristic(rule), names)
            total[0] = total[0] + fractions[s] * z.mean(0)
            total[1] = total[1] + fractions[s] * z.var(0)
    return [(mean, variance) for mean, variance in totals]


@torch.no_grad()
def _one(
    spot: Spot,
    names: Sequence[str],
    shares: Sequence[float],
    rules: Sequence[Any],
    samples: int,
    repeats: int,
    generator: torch.Generator,
) -> list[tuple[Tensor, Tensor]]:
    """mean z and var z, for every rule `[R, C]`, each sample's proposal chosen by the shares."""
    laws, chances = [spot.distributions[name] for name in names], torch.tensor(shares, dtype=torch.float64)
    u = uniforms((samples, repeats), 1 + max(law.dimension for law in laws), generator=generator)
    omega, log_p, choice = draw_mixture(laws, chances, u)
    value = spot.integrand(omega, spot.context)
    found = []
    for rule in rules:
        z = contribution(value, log_p, choice, chances, heuristic(rule), names)
        found.append((z.mean(0), z.var(0)))
    return found
