"""One fit by quadrature or by samples, counted, timed and judged on finer quadrature nodes than any fit saw."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import torch
from torch import nn

from dsfit import Context, Integrand, quadrature_nodes
from dsfit.fit import fit
from dsfit.fit.fit import make_targets, quality
from dsfit.fit.stochastic import fit_stochastic


class Counted:
    """An integrand that counts at how many directions it was asked."""

    def __init__(self, integrand: Integrand) -> None:
        self.integrand, self.count = integrand, 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self.integrand, name)

    def __call__(self, omega: torch.Tensor, context: Context) -> torch.Tensor:
        self.count += omega[..., 0].numel()
        return self.integrand(omega, context)


class Judge:
    """Excess of proposals at one context, on fine quadrature nodes."""

    def __init__(self, integrand: Integrand, context: Context, rtol: float) -> None:
        nodes = quadrature_nodes(integrand, context, rtol=rtol, count=6)
        self.targets = make_targets(None, context, nodes, 1.0, None)

    def __call__(self, proposal: nn.Module) -> float:
        return float(quality(proposal, self.targets)[0])


def by_quadrature(integrand: Integrand, start: nn.Module, context: Context, judge: Judge) -> dict[str, float]:
    """The fit that knows the integral; its seconds are those of its nodes too."""
    counted = Counted(integrand)
    began = time.perf_counter()
    nodes = quadrature_nodes(counted, context, rtol=1e-4)
    found = fit(start, integrand, context, nodes=nodes)
    seconds = time.perf_counter() - began
    return {"excess": judge(found.proposal), "evaluations": counted.count, "seconds": seconds}


def by_samples(
    radiance: Any, start: nn.Module, context: Context, judge: Judge, seed: int, watched: bool, **options: Any
) -> list[tuple[int, float, float]]:
    """One stochastic fit: evaluations, seconds and excess at its end, and if `watched` after every step before that.
    Judging does not count as the fit's time."""
    curve: list[tuple[int, float, float]] = []
    judging = 0.0

    def watch(progress: Any, proposal: nn.Module) -> None:
        nonlocal judging
        if progress.step == 0:  # the start
            return
        began = time.perf_counter()
        # these samples were only drawn: what the proposal is came from those before
        used = progress.evaluations - (progress.evaluations // (progress.step + 1))
        curve.append((used, progress.seconds - judging, judge(proposal)))
        judging += time.perf_counter() - began

    found = fit_stochastic(start, radiance, context, seed=seed, watch=watch if watched else None, **options)
    curve.append((found.evaluations, found.seconds - judging, judge(found.proposal)))
    return curve


def together(runs: list[list[list[tuple[int, float, float]]]]) -> dict[str, np.ndarray]:
    """Curves of `runs[scene][seed]` as arrays `[scenes, seeds, steps]`; one that ended early stays where it ended."""
    length = max(len(curve) for row in runs for curve in row)
    whole = np.array([[curve + curve[-1:] * (length - len(curve)) for curve in row] for row in runs])
    excess = np.log10(whole[..., 2])
    return {
        "evaluations": whole[..., 0],
        "evaluations_error": spread(whole[..., 0]),
        "seconds": whole[..., 1],
        "log10_excess": excess,
        "log10_excess_error": spread(excess),
    }


def spread(values: np.ndarray) -> np.ndarray:
    """Standard deviation of a single run, of the shape of `values` `[scenes, seeds, ...]`: over the seeds of its own
    scene or pooled over scenes, whichever is larger, as three seeds alone may happen to agree; 0 for one seed."""
    if values.shape[1] < 2:
        return np.zeros(values.shape)
    own = values.var(axis=1, ddof=1, keepdims=True)
    return np.broadcast_to(np.sqrt(np.maximum(own, own.mean(axis=0, keepdims=True))), values.shape).copy()
