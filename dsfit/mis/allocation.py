"""How many samples each strategy gets."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import nn

from dsfit.context import Context
from dsfit.errors import InputError, as_number, as_real, check_choice
from dsfit.mis.estimators import IntegrandFunction, draw, evaluate
from dsfit.mis.heuristics import Heuristic
from dsfit.mis.variance import best_fractions
from dsfit.proposals.base import Distribution
from dsfit.random import uniforms


@dataclass(frozen=True)
class OptimalAllocation:
    """Fractions of least predicted variance x cost, from a pilot of independent samples.

    Fields:
        pilot: samples of the pilot in total, drawn equally from the strategies and then thrown away, so the estimate
            stays unbiased.
        costs: cost of one sample of each strategy in any unit (`measure_costs` gives seconds); left out, all equal.
        minimum: least fraction of any strategy, so that a region that the pilot missed is still covered.
    """

    pilot: int = 1024
    costs: tuple[float, ...] | None = None
    minimum: float = 0.02

    def __post_init__(self) -> None:
        if isinstance(self.pilot, bool) or not isinstance(self.pilot, int) or self.pilot < 2:
            raise InputError("allocation.pilot", self.pilot, "an integer >= 2")
        if self.costs is not None:
            costs = as_real("allocation.costs", self.costs, torch.float64)
            if costs.ndim != 1 or not bool((costs > 0).all()):
                raise InputError("allocation.costs", self.costs, "a list of numbers > 0")
            object.__setattr__(self, "costs", tuple(costs.tolist()))
        object.__setattr__(self, "minimum", as_number("allocation.minimum", self.minimum, 0.0, 1.0))


def parse_allocation(allocation: Any, strategies: int, samples: int) -> list[float] | OptimalAllocation:
    """Fractions of the samples for each strategy, or the pilot rule that will find them.

    Args:
        allocation: one of
            - "equal" or None;
            - a sequence of integers: the counts, >= 0, with sum `samples`;
            - a sequence of floats: the fractions, >= 0, with sum 1;
            - {"kind": "proportional", "weights": [...]}: fractions proportional to weights >= 0;
            - "optimal", {"kind": "optimal", "pilot": ..., "costs": ..., "minimum": ...} or an `OptimalAllocation`.
        strategies: S.
        samples: N.

    Raises:
        InputError: anything else.
    """
    if isinstance(allocation, OptimalAllocation):
        return allocation
    if allocation is None:
        allocation = "equal"
    options: dict[str, Any] = {}
    if isinstance(allocation, Mapping):
        options = {k: v for k, v in allocation.items() if k != "kind"}
        allocation = allocation.get("kind", "")
    if isinstance(allocation, str):
        check_choice("allocation", allocation, ("equal", "proportional", "optimal"))
        known = {"equal": (), "proportional": ("weights",), "optimal": ("pilot", "costs", "minimum")}[allocation]
        for name in options:
            check_choice(f"allocation {allocation!r} parameter", name, known)
        if allocation == "equal":
            return [1 / strategies] * strategies
        if allocation == "optimal":
            return OptimalAllocation(**options)
        weights = _numbers("allocation.weights", options.get("weights", ()), strategies)
        return [w / sum(weights) for w in weights]
    given = allocation.tolist() if hasattr(allocation, "tolist") else allocation
    numbers = _numbers("allocation", given, strategies)
    whole = all(isinstance(n, int) for n in given)
    if (whole and sum(numbers) != samples) or (not whole and not math.isclose(sum(numbers), 1.0, rel_tol=1e-6)):
        raise InputError("allocation", given, f"integer counts with sum {samples} (samples), or floats with sum 1")
    return [n / sum(numbers) for n in numbers]


def _numbers(field: str, values: Any, size: int) -> list[float]:
    allowed = f"{size} finite numbers >= 0, one for each strategy, not all 0"
    numbers = as_real(field, values, torch.float64)
    if numbers.shape != (size,) or not bool((numbers >= 0).all()) or not 0 < float(numbers.sum()) < math.inf:
        raise InputError(field, values, allowed)
    return numbers.tolist()


def split_counts(samples: int, fractions: Sequence[float]) -> list[int]:
    """Whole counts with sum `samples` by largest remainders; at least 1 wherever the fraction is positive.

    Raises:
        InputError: fewer samples than strategies with a positive fraction.
    """
    used = [f > 0 for f in fractions]
    if samples < sum(used):
        raise InputError("samples", samples, f"at least one for each of {sum(used)} strategies (and replicate)")
    exact = [samples * f / sum(fractions) for f in fractions]
    counts = [max(math.floor(x + 1e-9), int(u)) for x, u in zip(exact, used, strict=True)]
    order = sorted(range(len(exact)), key=lambda s: counts[s] - exact[s])
    while sum(counts) > samples:
        counts[max(range(len(counts)), key=lambda s: (counts[s] > 1, counts[s] - exact[s]))] -= 1
    for s in [s for s in order if used[s]][: samples - sum(counts)]:
        counts[s] += 1
    return counts


def pilot_fractions(
    rule: OptimalAllocation,
    integrand: IntegrandFunction,
    distributions: Sequence[Distribution],
    context: Context,
    heuristic: Heuristic,
    model: str,
    generator: torch.Generator,
) -> tuple[list[float], int]:
    """Fractions by `best_fractions` on pilot samples as nodes with weights 1 / (Q P), and the pilot's samples per
    context.

    One set of fractions serves the whole batch: the least mean over contexts of the variance relative to (∫|F|)^2.
    """
    size = len(distributions)
    if size == 1:
        return [1.0], 0
    each = -(-rule.pilot // size)
    values, logs = [], []
    for s, distribution in enumerate(distributions):
        shape = (each, *context.batch_shape)
        u = uniforms(shape, distribution.dimension, generator=generator, dtype=context.dtype, device=context.device)
        with torch.no_grad():
            omega, log_p = draw(distributions, s, u)
            values.append(evaluate(integrand, omega, context))
        logs.append(log_p)
    log_p = torch.cat(logs, dim=1)
    weight = torch.exp(-torch.logsumexp(log_p, dim=0)) / each
    fractions, _ = best_fractions(
        torch.cat(values), weight, log_p, heuristic, model=model, costs=rule.costs, minimum=rule.minimum
    )
    return fractions.tolist(), each * size


def measure_costs(
    integrand: IntegrandFunction,
    proposals: Sequence[nn.Module],
    context: Context,
    *,
    generator: torch.Generator,
    samples: int = 4096,
    repeats: int = 5,
) -> tuple[float, ...]:
    """Median seconds per sample of each strategy: drawing, all densities, the integrand.

    Timings differ from run to run, so an allocation that uses them is not reproducible.
    """
    costs = []
    with torch.no_grad():
        distributions = [proposal(context) for proposal in proposals]
        for s, distribution in enumerate(distributions):
            shape = (samples, *context.batch_shape)
            u = uniforms(shape, distribution.dimension, generator=generator, dtype=context.dtype, device=context.device)
            seconds = []
            for _ in range(repeats + 1):
                start = time.perf_counter()
                omega, _ = draw(distributions, s, u)
                evaluate(integrand, omega, context)
                if context.device.type == "cuda":
                    torch.cuda.synchronize(context.device)
                seconds.append((time.perf_counter() - start) / samples)
            costs.append(sorted(seconds[1:])[repeats // 2])
    return tuple(costs)
