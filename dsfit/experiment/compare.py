"""One cell of a comparison: every method at one context, by quadrature and by Monte Carlo."""

from __future__ import annotations

import copy
import hashlib
import json
import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dsfit.context import Context
from dsfit.experiment import build
from dsfit.experiment.cells import Job
from dsfit.experiment.judge import judge
from dsfit.experiment.methods import Plan, Setting, make_plan
from dsfit.experiment.planning import plan_of
from dsfit.experiment.rundir import RunDirectory
from dsfit.experiment.schema import EstimateConfig
from dsfit.experiment.store import save_proposal

MAP_STEPS = (121, 121)  # theta_i, phi
TARGET = 0.01


def compare(
    job: Job, directory: RunDirectory | None, say: Callable[[str], None]
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Numbers and arrays of one cell. Fitted proposals are saved on the way; without a directory they are not, and
    there are no arrays."""
    from dsfit.quality import reference as integrate

    config, context = job.config, build.context(job.config, job.identity["context"])
    say("plan")
    planned = plan_of(config, context)
    integrand = planned.integrand
    say("reference")
    clock = time.perf_counter()
    reference = integrate(integrand, context, rtol=config.estimate.rtol)
    # what was left out by a bound counts as error of every estimate
    truth = reference if planned.bound == 0 else integrate(planned.whole, context, rtol=config.estimate.rtol)
    reference_seconds = time.perf_counter() - clock
    setting = Setting(config, integrand, context)
    plans = []
    for method in config.methods:
        say(method.name)
        plans.append(make_plan(method, setting))
    say("quadrature")
    clock = time.perf_counter()
    quality = judge(plans, setting, reference)
    judge_seconds = time.perf_counter() - clock
    found = []
    for method, plan, numbers in zip(config.methods, plans, quality, strict=True):
        if plan.fitted and directory is not None:
            path = directory.proposal_path(job.index, method.name)
            save_proposal(path, plan.strategies[0])
            plan.fit["file"] = path.relative_to(directory.path).as_posix()
        say(f"{method.name}: estimates")
        generator = torch.Generator().manual_seed(_seed(config.estimate.seed, job.identity, method.name))
        curve = _estimates(plan, integrand, context, config.estimate, truth, numbers["variance"], generator)
        found.append({"name": method.name, "kind": method.kind, **plan.description(), **numbers, **curve})
    data = {
        "context": {name: getattr(context, name).item() for name in ("theta_r", "phi_r", "n", "v")},
        "reference": {
            "value": truth.value.tolist(),
            "error": truth.error.tolist(),
            "norm": float(truth.norm),
            "norm_error": float(truth.norm_error),
            "evaluations": int(truth.evaluations),
            "converged": bool(torch.as_tensor(truth.converged).all()),
            "seconds": reference_seconds,
        },
        "plan": planned.to_dict(),
        "judge_seconds": judge_seconds,
        "methods": found,
    }
    return data, {} if directory is None else _maps(integrand, plans, context, float(reference.norm))


def _seed(seed: int, identity: dict[str, Any], name: str) -> int:
    """A seed of its own for every cell and method, which no other cell or method changes."""
    text = json.dumps([seed, identity, name], sort_keys=True)
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "little") >> 1


def _estimates(
    plan: Plan,
    integrand: Any,
    context: Context,
    config: EstimateConfig,
    reference: Any,
    variance: float,
    generator: torch.Generator,
) -> dict[str, Any]:
    """Error and time at every sample count.

    `rounds` batches of `repeats` independent estimates each; the time of one estimate is that of its batch divided by
    `repeats`, as in a renderer that shades many points at once.
    """
    from dsfit.mis.estimate import estimate as run_estimate

    dtype = getattr(torch, config.dtype)
    batch = context.to(dtype).expand(config.repeats)
    strategies = [copy.deepcopy(s).to(dtype) for s in plan.strategies]
    truth = reference.value.to(dtype)
    size = float(torch.linalg.vector_norm(reference.value))
    options = {
        "heuristic": plan.heuristic, "model": plan.model, "allocation": plan.fractions,
        "uniforms": config.uniforms, "generator": generator,
    }  # fmt: skip
    minimum = plan.least_samples(config.uniforms)
    run_estimate(integrand, strategies, batch, max(minimum, min(config.samples)), **options)  # first calls build caches
    points = []
    for samples in sorted({max(minimum, n) for n in config.samples}):
        squared, seconds, claimed, deviation = [], [], [], []
        for _ in range(config.rounds):
            clock = time.perf_counter()
            estimate = run_estimate(integrand, strategies, batch, samples, **options)
            seconds.append((time.perf_counter() - clock) / config.repeats)
            error = (estimate.value - truth).to(torch.float64) / size
            squared.append(error.square().sum(-1))
            deviation.append(error)
            claimed.append(estimate.standard_error.to(torch.float64).square().sum(-1) / size**2)
        points.append(_point(estimate.samples, squared, seconds, claimed, deviation, variance))
    # The optimal heuristic reaches its predicted variance only once alpha is known well enough.
    asymptotic = config.uniforms == "random" and plan.heuristic_name != "optimal"
    needed = _samples_for(points, variance, asymptotic)
    per_sample = points[-1]["seconds"][1] / points[-1]["samples"]
    usable = [p["predicted_rmse"] / p["rmse"] for p in points if p["rmse"] > 0 and math.isfinite(p["predicted_rmse"])]
    return {
        "estimates": points,
        "seconds_per_sample": per_sample,
        "samples_to_1_percent": needed,
        "seconds_to_1_percent": needed * per_sample,
        "predicted_over_measured": float(np.exp(np.mean(np.log(usable))))
        if usable and config.uniforms == "random"
        else math.nan,
    }


def _point(
    samples: int,
    squared: list[Tensor],
    seconds: list[float],
    claimed: list[Tensor],
    deviation: list[Tensor],
    variance: float,
) -> dict[str, Any]:
    all_squared = torch.cat(squared)
    mean, count = float(all_squared.mean()), len(all_squared)
    rmse = math.sqrt(mean)
    spread = float(all_squared.std()) / math.sqrt(count)
    bias = torch.cat(deviation).mean(0)
    return {
        "samples": samples,
        "repeats": count,
        "rmse": rmse,
        "rmse_error": spread / (2 * rmse) if rmse > 0 else 0.0,
        "predicted_rmse": math.sqrt(max(variance, 0.0) / samples) if math.isfinite(variance) else math.inf,
        "claimed_rmse": math.sqrt(float(torch.cat(claimed).mean())),
        "bias": float(torch.linalg.vector_norm(bias)),
        "seconds": np.quantile(seconds, [0.25, 0.5, 0.75]).tolist(),
    }


def _samples_for(points: list[dict[str, Any]], variance: float, asymptotic: bool) -> float:
    """Samples for a relative RMSE of 1 %: from the predicted variance, or else from the measured curve.

    The curve is interpolated in log N and log error; beyond its ends the error is taken to fall as 1 / sqrt(N).
    """
    if asymptotic:
        return max(1.0, variance / TARGET**2)
    log_n = np.log([p["samples"] for p in points])
    log_e = np.minimum.accumulate(np.log([max(p["rmse"], 1e-300) for p in points]))
    goal = math.log(TARGET)
    if log_e[0] <= goal:
        found = log_n[0] + 2 * (log_e[0] - goal)
    elif log_e[-1] > goal:
        found = log_n[-1] + 2 * (log_e[-1] - goal)
    else:
        found = np.interp(-goal, -log_e, log_n)
    return max(1.0, float(np.exp(found)))


def _map_grid(context: Context) -> tuple[Tensor, dict[str, np.ndarray]]:
    theta = torch.linspace(-math.pi / 2, math.pi / 2, MAP_STEPS[0], dtype=torch.float64)
    phi = torch.linspace(-math.pi, math.pi, MAP_STEPS[1], dtype=torch.float64)
    # A pole has no azimuth and an infinite density: draw just beside it.
    theta = theta.clamp(-math.pi / 2 + 1e-3, math.pi / 2 - 1e-3)
    t, p = torch.meshgrid(theta, phi, indexing="ij")
    degrees = {"theta_deg": np.linspace(-90, 90, MAP_STEPS[0]), "phi_deg": np.linspace(-180, 180, MAP_STEPS[1])}
    return torch.stack([t, context.phi_r - p], dim=-1), degrees


def _maps(integrand: Any, plans: list[Plan], context: Context, norm: float) -> dict[str, np.ndarray]:
    """The integrand over its norm, and every plan's density, on a grid of directions."""
    grid, arrays = _map_grid(context)
    with torch.no_grad():
        arrays["integrand"] = _image(torch.linalg.vector_norm(integrand(grid, context), dim=-1) / norm)
        for k, plan in enumerate(plans):
            arrays[f"density_{k}"] = _image(plan.density(grid, context))
    return arrays


def _image(values: Tensor) -> np.ndarray:
    return values.detach().to(torch.float32).numpy()
