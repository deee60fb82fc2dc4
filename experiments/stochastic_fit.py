"""Fits to samples only against the fit by quadrature: excess over evaluations of the integrand and over seconds.

    python experiments/stochastic_fit.py [FOLDER]         # FOLDER/stochastic_fit.json (runs/stochastic_fit if left out)
    python experiments/stochastic_fit_plot.py [FOLDER]    # PNG and PDF from that file, and a table in Markdown

Every fit, by samples or by quadrature, is judged on finer quadrature nodes than any fit saw. Seconds are those of the
fit alone, with JAX compiled before, and for the quadrature those of its nodes too. About 5 minutes on a quiet machine.
"""

from __future__ import annotations

import json
import math
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from torch import nn

from dsfit import Context, DualScattering, Fiber, Integrand, StructuredProposal, excess, quadrature_nodes, reference
from dsfit.fit import fit
from dsfit.fit.fit import make_targets, quality
from dsfit.fit.stochastic import Adam, GaussNewton, NoisyRadiance, fit_stochastic
from dsfit.fit.stochastic.gradients import PLANS, sampled_gradient, variance_factor
from dsfit.proposals import AmortisedProposal
from dsfit.scene.lights import VonMisesFisherLights
from dsfit.streams import ContextStream

SEEDS = 3
STEPS = 12
SAMPLES = 512
NARROW = math.radians(3.0)
SCENES: list[tuple[str, float, float, float | None, str | None]] = [
    *(
        (preset, theta, n, None, None)
        for preset in ("blond", "brown", "black")
        for theta, n in ((0.0, 0.0), (45.0, 3.0), (80.0, 20.0))
    ),
    ("blond", 45.0, 3.0, NARROW, None),
    ("blond", 45.0, 3.0, None, "lognormal"),
    ("blond", 45.0, 3.0, None, "roulette"),
]
"""Preset, theta_r in degrees, n, width of a lobe of light if there is one, noise if there is any."""


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

    def __init__(self, integrand: Integrand, context: Context) -> None:
        nodes = quadrature_nodes(integrand, context, rtol=1e-5, count=6)
        self.targets = make_targets(None, context, nodes, 1.0, None)

    def __call__(self, proposal: nn.Module) -> float:
        return float(quality(proposal, self.targets)[0])


def by_quadrature(integrand: Integrand, start: nn.Module, context: Context, judge: Judge) -> dict[str, float]:
    """The fit that knows the integral."""
    counted = Counted(integrand)
    began = time.perf_counter()
    nodes = quadrature_nodes(counted, context, rtol=1e-4)
    found = fit(start, integrand, context, nodes=nodes)
    seconds = time.perf_counter() - began
    return {"excess": judge(found.proposal), "evaluations": counted.count, "seconds": seconds}


