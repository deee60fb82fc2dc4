"""What six scenes do not need: what goes, the proven bound, the true error, and the time it saves.

    python experiments/planning.py compute planning.json     # minutes on one core
    python experiments/planning.py plot planning.json planning.png
    python experiments/planning.py table planning.json

`compute` plans each scene, integrates it with and without what goes (quadrature, relative error 1e-7), and times
evaluation, quadrature nodes and a fit of the structured proposal before and after, in turns, so that a busy machine
slows both. Even without a plan the BSDF skips a half of F whose share is exactly zero in a whole batch, so evaluation
and the kernels' evaluation are also compared with computing every term (v = 1/2): what a renderer does that neither
plans nor looks.
"""

from __future__ import annotations

import dataclasses
import json
import math
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

import dsfit
from dsfit.bsdf import DualScattering, Fiber
from dsfit.bsdf.terms import Terms
from dsfit.context import Context
from dsfit.experiment.methods import structured_start
from dsfit.kernels import HairKernel
from dsfit.scene.integrand import Integrand

DEG = math.pi / 180
DIRECTIONS, ROUNDS, FIT_ROUNDS = 1024, 31, 3
TOLERANCE = 0.01


@dataclass(frozen=True)
class Scene:
    """A fibre and the contexts it is seen in; angles in degrees."""

    name: str
    fiber: str
    theta_r: tuple[float, ...] = (0.0, 45.0, 75.0)
    n: tuple[float, ...] = (0.0,)
    v: tuple[float, ...] | None = None
    d_b: float = 0.7
    overrides: dict[str, Any] = field(default_factory=dict)

    def integrand(self) -> Integrand:
        """In a furnace of radiance 1."""
        fiber = Fiber.preset(self.fiber, **self.overrides)
        return Integrand(DualScattering(fiber, d_b=self.d_b, precision="table"))

    def context(self) -> Context:
        """Every view with every pair of n and v."""
        theta = torch.tensor(self.theta_r, dtype=torch.float64)[:, None] * DEG
        n = torch.tensor(self.n, dtype=torch.float64)
        v = None if self.v is None else torch.tensor(self.v, dtype=torch.float64)
        return Context(theta, n=n, v=v).reshape(-1)


SCENES = (
    Scene("single scattering only", "blond"),
    Scene("black hair", "black", n=(0.0, 1.0, 3.0), v=(1.0, 0.4, 0.1)),
    Scene("back-lit deep hair", "blond", n=(20.0,), v=(0.0,)),
    Scene("grey fibre", "blond", n=(3.0,), v=(0.2,), overrides={"sigma_a": (0.1, 0.1, 0.1)}),
    Scene("no back scattering", "blond", n=(3.0,), v=(0.2,), d_b=0.0),
    Scene("no glints", "blond", (82.0, 85.0, 88.0), overrides={"beta": [3 * DEG, 1.5 * DEG, 6 * DEG]}),
)


def compute(path: Path) -> None:
    """All scenes, into a JSON file."""
    torch.set_num_threads(1)
    rows = []
    for scene in SCENES:
        print(scene.name, flush=True)
        rows.append(measure(scene))
    path.write_text(json.dumps({"tolerance": TOLERANCE, "directions": DIRECTIONS, "scenes": rows}, indent=1))


