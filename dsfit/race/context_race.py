"""A race at one context: single estimates, one by one, as a renderer calls them."""

from __future__ import annotations

import statistics
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from dsfit.context import Context
from dsfit.quality import Nodes
from dsfit.race.clock import Ready, timed
from dsfit.race.peer import Sampler
from dsfit.race.statistics import centred, relative_squared, rmse
from dsfit.random import child

GROWTH = 4
_AT_REPEATS = 5
_SHARE = 0.25
"""Share of the seconds left that estimates of one length may take beyond the fewest."""
_CHUNK = 2**14


@dataclass(frozen=True)
class ContextPlan:
    """How long a peer runs at one context.

    Attributes:
        seconds: for all its estimates there; it stops growing when the next step would not fit.
        seeds: estimates for every number of samples, as many as fit, at least `fewest`.
        most_samples: of one estimate.
    """

    seconds: float = 2.0
    seeds: int = 64
    fewest: int = 8
    most_samples: int = 2**20


def predicted_variance(sampler: Sampler, nodes: Nodes, truth: Tensor, dtype: torch.dtype) -> float:
    """Variance of one sample relative to |truth|^2 by quadrature: `sum_c (int F_c^2 / p - I_c^2) / |I|^2`; nan where
    the peer's density is not to be had."""
    total = 0.0
    squared = nodes.weight * nodes.value.square().sum(-1)
    for start in range(0, len(squared), _CHUNK):
        part = slice(start, start + _CHUNK)
        log_p = sampler.log_prob(nodes.omega[part].to(dtype).unsqueeze(1))
        if log_p is None:
            return float("nan")
        weight = torch.exp(-log_p.to(torch.float64).reshape(-1))
        total += float(torch.where(squared[part] > 0, squared[part] * weight, 0.0).sum())
    size = float(truth.square().sum())
    return total / size - 1


def race_context(
    ready: Ready,
    context: Context,
    truth: Tensor,
    plan: ContextPlan,
    generator: torch.Generator,
    *,
    allowance: float,
    nodes: Nodes | None = None,
) -> dict[str, Any]:
    """Errors and times at one context of batch shape `[1]`; `truth` `[C]`.

    Every number of samples (growing by 4) gets up to `plan.seeds` independent estimates, each timed by itself; the
    time of a point is their median. `at` is timed on its own, several times where it is quick. `scouts` are times of
    longer estimates, one each, for which there were not the seconds to measure an error.
    """
    with torch.no_grad():
        sampler, at = _at(ready, context, plan)
        predicted = float("nan")
        if nodes is not None:
            predicted = predicted_variance(sampler, nodes, truth, context.dtype)
        points: list[dict[str, Any]] = []
        spent, samples = 0.0, sampler.least if sampler.least > 1 else GROWTH
        while samples <= plan.most_samples or not points:
            # a call has a price of its own, so the time of a longer one is measured and not inferred
            _, expected = timed(lambda samples=samples: sampler.estimate(samples, child(generator)))
            spent += expected
            left = plan.seconds - spent
            count = int(max(plan.fewest, min(plan.seeds, _SHARE * left / max(expected, 1e-9))))
            if points and count * expected > left:
                break
            point = _point(sampler, samples, count, truth, generator, allowance, predicted)
            points.append(point)
            spent += point.pop("spent")
            samples *= GROWTH
            if GROWTH * point["seconds"][1] > plan.seconds - spent:
                break
        scouts = _scouts(sampler, points[-1], plan, generator)
    return {"at_seconds": at, "points": points, "scouts": scouts, "predicted_variance": predicted}


def _scouts(
    sampler: Sampler, last: dict[str, Any], plan: ContextPlan, generator: torch.Generator
) -> list[dict[str, Any]]:
    """Times of single longer estimates: where a call has a price of its own, the time does not grow with the samples as
    it would be extrapolated."""
    found, samples, seconds = [], last["samples"], last["seconds"][1]
    while GROWTH * seconds <= plan.seconds and GROWTH * samples <= plan.most_samples:
        samples *= GROWTH
        _, seconds = timed(lambda samples=samples: sampler.estimate(samples, child(generator)))
        found.append({"samples": samples, "seconds": seconds})
    return found


def _at(ready: Ready, context: Context, plan: ContextPlan) -> tuple[Sampler, float]:
    times: list[float] = []
    while True:
        sampler, seconds = timed(lambda: ready.peer.at(context))
        times.append(seconds)
        if len(times) == _AT_REPEATS or sum(times) > 0.2 * plan.seconds:
            return sampler, statistics.median(times)


def _point(
    sampler: Sampler, samples: int, count: int, truth: Tensor, generator: torch.Generator, allowance: float,
    predicted: float,
) -> dict[str, Any]:  # fmt: skip
    found, times = [], []
    for _ in range(count):
        one = child(generator)
        value, seconds = timed(lambda one=one: sampler.estimate(samples, one))
        found.append(value.reshape(-1).to(torch.float64))
        times.append(seconds)
    values = torch.stack(found)
    deviations = (values - truth) / torch.linalg.vector_norm(truth)
    known = max(predicted, 0.0) if predicted == predicted else 0.0
    test = centred(deviations, allowance, (known / samples) ** 0.5)
    quartiles = torch.tensor(times, dtype=torch.float64).quantile(torch.tensor([0.25, 0.5, 0.75], dtype=torch.float64))
    return {
        "samples": samples,
        "seconds": quartiles.tolist(),
        "rmse": rmse(relative_squared(values, truth)).to_dict(),
        "tested": test.tested,
        "p_value": test.p_value,
        "bias": test.bias,
        "spent": sum(times),
    }