def by_samples(
    radiance: Any, start: nn.Module, context: Context, judge: Judge, seed: int, watched: bool, **options: Any
) -> dict[str, Any]:
    """One stochastic fit; `watched`, its whole curve. Judging does not count as the fit's time."""
    curve: list[tuple[int, float, float]] = []
    judging = 0.0

    def watch(progress: Any, proposal: nn.Module) -> None:
        nonlocal judging
        began = time.perf_counter()
        # these samples were only drawn: what the proposal is came from those before
        used = progress.evaluations - (progress.evaluations // (progress.step + 1))
        curve.append((used, progress.seconds - judging, judge(proposal)))
        judging += time.perf_counter() - began

    found = fit_stochastic(start, radiance, context, seed=seed, watch=watch if watched else None, **options)
    last = judge(found.proposal)
    curve.append((found.evaluations, found.seconds - judging, last))
    return {
        "excess": last, "estimate": found.excess_estimate, "error": found.error, "evaluations": found.evaluations,
        "seconds": found.seconds - judging, "steps": found.steps, "curve": curve,
    }  # fmt: skip


def scene(preset: str, light: Any = None) -> Integrand:
    """The integrand of a preset."""
    return Integrand(DualScattering(Fiber.preset(preset), precision="table"), light)


def methods_for(noise: str | None, theta: float) -> dict[str, dict[str, Any]]:
    """What to run: Gauss-Newton everywhere; Adam at as many evaluations where a comparison is wanted."""
    size = SAMPLES if noise is None else 2 * SAMPLES
    newton = {"samples_per_step": size, "steps": STEPS, "solver": GaussNewton()}
    adam = {"samples_per_step": 64, "steps": size * STEPS // 64, "solver": Adam(0.05)}
    if noise is not None:
        return {"gauss_newton": newton, "gauss_newton, two draws": {**newton, "draws": 2}, "adam": adam}
    return {"gauss_newton": newton, **({"adam": adam} if theta == 45.0 else {})}


def single_contexts(say: Callable[[str], None]) -> Iterator[dict[str, Any]]:
    """Contexts of the furnace, a narrow light, and noisy lights; one row each."""
    compiled = set()
    for preset, theta, n, width, noise in SCENES:
        light = None
        if width is not None:
            light = VonMisesFisherLights([[0.3, 2.5]], VonMisesFisherLights.kappa_of_width(width), ambient=0.02)
        integrand, context = scene(preset, light), Context(math.radians(theta), 0.0, n)
        extra = {} if light is None else {"extra": {"light": light.proposal()}}
        start, judge = StructuredProposal(integrand.bsdf, context, **extra), Judge(integrand, context)
        size = sum(p.numel() for p in start.parameters() if p.requires_grad)
        if size not in compiled:
            compiled.add(size)
            by_samples(integrand, start, context, judge, 0, False, samples_per_step=64, steps=1)
        row: dict[str, Any] = {
            "preset": preset, "theta": theta, "n": n, "light": "furnace" if light is None else "lobe of 3°",
            "noise": noise, "start": judge(start), "methods": {}, "parameters": size,
            "quadrature": by_quadrature(integrand, start, context, judge),
        }  # fmt: skip
        for name, options in methods_for(noise, theta).items():
            found = []
            for seed in range(SEEDS):
                deviation = {"lognormal": 1.0, "roulette": 3.0}
                radiance = NoisyRadiance(integrand, deviation[noise], noise, seed=seed) if noise else integrand
                watched = name.startswith("gauss")
                found.append(by_samples(radiance, start, context, judge, seed, watched, **options))
            row["methods"][name] = found
        ends = {name: statistics.median(run["excess"] for run in runs) for name, runs in row["methods"].items()}
        reached = "; ".join(f"{name} {value:.2g}" for name, value in ends.items())
        say(f"{preset} {theta:g} {n:g} {row['light']} {noise}: quadrature {row['quadrature']['excess']:.2g}; {reached}")
        yield row


def stream(say: Callable[[str], None]) -> dict[str, Any]:
    """One proposal for all contexts, trained on samples of a stream of them."""
    integrand = scene("blond")
    contexts = ContextStream(theta="angle", rule="mixed", theta_max=math.radians(85.0))
    test = contexts.draw(16, torch.Generator().manual_seed(99))
    start = AmortisedProposal(integrand.bsdf)
    curve: list[tuple[int, float, list[float]]] = []
    judging = 0.0
    marks = [0, 10, 30, 100]

    def watch(progress: Any, proposal: nn.Module) -> None:
        nonlocal judging
        began = time.perf_counter()
        if progress.step in marks:
            found = excess(integrand, proposal, test, 2e-2).value
            curve.append((progress.evaluations - 2048, progress.seconds - judging, found.tolist()))
        judging += time.perf_counter() - began

    found = fit_stochastic(
        start, integrand, contexts, solver=Adam(0.01, 1e-4), samples_per_step=64, contexts_per_step=32, steps=200,
        held_out=4096, watch=watch,
    )  # fmt: skip
    last = excess(integrand, found.proposal, test, 2e-2).value
    curve.append((found.evaluations, found.seconds - judging, last.tolist()))
    say(f"amortised: median excess {float(last.median()):.2g}, worst {float(last.max()):.2g}")
    return {"curve": curve, "estimate": found.excess_estimate, "error": found.error, "contexts": len(test)}


def gradients(say: Callable[[str], None], samples: int = 128, repeats: int = 60) -> dict[str, list[float]]:
    """By what factor each device lowers the variance of the gradient, with 95 % intervals, at equal evaluations."""
    integrand, context = scene("blond"), Context(math.radians(45.0), 0.0, 3.0)
    start = StructuredProposal(integrand.bsdf, context)
    found = fit_stochastic(start, integrand, context, samples_per_step=256, steps=3)
    past = [found.state["run"]["replay"]["laws"][k] for k in range(3)]
    scale = math.log(float(reference(integrand, context, 1e-5).m_star))
    rows = {}
    for name in PLANS:
        generator = torch.Generator().manual_seed(1)
        rows[name] = torch.stack([
            sampled_gradient(integrand, found.proposal, context, name, samples, generator, log_scale=scale, past=past)
            for _ in range(repeats)
        ])  # fmt: skip
    generator = torch.Generator().manual_seed(2)
    factors = {name: list(variance_factor(rows["plain"], rows[name], generator)) for name in PLANS}
    for name, (factor, low, high) in factors.items():
        say(f"gradient, {name}: variance less by {factor:.3g} [{low:.3g}, {high:.3g}]")
    return factors


def compute(folder: Path) -> None:
    """Run everything and write `stochastic_fit.json`."""

    def say(line: str) -> None:
        print(line, file=sys.stderr, flush=True)

    data: dict[str, Any] = {"single": []}
    folder.mkdir(parents=True, exist_ok=True)

    def keep() -> None:
        (folder / "stochastic_fit.json").write_text(json.dumps(data))

    for row in single_contexts(say):
        data["single"].append(row)
        keep()
    data["stream"] = stream(say)
    keep()
    data["gradients"] = gradients(say)
    keep()


if __name__ == "__main__":
    torch.set_num_threads(1)
    if len(sys.argv) > 2:
        raise SystemExit(__doc__)
    compute(Path(sys.argv[1] if len(sys.argv) > 1 else "runs/stochastic_fit"))