def measure(scene: Scene) -> dict[str, Any]:
    """One scene: plan, errors, times."""
    whole, context = scene.integrand(), scene.context()
    whole(torch.zeros(1, 2, dtype=torch.float64), context)  # tables are made before the clock starts
    clock = time.perf_counter()
    found = dsfit.plan(whole, context, TOLERANCE)
    seconds = time.perf_counter() - clock
    kept = found.integrand
    a, b = (dsfit.reference(x, context, 1e-7) for x in (whole, kept))
    error = ((a.value - b.value).abs() / b.value).amax()
    accuracy = ((a.error + b.error) / b.value).amax()
    middle = context[len(context) // 2]
    return {
        "name": scene.name,
        "plan": found.to_dict(),
        "plan_seconds": seconds,
        "error": float(error),
        "error_accuracy": float(accuracy),
        "evaluations": [a.evaluations, b.evaluations],
        "evaluation": in_turns([evaluation(x, context) for x in (whole, kept)], ROUNDS),
        "every_term": in_turns([evaluation(whole, everything(context)), evaluation(kept, context)], ROUNDS),
        "kernel": in_turns(kernels(whole.bsdf, kept.bsdf.terms, context), ROUNDS),
        "quadrature": in_turns([lambda x=x: nodes(x, middle) for x in (whole, kept)], 7),
        "nodes": [len(nodes(x, middle).weight) for x in (whole, kept)],
        "fit": in_turns([lambda x=x: fit(x, middle) for x in (whole, kept)], FIT_ROUNDS),
        "components": [len(structured_start(x, middle).names) for x in (whole, kept)],
        "excess": [float(dsfit.excess(whole, fit(x, middle), middle, 1e-2).value) for x in (whole, kept)],
    }


def evaluation(integrand: Integrand, context: Context) -> Callable[[], object]:
    """The integrand at random directions in every context."""
    g = torch.Generator().manual_seed(0)
    x = torch.rand(DIRECTIONS // len(context), len(context), 2, generator=g, dtype=torch.float64)
    omega = torch.stack([torch.asin(2 * x[..., 0] - 1), (2 * x[..., 1] - 1) * math.pi], dim=-1)
    return lambda: integrand(omega, context)


def everything(context: Context) -> Context:
    """The same views with every term lit: n > 0 and v = 1/2."""
    return Context(context.theta_r, context.phi_r, context.n.clamp_min(1.0), torch.full_like(context.v, 0.5))


def kernels(bsdf: DualScattering, terms: Terms, context: Context) -> list[Callable[[], object]]:
    """The float32 kernel with every term, and with those of the plan (always with the caustic's treatment, which its
    tables hold)."""
    calls = []
    for chosen, where in ((Terms(), everything(context)), (dataclasses.replace(terms, glint=True), context)):
        kernel = HairKernel(bsdf, terms=chosen)
        contexts = kernel.bare_contexts(where.to(torch.float32))
        g = torch.Generator().manual_seed(0)
        x = torch.rand(2, 16 * DIRECTIONS // len(context), len(context), generator=g)
        theta, phi = torch.asin(2 * x[0] - 1), (2 * x[1] - 1) * math.pi
        calls.append(lambda kernel=kernel, contexts=contexts, theta=theta, phi=phi: kernel.eval(contexts, theta, phi))
    return calls


def nodes(integrand: Integrand, context: Context) -> Any:
    """Quadrature nodes for a fit."""
    return dsfit.quadrature_nodes(integrand, context, even=True)


def fit(integrand: Integrand, context: Context) -> Any:
    """The structured proposal fitted to one context, nodes included."""
    start = structured_start(integrand, context)
    return dsfit.fit(start, integrand, context, nodes=nodes(integrand, context)).proposal


def in_turns(calls: list[Callable[[], object]], rounds: int) -> dict[str, Any]:
    """Medians of seconds, and the median ratio of neighbouring calls with its 95 % interval (order statistics)."""
    for call in calls:
        call()
    seconds = []
    for k in range(rounds):
        row = [0.0, 0.0]
        for j in (0, 1) if k % 2 else (1, 0):
            clock = time.perf_counter()
            calls[j]()
            row[j] = time.perf_counter() - clock
        seconds.append(row)
    times = np.array(seconds)
    ratios = np.sort(times[:, 0] / times[:, 1])
    reach = math.ceil(0.98 * math.sqrt(rounds))
    low, high = max(0, rounds // 2 - reach), min(rounds - 1, rounds // 2 + reach)
    return {
        "seconds": np.median(times, axis=0).tolist(),
        "ratio": float(np.median(ratios)),
        "interval": [float(ratios[low]), float(ratios[high])],
    }


def table(data: dict[str, Any]) -> str:
    """Markdown."""
    lines = [
        "| scene | goes | bound | true error | evaluation | against every term | kernel, against every term | "
        "quadrature nodes | fit |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for row in data["scenes"]:
        bound = "exact" if row["plan"]["bound"] == 0 else f"{row['plan']['bound']:.1e}"
        error = "0" if row["error"] <= max(row["error_accuracy"], 1e-14) else f"{row['error']:.1e}"
        times = " | ".join(ratio_text(row[key]) for key in ("evaluation", "every_term", "kernel"))
        a, b = row["nodes"]
        lines.append(
            f"| {row['name']} | {gone(row['plan'])} | {bound} | {error} | {times} | "
            f"{a} → {b}, ×{row['quadrature']['ratio']:.1f} | ×{row['fit']['ratio']:.1f}, {row['components'][0]} → "
            f"{row['components'][1]} lobes |"
        )
    return "\n".join(lines)


def ratio_text(row: dict[str, Any]) -> str:
    """The ratio with its interval."""
    low, high = row["interval"]
    return f"×{row['ratio']:.2f} ({low:.2f} to {high:.2f})"


def gone(plan: dict[str, Any]) -> str:
    """What goes, in a few words; what goes by a bound in brackets."""
    parts = []
    for half in ("direct", "scattered"):
        terms = [d for d in plan["dropped"] if d["half"] == half and d["term"] != "glint"]
        if len(terms) == 4 and all(d["bound"] == 0 for d in terms):
            parts.append(f"all {half}")
        elif terms:
            names = ", ".join(f"({d['term']})" if d["bound"] > 0 else d["term"] for d in terms)
            parts.append(f"{half} {names}")
    if any(d["term"] == "glint" and d["bound"] > 0 for d in plan["dropped"]):
        parts.append("(treatment of the caustic)")
    if plan["grey"]:
        parts.append("all channels but one")
    return "; ".join(parts) or "nothing"


def plot(data: dict[str, Any], path: Path) -> None:
    """Bounds against true errors, and what is saved."""
    import matplotlib.pyplot as plt

    scenes = data["scenes"]
    names, y = [row["name"] for row in scenes], np.arange(len(scenes))
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 5.2), sharey=True, layout="constrained")
    floor = 1e-9
    for k, row in enumerate(scenes):
        if row["plan"]["bound"] > 0:
            error = max(row["error"], floor)
            left.plot([error, row["plan"]["bound"]], [k, k], color="0.75", zorder=1)
            left.plot(row["plan"]["bound"], k, "|", color="C3", ms=14, mew=2, label="proven bound")
            left.plot(error, k, "o", color="C0", label="true error")
        else:
            left.text(2e-6, k, "exact", va="center", ha="center", color="0.4")
    left.axvline(data["tolerance"], color="0.4", ls=":", lw=1)
    left.text(data["tolerance"] * 0.85, -0.42, "tolerance", ha="right", va="center", color="0.4", fontsize=8)
    left.set(xscale="log", xlim=(1e-7, 3e-2), xlabel="error of the integral, relative", yticks=y, yticklabels=names)
    found = dict(zip(*reversed(left.get_legend_handles_labels()), strict=True))
    left.legend(found.values(), found.keys(), loc="lower left", fontsize=8)
    shown = (
        ("evaluation", "evaluation"),
        ("every_term", "evaluation, against every term"),
        ("kernel", "kernel, against every term"),
        ("quadrature", "quadrature nodes"),
        ("fit", "fit"),
    )
    for k, (key, label) in enumerate(shown):
        ratio = np.array([row[key]["ratio"] for row in scenes])
        ends = np.array([row[key]["interval"] for row in scenes])
        height = y + (k - 2) * 0.17
        right.barh(height, ratio - 1, 0.15, left=1.0, color=f"C{k}", label=label)
        right.hlines(height, ends[:, 0], ends[:, 1], color="0.2", lw=1)
    right.axvline(1.0, color="0.4", lw=1)
    right.set(xlabel="time before / after", xscale="log")
    right.set_xlim(0.5, 6)
    right.set_xticks([0.5, 1, 2, 5], ["0.5", "1", "2", "5"])
    right.minorticks_off()
    right.legend(fontsize=7, loc="lower right")
    left.invert_yaxis()
    figure.savefig(path, dpi=150)


def main(arguments: list[str]) -> None:
    """Command line; see the module text."""
    match arguments:
        case ["compute", path]:
            compute(Path(path))
        case ["plot", data, path]:
            plot(json.loads(Path(data).read_text()), Path(path))
        case ["table", data]:
            print(table(json.loads(Path(data).read_text())))
        case _:
            raise SystemExit(__doc__)


if __name__ == "__main__":
    main(sys.argv[1:])
