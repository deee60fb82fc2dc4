"""What six scenes do not need: what goes, the proven bound, the true error, and the time it saves.

Each scene is planned, integrated with and without what goes (quadrature), and evaluation, quadrature nodes and a fit of
the structured proposal are timed before and after, in turns, so that a busy machine slows both. Even without a plan the
BSDF skips a half of F whose share is exactly zero in a whole batch, so evaluation and the kernels' evaluation are also
compared with computing every term (v = 1/2): what a renderer does that neither plans nor looks.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

import dsfit
from dsfit.bsdf import DualScattering, Fiber
from dsfit.bsdf.terms import Terms
from dsfit.context import Context
from dsfit.experiment.methods import structured_start
from dsfit.figures import Close, Data, Experiment, Measured, Settings, Work
from dsfit.kernels import HairKernel
from dsfit.scene.integrand import Integrand
from dsfit.scene.plan import Plan

DEG = math.pi / 180


class Scene(Settings):
    """A fibre and the contexts it is seen in, every view with every pair of `n` and `v` (left out: e^-n); `sigma_a`
    and the widths `beta_deg` replace those of the preset `fiber`."""

    name: str
    fiber: str
    theta_r_deg: list[float]
    n: list[float]
    v: list[float] | None = None
    d_b: float = 0.7
    sigma_a: list[float] | None = None
    beta_deg: list[float] | None = None

    def integrand(self) -> Integrand:
        """In a furnace of radiance 1."""
        beta = None if self.beta_deg is None else [b * DEG for b in self.beta_deg]
        changes = {key: value for key, value in (("sigma_a", self.sigma_a), ("beta", beta)) if value is not None}
        return Integrand(DualScattering(Fiber.preset(self.fiber, **changes), d_b=self.d_b, precision="table"))

    def context(self) -> Context:
        """The contexts, `[views * pairs]`."""
        theta = torch.tensor(self.theta_r_deg, dtype=torch.float64)[:, None] * DEG
        n = torch.tensor(self.n, dtype=torch.float64)
        v = None if self.v is None else torch.tensor(self.v, dtype=torch.float64)
        return Context(theta, n=n, v=v).reshape(-1)


class Planning(Settings):
    """`tolerance` is that of the plans; `rtol` that of the integrals whose difference is the true error; `directions`
    in all contexts together are evaluated at a time; `rounds` are the times that each is timed in turn."""

    tolerance: float = 0.01
    rtol: float = 1e-7
    directions: int = 1024
    rounds: int = 31
    quadrature_rounds: int = 7
    fit_rounds: int = 3
    scenes: list[Scene]


def compute(settings: Planning, work: Work) -> Data:
    """All scenes, one after the other."""
    rows = []
    for scene in settings.scenes:
        work.say(scene.name)
        rows.append(measure(scene, settings))
    return Data(record={"tolerance": settings.tolerance, "scenes": rows})


def measure(scene: Scene, settings: Planning) -> dict[str, Any]:
    """One scene: plan, errors, times."""
    whole, context, many = scene.integrand(), scene.context(), settings.directions
    whole(torch.zeros(1, 2, dtype=torch.float64), context)  # tables are made before the clock starts
    clock = time.perf_counter()
    found = dsfit.plan(whole, context, settings.tolerance)
    seconds = time.perf_counter() - clock
    kept = found.integrand
    a, b = (dsfit.reference(x, context, settings.rtol) for x in (whole, kept))
    middle, both = context[len(context) // 2], (whole, kept)
    unskipped = [evaluation(whole, everything(context), many), evaluation(kept, context, many)]
    return {
        "name": scene.name,
        "plan": told(found),
        "plan_seconds": seconds,
        "error": float(((a.value - b.value).abs() / b.value).amax()),
        "error_accuracy": float(((a.error + b.error) / b.value).amax()),
        "evaluations": [a.evaluations, b.evaluations],
        "evaluation": in_turns([evaluation(x, context, many) for x in both], settings.rounds),
        "every_term": in_turns(unskipped, settings.rounds),
        "kernel": in_turns(kernels(whole.bsdf, kept.bsdf.terms, context, many), settings.rounds),
        "quadrature": in_turns([lambda x=x: nodes(x, middle) for x in both], settings.quadrature_rounds),
        "nodes": [len(nodes(x, middle).weight) for x in both],
        "excess": [float(dsfit.excess(whole, fit(x, middle), middle, 1e-2).value) for x in both],
        "fit": in_turns([lambda x=x: fit(x, middle) for x in both], settings.fit_rounds, warm=True),
        "components": [len(structured_start(x, middle).names) for x in both],
    }


def told(plan: Plan) -> dict[str, Any]:
    """What goes, and by which bound."""
    found = plan.to_dict()
    dropped = [{key: entry[key] for key in ("half", "term", "bound")} for entry in found["dropped"]]
    return {"bound": found["bound"], "grey": found["grey"], "kept": found["kept"], "dropped": dropped}


def evaluation(integrand: Integrand, context: Context, directions: int) -> Callable[[], object]:
    """The integrand at random directions in every context."""
    g = torch.Generator().manual_seed(0)
    x = torch.rand(max(1, directions // len(context)), len(context), 2, generator=g, dtype=torch.float64)
    omega = torch.stack([torch.asin(2 * x[..., 0] - 1), (2 * x[..., 1] - 1) * math.pi], dim=-1)
    return lambda: integrand(omega, context)


def everything(context: Context) -> Context:
    """The same views with every term lit: n > 0 and v = 1/2."""
    return Context(context.theta_r, context.phi_r, context.n.clamp_min(1.0), torch.full_like(context.v, 0.5))


def kernels(bsdf: DualScattering, terms: Terms, context: Context, directions: int) -> list[Callable[[], object]]:
    """The float32 kernel with every term, and with those of the plan (always with the caustic's treatment, which its
    tables hold), at 16 times as many directions."""
    calls = []
    for chosen, where in ((Terms(), everything(context)), (dataclasses.replace(terms, glint=True), context)):
        kernel = HairKernel(bsdf, terms=chosen)
        contexts = kernel.bare_contexts(where.to(torch.float32))
        g = torch.Generator().manual_seed(0)
        x = torch.rand(2, max(1, 16 * directions // len(context)), len(context), generator=g)
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


def in_turns(calls: list[Callable[[], object]], rounds: int, warm: bool = False) -> dict[str, Any]:
    """Medians of seconds, and the median ratio of neighbouring calls with its 95 % interval (order statistics); each is
    called once before unless all were (`warm`)."""
    for call in () if warm else calls:
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


EXPERIMENT = Experiment(
    title="What planning leaves out",
    shows="Six scenes that each allow something else to be left out: proven bound, true error, and the time saved.",
    settings=Planning,
    compute=compute,
    minutes=3.0,
    reproduces={
        "*seconds": Measured(),
        "*.ratio": Measured(),
        "*.interval": Measured(),
        "*.bound": Close(1e-6, 1e-15),
        "*.error": Close(1e-3, 1e-6),
        "*.error_accuracy": Close(1.0, 1e-6),
        # adaptive: rounding may split one region more or fewer
        "*.evaluations": Close(0.05),
        "*.nodes": Close(0.05),
        "*.excess": Close(0.02),
    },
    small=(
        "rounds=3",
        "fit_rounds=1",
        "quadrature_rounds=1",
        "rtol=1e-4",
        'scenes=[{name="back-lit deep hair", fiber="blond", theta_r_deg=[45.0], n=[20.0], v=[0.0]}]',
    ),
)
