"""Fits to samples only against the fit by quadrature: excess over evaluations of the integrand and over seconds.

Every fit, by samples or by quadrature, is judged on finer quadrature nodes than any fit saw. Seconds are those of the
fit alone, with JAX compiled before, and for the quadrature those of its nodes too.
"""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np
import torch
from torch import nn

from dsfit import Context, DualScattering, Fiber, Integrand, StructuredProposal, excess, reference
from dsfit.errors import InputError
from dsfit.figures import Close, Data, Estimate, Experiment, Measured, Settings, Work
from dsfit.fit.stochastic import Adam, GaussNewton, NoisyRadiance, fit_stochastic
from dsfit.fit.stochastic.gradients import PLANS, sampled_gradient, variance_factor
from dsfit.proposals import AmortisedProposal
from dsfit.scene.lights import VonMisesFisherLights
from dsfit.streams import ContextStream
from experiments._stochastic_fit_runs import Judge, by_quadrature, by_samples, spread, together

DEVIATION = {"lognormal": 1.0, "roulette": 3.0}
"""Relative standard deviation of noisy light, by its law."""
ADAM_AT = 45.0
"""Inclination of the noiseless scenes where Adam runs too, in degrees."""


class Scene(Settings):
    """A preset seen at `theta_r_deg` behind `n` fibres; in a furnace, or with a lobe of light of this width; with light
    that is `noise`: "lognormal", or "roulette" (nothing, or ten times as much)."""

    preset: str
    theta_r_deg: float
    n: float
    light_width_deg: float | None = None
    noise: str | None = None


class StochasticFit(Settings):
    """Gauss-Newton takes `steps` of `samples` (twice as many with noise), Adam as many evaluations in steps of
    `adam_samples`; `rtol` is the accuracy of what judges; `stream_*` are for one network over a stream of contexts,
    `gradient_*` for the variance of gradients."""

    seeds: int = 3
    steps: int = 12
    samples: int = 512
    adam_samples: int = 64
    rtol: float = 1e-5
    stream_steps: int = 200
    stream_contexts: int = 16
    gradient_samples: int = 128
    gradient_repeats: int = 60
    scenes: list[Scene]


def compute(settings: StochasticFit, work: Work) -> Data:
    """Single contexts, the stream, and gradients."""
    arrays, record = single_contexts(settings, work)
    arrays |= stream(settings, work) | gradients(settings, work)
    return Data(arrays, record | {"plans": list(PLANS), "seeds": settings.seeds})


def integrand_of(preset: str, light: Any = None) -> Integrand:
    """The integrand of a preset."""
    return Integrand(DualScattering(Fiber.preset(preset), precision="table"), light)


