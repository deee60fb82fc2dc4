"""A race over a stream of contexts, a few samples in each, as a renderer meets them."""

from __future__ import annotations

import statistics
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from dsfit.context import Context
from dsfit.race.clock import Ready, timed
from dsfit.race.peer import Sampler
from dsfit.race.statistics import centred, relative_squared, rmse
from dsfit.random import child

GROWTH = 4
_REPEATS = 3
_AT_SHARE = 0.25
"""Share of a pass's seconds after which no more contexts are made ready one by one."""


@dataclass(frozen=True)
class StreamPlan:
    """How long a peer runs over the stream.

    Attributes:
        seconds: about the longest pass; the number of samples grows until the next pass would take longer.
        batch: contexts at once.
        fewest: contexts of the subset for peers whose work per context takes longer than that.
        most_samples: per context.
    """

    seconds: float = 6.0
    batch: int = 1000
    fewest: int = 16
    most_samples: int = 2**14


@dataclass
class _Pass:
    values: Tensor
    at: float
    estimate: float


def race_stream(
    ready: Ready, contexts: Context, truth: Tensor, plan: StreamPlan, generator: torch.Generator, *, allowance: float
) -> tuple[dict[str, Any], Tensor]:
    """Errors and times over contexts `[N]` with integrals `truth` `[N, C]`, and the relative errors `[M]` of the last
    pass.

    Every pass takes S samples in each context, batch by batch: `at`, then one estimate. Errors are root means over the
    contexts of the squared relative error, and the median context's. Peers that work for long at every context run on
    the first M contexts; times are then scaled by N / M (`subset` says M).
    """
    with torch.no_grad():
        samplers, parts, at = None, _batches(contexts, plan.batch), None
        if ready.peer.per_context:
            samplers, parts, at = _some(ready, contexts, plan)
        count = sum(len(part) for part in parts)
        scale, truth = len(contexts) / count, truth[:count].to(torch.float64)
        least = max(s.least for s in samplers) if samplers else ready.peer.at(parts[0]).least
        points: list[dict[str, Any]] = []
        samples, ats = least, []
        while True:
            passes = [_pass(ready, parts, samplers, samples, generator)]
            while len(passes) < _REPEATS and scale * passes[0].estimate < plan.seconds / 20:
                passes.append(_pass(ready, parts, samplers, samples, generator))
            ats += [one.at for one in passes]
            points.append(_point(passes, samples, truth, scale, allowance))
            expected = _next(points) / scale
            samples *= GROWTH
            if expected > plan.seconds or samples > plan.most_samples:
                break
        squared = relative_squared(passes[-1].values, truth)
    seconds = scale * (statistics.median(ats) if at is None else at)
    facts = {"contexts": len(contexts), "subset": count, "at_seconds": seconds, "points": points}
    return facts, torch.sqrt(squared)


def _next(points: list[dict[str, Any]]) -> float:
    """Seconds that a pass with more samples will take: a price per call and one per sample, as far as known. After the
    first pass only the price of the calls is: peers that are called context by context spend nearly all on it."""
    last = points[-1]
    if len(points) == 1:
        return last["seconds"]
    slope = (last["seconds"] - points[-2]["seconds"]) / (last["samples"] - points[-2]["samples"])
    return last["seconds"] + max(slope, 0.0) * (GROWTH - 1) * last["samples"]


def _batches(contexts: Context, size: int) -> list[Context]:
    return [contexts[start : start + size] for start in range(0, len(contexts), size)]


def _some(ready: Ready, contexts: Context, plan: StreamPlan) -> tuple[list[Sampler], list[Context], float]:
    """Samplers of the first contexts, one by one, as many as get ready in a share of the plan's seconds; and the
    seconds taken."""
    samplers, parts, spent = [], [], 0.0
    for k in range(len(contexts)):
        if len(parts) >= plan.fewest and spent > plan.seconds * _AT_SHARE:
            break
        part = contexts[k : k + 1]
        sampler, seconds = timed(lambda part=part: ready.peer.at(part))
        samplers.append(sampler)
        parts.append(part)
        spent += seconds
    return samplers, parts, spent


def _pass(
    ready: Ready, parts: list[Context], samplers: list[Sampler] | None, samples: int, generator: torch.Generator
) -> _Pass:
    values, at, estimate = [], 0.0, 0.0
    for k, part in enumerate(parts):
        if samplers is None:
            sampler, seconds = timed(lambda part=part: ready.peer.at(part))
            at += seconds
        else:
            sampler = samplers[k]
        one = child(generator)
        value, seconds = timed(lambda sampler=sampler, one=one: sampler.estimate(samples, one))
        estimate += seconds
        values.append(value.to(torch.float64))
    return _Pass(torch.cat(values), at, estimate)


def _point(passes: list[_Pass], samples: int, truth: Tensor, scale: float, allowance: float) -> dict[str, Any]:
    values = torch.cat([one.values for one in passes])
    truths = truth.repeat(len(passes), 1)
    squared = relative_squared(values, truths)
    test = centred((values - truths) / torch.linalg.vector_norm(truths, dim=-1, keepdim=True), allowance)
    return {
        "samples": samples,
        "seconds": scale * statistics.median(one.estimate for one in passes),
        "rmse": rmse(squared).to_dict(),
        "median": float(squared.sqrt().median()),
        "p95": float(squared.sqrt().quantile(0.95)),
        "tested": test.tested,
        "p_value": test.p_value,
        "bias": test.bias,
    }
