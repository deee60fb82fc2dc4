"""Error against samples and time: the measurement behind every comparison of estimators."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from dsfit.context import Context
from dsfit.errors import InputError
from dsfit.mis.estimate import Estimate, estimate
from dsfit.mis.estimators import IntegrandFunction


@dataclass(frozen=True)
class Convergence:
    """What `convergence` returns, for K sample counts.

    Fields:
        samples: directions actually drawn per context `[K]`.
        error: relative RMSE `[K, *batch]`: sqrt(mean over repeats of |value - reference|^2) / |reference|, |.| over
            channels.
        low, high: ends of the 95 % bootstrap interval of `error` over repeats (percentiles) `[K, *batch]`.
        bias: |mean over repeats of value - reference| / |reference| `[K, *batch]`; of order error / sqrt(repeats) if
            unbiased.
        seconds: median wall-clock seconds of one estimate (whole batch) `[K]`.
        estimates: one `Estimate` of each count, the last repeat.
    """

    samples: Tensor
    error: Tensor
    low: Tensor
    high: Tensor
    bias: Tensor
    seconds: Tensor
    estimates: tuple[Estimate, ...]


def convergence(
    integrand: IntegrandFunction,
    proposals: nn.Module | Sequence[nn.Module],
    context: Context,
    sample_counts: Sequence[int],
    repeats: int,
    reference: Any,
    *,
    generator: torch.Generator,
    resamples: int = 1000,
    **options: Any,
) -> Convergence:
    """Relative error of `estimate` over independent repeats, for each number of samples.

    Args:
        integrand, proposals, context: as for `estimate`.
        sample_counts: K numbers of samples.
        repeats: independent estimates of each, >= 2; all of them are timed, the median is reported.
        reference: the true value `[*batch, C]`, or an object with that as `.value` (its error must be far below the
            errors measured).
        generator: source of all random numbers, the bootstrap's included.
        resamples: bootstrap resamples.
        options: passed to `estimate` (heuristic, model, allocation, uniforms, ...).

    Raises:
        InputError: fewer than 2 repeats, a zero reference, and what `estimate` raises.
    """
    if repeats < 2:
        raise InputError("repeats", repeats, "an integer >= 2")
    truth = reference if isinstance(reference, Tensor) else reference.value
    truth = truth.to(dtype=context.dtype, device=context.device)
    size = torch.linalg.vector_norm(truth, dim=-1)
    if not bool((size > 0).all()):
        raise InputError("reference", float(size.min()), "values whose norm over channels is positive")
    rows: dict[str, list[Any]] = {name: [] for name in ("samples", "error", "low", "high", "bias", "seconds", "last")}
    for count in sample_counts:
        results = [
            estimate(integrand, proposals, context, count, generator=generator, **options) for _ in range(repeats)
        ]
        deviation = (torch.stack([result.value.detach() for result in results]) - truth) / size.unsqueeze(-1)
        squared = deviation.square().sum(dim=-1)
        picks = torch.randint(repeats, (resamples, repeats), generator=generator, device=generator.device)
        means = torch.stack([squared[pick].mean(dim=0) for pick in picks.to(squared.device)]).sqrt()
        rows["samples"].append(results[-1].samples)
        rows["error"].append(squared.mean(dim=0).sqrt())
        rows["low"].append(means.quantile(0.025, dim=0))
        rows["high"].append(means.quantile(0.975, dim=0))
        rows["bias"].append(torch.linalg.vector_norm(deviation.mean(dim=0), dim=-1))
        rows["seconds"].append(sorted(result.seconds for result in results)[repeats // 2])
        rows["last"].append(results[-1])
    stacked = {name: torch.stack(rows[name]) for name in ("error", "low", "high", "bias")}
    seconds = torch.tensor(rows["seconds"], dtype=torch.float64)
    return Convergence(torch.tensor(rows["samples"]), **stacked, seconds=seconds, estimates=tuple(rows["last"]))