def methods_for(scene: Scene, settings: StochasticFit) -> dict[str, dict[str, Any]]:
    """What to run: Gauss-Newton everywhere; Adam at as many evaluations where a comparison is wanted."""
    size = settings.samples * (1 if scene.noise is None else 2)
    newton = {"samples_per_step": size, "steps": settings.steps, "solver": GaussNewton()}
    few = settings.adam_samples
    adam = {"samples_per_step": few, "steps": size * settings.steps // few, "solver": Adam(0.05)}
    if scene.noise is not None:
        return {"gauss_newton": newton, "two_draws": {**newton, "draws": 2}, "adam": adam}
    return {"gauss_newton": newton, **({"adam": adam} if scene.theta_r_deg == ADAM_AT else {})}


def single_contexts(settings: StochasticFit, work: Work) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Contexts of the furnace, a narrow light, and noisy lights."""
    compiled: set[int] = set()
    start_excess, known, rows = [], [], []
    runs: dict[str, list[Any]] = {"gauss_newton": [], "two_draws": [], "adam": []}
    where: dict[str, list[int]] = {name: [] for name in runs}
    for k, scene in enumerate(settings.scenes):
        if scene.noise is not None and scene.noise not in DEVIATION:
            raise InputError(f"scenes.{k}.noise", scene.noise, " or ".join(DEVIATION))
        light = None
        if scene.light_width_deg is not None:
            kappa = VonMisesFisherLights.kappa_of_width(math.radians(scene.light_width_deg))
            light = VonMisesFisherLights([[0.3, 2.5]], kappa, ambient=0.02)
        integrand = integrand_of(scene.preset, light)
        context = Context(math.radians(scene.theta_r_deg), 0.0, scene.n)
        extra = {} if light is None else {"extra": {"light": light.proposal()}}
        start = StructuredProposal(integrand.bsdf, context, **extra)
        judge = Judge(integrand, context, settings.rtol)
        size = sum(p.numel() for p in start.parameters() if p.requires_grad)
        if size not in compiled:
            compiled.add(size)
            by_samples(integrand, start, context, judge, 0, False, samples_per_step=64, steps=1)
        rows.append({**scene.model_dump(), "parameters": size})
        start_excess.append(judge(start))
        known.append(by_quadrature(integrand, start, context, judge))
        for name, options in methods_for(scene, settings).items():
            where[name].append(k)
            runs[name].append([
                by_samples(noisy(integrand, scene, seed), start, context, judge, seed, name != "adam", **options)
                for seed in range(settings.seeds)
            ])  # fmt: skip
        work.say(f"{k + 1} of {len(settings.scenes)} contexts")
    arrays = {"start": np.array(start_excess)}
    arrays |= {f"quadrature.{key}": np.array([row[key] for row in known]) for key in known[0]}
    for name in [name for name in runs if runs[name]]:
        arrays[f"{name}.scenes"] = np.array(where[name])
        arrays |= {f"{name}.{key}": value for key, value in together(runs[name]).items()}
    return arrays, {"scenes": rows}


def noisy(integrand: Integrand, scene: Scene, seed: int) -> Any:
    """The integrand with the scene's noise."""
    return NoisyRadiance(integrand, DEVIATION[scene.noise], scene.noise, seed=seed) if scene.noise else integrand


def stream(settings: StochasticFit, work: Work) -> dict[str, np.ndarray]:
    """One proposal for all contexts, trained on samples of a stream of them; judged at others."""
    integrand = integrand_of("blond")
    contexts = ContextStream(theta="angle", rule="mixed", theta_max=math.radians(85.0))
    test = contexts.draw(settings.stream_contexts, torch.Generator().manual_seed(99))
    start, marks, size = AmortisedProposal(integrand.bsdf), (0, 10, 30, 100), (64, 32)
    curves = []
    for seed in range(settings.seeds):
        curve: list[tuple[int, float, float, float]] = []
        judging = 0.0

        def judge(evaluations: int, seconds: float, proposal: nn.Module, curve: Any = curve) -> None:
            found = excess(integrand, proposal, test, 2e-2).value
            curve.append((evaluations, seconds, float(found.median()), float(found.max())))

        def watch(progress: Any, proposal: nn.Module, judge: Any = judge) -> None:
            nonlocal judging
            began = time.perf_counter()
            if progress.step in marks:
                judge(progress.evaluations - size[0] * size[1], progress.seconds - judging, proposal)
            judging += time.perf_counter() - began

        found = fit_stochastic(
            start, integrand, contexts, solver=Adam(0.01, 1e-4), samples_per_step=size[0], contexts_per_step=size[1],
            steps=settings.stream_steps, held_out=4096, watch=watch, seed=seed,
        )  # fmt: skip
        judge(found.evaluations, found.seconds - judging, found.proposal)
        work.say(f"stream, {seed + 1} of {settings.seeds}")
        curves.append(curve)
    whole = np.array(curves)
    arrays = {"stream.evaluations": whole[0, :, 0], "stream.seconds": whole[..., 1]}
    for k, name in ((2, "median"), (3, "worst")):
        value = np.log10(whole[..., k])
        error = spread(value.T[:, :, None])[:, :, 0].T
        arrays |= {f"stream.log10_{name}": value, f"stream.log10_{name}_error": error}
    return arrays


def gradients(settings: StochasticFit, work: Work) -> dict[str, np.ndarray]:
    """By what factor each device lowers the variance of the gradient, with 95 % intervals, at equal evaluations."""
    integrand, context = integrand_of("blond"), Context(math.radians(45.0), 0.0, 3.0)
    start = StructuredProposal(integrand.bsdf, context)
    found = fit_stochastic(start, integrand, context, samples_per_step=256, steps=3)
    past = [found.state["run"]["replay"]["laws"][k] for k in range(3)]
    scale = math.log(float(reference(integrand, context, 1e-5).m_star))
    rows, count = {}, settings.gradient_samples
    for name in PLANS:
        g = torch.Generator().manual_seed(1)
        rows[name] = torch.stack([
            sampled_gradient(integrand, found.proposal, context, name, count, g, log_scale=scale, past=past)
            for _ in range(settings.gradient_repeats)
        ])  # fmt: skip
        work.say(f"gradient, {name}")
    g = torch.Generator().manual_seed(2)
    factor, low, high = np.log10([variance_factor(rows["plain"], rows[name], g) for name in PLANS]).T
    found_arrays = {"log10_factor": factor, "log10_low": low, "log10_high": high, "error": (high - low) / (2 * 1.96)}
    return {f"gradients.{name}": value for name, value in found_arrays.items()}


EXPERIMENT = Experiment(
    title="Fits to samples only",
    shows="Excess of fits that see samples of the integrand only over evaluations and seconds, against the fit by "
    "quadrature; with noisy light; one network over a stream of contexts; variance of gradients.",
    settings=StochasticFit,
    compute=compute,
    minutes=6.0,
    reproduces={
        "*seconds": Measured(),
        "start": Close(1e-5),
        "quadrature.excess": Close(0.02),
        "quadrature.evaluations": Close(0.05),
        "stream.evaluations": Close(0.05),
        "stream.log10_median": Estimate(error="stream.log10_median_error", most=math.inf),
        "stream.log10_worst": Estimate(error="stream.log10_worst_error", most=math.inf),
        "gradients.log10_*": Estimate(error="gradients.error", most=math.inf),
        "*.log10_excess": Estimate(error="*.log10_excess_error", most=math.inf),
        "*.evaluations": Estimate(error="*.evaluations_error", most=math.inf),
    },
    small=(
        "seeds=2",
        "steps=2",
        "samples=64",
        "rtol=1e-2",
        "stream_steps=11",
        "stream_contexts=2",
        "gradient_samples=16",
        "gradient_repeats=4",
        'scenes=[{preset="blond", theta_r_deg=45.0, n=3.0},'
        ' {preset="blond", theta_r_deg=45.0, n=3.0, noise="roulette"}]',
    ),
)
