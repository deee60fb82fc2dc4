"""Heuristics against fits: how far each is above the least second moment, and how the shares, centres and widths of the
lobes follow inclination and number of fibres in a best mix, in fits context by context and in one amortised
proposal."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch

from dsfit import Context, estimate, fit
from dsfit.experiment.heuristic_mix import balance_fractions, best_mix
from dsfit.experiment.methods import Setting, structured_start
from dsfit.figures import Close, Data, Estimate, Experiment, Measured, Settings, Work
from dsfit.fit.amortise import amortise
from dsfit.mis import mis_variance
from dsfit.race.clock import timed
from experiments._heuristics_fits_lobes import GROUPS, amortised_lobes, fitted_shapes, fitted_weights, mix_weights
from experiments._mis_spot import error_and_seconds, integrand, proposals

METHODS = ("uniform", "best single", "all, balance", "best mix", "all, optimal", "structured start", "fitted",
           "amortised")  # fmt: skip
UNUSABLE = ("R", "TRT", "front")
"""Alone: the first two have infinite variance, since their density vanishes at phi = pi, the last leaves half of the
sphere out."""
SLICES = ("theta_r", "n")


class HeuristicsFits(Settings):
    """`configs/figures/heuristics_fits.toml` says what each key is."""

    presets: list[str]
    theta_r_deg: list[float]
    fixed_n: float
    n: list[float]
    fixed_theta_r_deg: float
    grid_theta_r_deg: list[float]
    grid_n: list[float]
    dense: int
    max_steps: int
    train_steps: int
    seed: int
    timed_samples: list[int]
    timed_repeats: int


def contexts(settings: HeuristicsFits) -> dict[str, list[tuple[float, float]]]:
    """(theta_r in degrees, n) of both slices and of the grid."""
    return {
        "theta_r": [(theta, settings.fixed_n) for theta in settings.theta_r_deg],
        "n": [(settings.fixed_theta_r_deg, n) for n in settings.n],
        "grid": [(theta, n) for theta in settings.grid_theta_r_deg for n in settings.grid_n],
    }


def context(theta_r_deg: Any, n: Any) -> Context:
    """The context in which light passes n fibres on average: it meets none with probability v = exp(-n)."""
    n = torch.as_tensor(n, dtype=torch.float64)
    return Context(torch.deg2rad(torch.as_tensor(theta_r_deg, dtype=torch.float64)), 0.0, n, torch.exp(-n))


def compute(settings: HeuristicsFits, work: Work) -> Data:
    """Per fibre: `excess [M, method]` at `contexts [M, 2]`, weights by group and shapes of lobes on both slices."""
    import dsfit.fit.optimistix_solvers  # noqa: F401  (importing JAX is not part of a fit's time)

    arrays: dict[str, np.ndarray] = {}
    facts: dict[str, Any] = {}
    for index, preset in enumerate(settings.presets):
        work.say(f"{preset}: training")
        found, seconds = timed(
            lambda name=preset: amortise(integrand(name).bsdf, steps=settings.train_steps, seed=settings.seed)
        )
        one = _Fibre(settings, preset, found.proposal)
        for name, values in one.run(work).items():
            arrays[f"{preset}.{name}"] = values
        facts[preset] = {"training": seconds, **one.facts()}
        work.say(f"{preset}: error against run time")
        for name, values in one.timing(settings.seed + 10_000 * index).items():
            arrays[f"{preset}.{name}"] = values
    record = {
        **settings.model_dump(exclude={"seed"}),
        "methods": list(METHODS),
        "groups": list(GROUPS),
        "seconds": facts,
    }
    return Data(arrays, record)


class _Fibre:
    """All contexts of one fibre."""

    def __init__(self, settings: HeuristicsFits, preset: str, amortised: Any) -> None:
        self.settings, self.preset, self.amortised = settings, preset, amortised
        self.integrand = integrand(preset)
        self.singles = [name for name in proposals(preset)]
        self.modules = list(proposals(preset).values())
        self.spent: dict[str, list[float]] = {"nodes": [], "mix": [], "start": [], "fit": []}

    def run(self, work: Work) -> dict[str, np.ndarray]:
        """Excesses everywhere, and lobes on the slices."""
        rows: list[list[float]] = []
        at: list[tuple[float, float]] = []
        arrays: dict[str, np.ndarray] = {}
        for part, some in contexts(self.settings).items():
            work.say(f"{self.preset}: {part}")
            lobes: dict[str, list[np.ndarray]] = {"mix": [], "fitted": [], "shape": []}
            for theta, n in some:
                setting = Setting(None, self.integrand, context(theta, n))  # type: ignore[arg-type]
                found, mix, fitted = self._methods(setting)
                rows.append(found)
                at.append((theta, n))
                lobes["mix"].append(mix_weights(self.singles, mix))
                lobes["fitted"].append(fitted_weights(fitted))
                lobes["shape"].append(fitted_shapes(fitted))
            if part in SLICES:
                arrays |= {f"{part}.{name}": np.array(x) for name, x in lobes.items()}
                arrays |= self._dense(part)
        return {**arrays, "contexts": np.array(at), "excess": np.array(rows)}

    def _methods(self, setting: Setting) -> tuple[list[float], Any, Any]:
        """Excess of every method, the shares of the mixture of least second moment, and the fitted proposal."""
        nodes, seconds = timed(lambda: setting.nodes)
        self.spent["nodes"].append(seconds)
        mix, seconds = timed(lambda: best_mix(setting, self.modules))
        self.spent["mix"].append(seconds)
        start, seconds = timed(lambda: structured_start(self.integrand, setting.context))
        self.spent["start"].append(seconds)
        fitted, seconds = timed(
            lambda: fit(start, self.integrand, setting.context, nodes=nodes, max_steps=self.settings.max_steps).proposal
        )
        self.spent["fit"].append(seconds)
        equal = [1 / len(self.modules)] * len(self.modules)
        usable = [m for name, m in zip(self.singles, self.modules, strict=True) if name not in UNUSABLE]
        used = [k for k, share in enumerate(mix.fractions) if share > 0]
        combined = [
            excess(setting, [proposals(self.preset)["uniform"]]),
            min(excess(setting, [m]) for m in usable),
            excess(setting, self.modules, equal),
            excess(
                setting, [self.modules[k] for k in used], [mix.fractions[k] for k in used], mix.heuristic, mix.model
            ),
            excess(setting, self.modules, equal, "optimal"),
        ]
        shares, _ = balance_fractions(setting.log_p(self.modules), nodes.weight * nodes.value.square().sum(-1))
        found = [*combined, *(excess(setting, [p]) for p in (start, fitted, self.amortised))]
        return found, shares.tolist(), fitted

    def _dense(self, part: str) -> dict[str, np.ndarray]:
        """The amortised proposal's lobes between the contexts of a slice."""
        s = self.settings
        if part == "theta_r":
            x = np.linspace(min(s.theta_r_deg), max(s.theta_r_deg), s.dense)
            where = context(x, np.full_like(x, s.fixed_n))
        else:
            x = np.expm1(np.linspace(math.log1p(min(s.n)), math.log1p(max(s.n)), s.dense))
            where = context(np.full_like(x, s.fixed_theta_r_deg), x)
        weights, shapes = amortised_lobes(self.amortised, where)
        found = {f"{part}.amortised": weights, f"{part}.amortised_shape": shapes}
        return {f"{part}.dense": x, **{name: values.astype(np.float32) for name, values in found.items()}}

    def facts(self) -> dict[str, float]:
        """Median CPU seconds a context of the steps of a fit, and of evaluating the amortised proposal there."""
        one = context(self.settings.fixed_theta_r_deg, self.settings.fixed_n)
        use = float(np.median([timed(lambda: self.amortised(one))[1] for _ in range(20)]))
        return {**{name: float(np.median(x)) for name, x in self.spent.items()}, "amortised": use}

    def timing(self, seed: int) -> dict[str, np.ndarray]:
        """Relative error, its standard error and CPU seconds `[method, samples]` at the context that both slices
        share."""
        s = self.settings
        setting = Setting(None, self.integrand, context(s.fixed_theta_r_deg, s.fixed_n))  # type: ignore[arg-type]
        nodes = setting.fine_nodes
        integral = (nodes.value * nodes.weight[:, None]).sum(0)
        mix = best_mix(setting, self.modules)
        start = structured_start(self.integrand, setting.context)
        fitted = fit(start, self.integrand, setting.context, nodes=setting.nodes, max_steps=s.max_steps).proposal
        usable = [m for name, m in zip(self.singles, self.modules, strict=True) if name not in UNUSABLE]
        best = min(usable, key=lambda m: excess(setting, [m]))
        used = [k for k, share in enumerate(mix.fractions) if share > 0]
        equal = [1 / len(self.modules)] * len(self.modules)
        shares = [mix.fractions[k] for k in used]
        plans: list[tuple[list[Any], list[float], Any, str]] = [
            ([proposals(self.preset)["uniform"]], [1.0], "balance", "multi"),
            ([best], [1.0], "balance", "multi"),
            (self.modules, equal, "balance", "multi"),
            ([self.modules[k] for k in used], [c / sum(shares) for c in shares], mix.heuristic, mix.model),
            (self.modules, equal, "optimal", "multi"),
            *(([proposal], [1.0], "balance", "multi") for proposal in (start, fitted, self.amortised)),
        ]
        found = np.zeros((3, len(plans), len(s.timed_samples)))
        for p, (modules, fractions, rule, model) in enumerate(plans):
            options = {"allocation": fractions, "model": model, "test": False}

            def once(n: int, g: Any, modules: Any = modules, rule: Any = rule, options: Any = options) -> torch.Tensor:
                return estimate(self.integrand, modules, setting.context, n, rule, generator=g, **options).value

            for k, count in enumerate(s.timed_samples):
                found[:, p, k] = error_and_seconds(once, integral, count, s.timed_repeats, seed + 100 * p + k)
        return dict(zip(("timed.error", "timed.error_se", "timed.seconds"), found, strict=True))


def excess(
    setting: Setting, modules: list[Any], shares: list[float] | None = None, rule: Any = "balance", model: str = "multi"
) -> float:
    """(N Var + |∫F|^2) / M* - 1 on nodes that no fit has seen: of one proposal its excess; of optimal weights it may be
    below 0, as control variates are no density."""
    nodes = setting.fine_nodes
    found = mis_variance(
        nodes.value, nodes.weight, setting.log_p(modules, nodes), shares or [1.0], rule, model=model
    )  # fmt: skip
    return float(found.variance_excess)


EXPERIMENT = Experiment(
    title="Heuristics against fits",
    shows="Excess of uniform, single, mixed, fitted and amortised proposals over contexts, and the shares, centres and "
    "widths of their lobes as functions of inclination and number of fibres.",
    settings=HeuristicsFits,
    compute=compute,
    minutes=5.4,
    reproduces={
        "*.contexts": Close(1e-12),
        "*.dense": Close(1e-12),
        # Gauss-Newton and Adam end at points that rounding moves along flat directions: shares trade with each other
        "*.excess": Close(0.3, 1e-4),
        "*.mix": Close(0.0, 0.02),
        "*.fitted": Close(0.0, 0.1),
        "*.amortised": Close(0.0, 0.1),
        "*.shape": Close(0.1, 5.0),
        "*.amortised_shape": Close(0.1, 5.0),
        "*.timed.error": Estimate("*.timed.error_se"),
        "*.timed.error_se": Measured(),
        "*.timed.seconds": Measured(),
        "seconds.*": Measured(),
    },
    small=(
        'presets=["blond"]', "theta_r_deg=[0.0]", "n=[1.0]", "grid_theta_r_deg=[40.0]", "grid_n=[3.0]", "dense=5",
        "max_steps=3", "train_steps=3", "timed_samples=[64]", "timed_repeats=3",
    ),
)  # fmt: skip
