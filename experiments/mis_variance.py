"""Variance of every MIS heuristic with the chapter's proposals: by quadrature, measured, per sample and per second, and
as a function of how the samples are shared out."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from dsfit.figures import Close, Data, Estimate, Experiment, Settings, Work
from dsfit.figures import Measured as MeasuredRule
from dsfit.mis import estimate
from experiments._mis_spot import Spot, median_seconds, proposals
from experiments._mis_variance_sampled import measure

MODELS = ("multi", "one")


class MisVariance(Settings):
    """Where, with which proposals and heuristics; `configs/figures/mis_variance.toml` says what each key is."""

    presets: list[str]
    theta_r_deg: list[float]
    n: list[float]
    sets: dict[str, list[str]]
    powers: list[float]
    cutoffs: list[float]
    samples: int
    repeats: int
    seed: int
    timing_samples: int
    timing_repeats: int
    pair_preset: str
    pair_theta_r_deg: float
    pairs: list[dict[str, Any]]
    shares: int
    measured_shares: list[float]


def rules(settings: MisVariance) -> dict[str, Any]:
    """The heuristics by name."""
    found: dict[str, Any] = {"balance": "balance"}
    found |= {f"power {beta:g}": {"kind": "power", "beta": beta} for beta in settings.powers}
    found["maximum"] = "maximum"
    found |= {f"cutoff {alpha:g}": {"kind": "cutoff", "alpha": alpha} for alpha in settings.cutoffs}
    return {**found, "optimal": "optimal"}


def compute(settings: MisVariance, work: Work) -> Data:
    """Arrays `[preset, theta_r, n, set, rule, model]` of variances, `[set, rule, model]` of seconds per sample, and
    `pair[K]` arrays `[rule, model, share]`."""
    heuristics = rules(settings)
    arrays = _contexts(settings, heuristics, work)
    work.say("timing")
    arrays["seconds_per_sample"] = _seconds(settings, heuristics)
    for k, pair in enumerate(settings.pairs):
        work.say(f"shares of {pair['first']} and {pair['second']}")
        arrays |= {f"pair{k}.{name}": x for name, x in _pair(settings, heuristics, pair, k).items()}
    arrays["shares"] = np.linspace(0, 1, settings.shares + 2)[1:-1]
    record = {
        "presets": settings.presets, "theta_r_deg": settings.theta_r_deg, "n": settings.n,
        "sets": settings.sets, "set_names": list(settings.sets), "rules": list(heuristics), "models": list(MODELS),
        "pairs": settings.pairs, "pair_preset": settings.pair_preset, "pair_theta_r_deg": settings.pair_theta_r_deg,
        "measured_shares": settings.measured_shares, "samples": settings.samples, "repeats": settings.repeats,
    }  # fmt: skip
    return Data(arrays, record)


def _contexts(settings: MisVariance, heuristics: dict[str, Any], work: Work) -> dict[str, np.ndarray]:
    axes = (settings.presets, settings.theta_r_deg, settings.n, settings.sets, heuristics, MODELS)
    names = ("exact", "quadrature_error", "variance", "variance_se", "mean", "mean_se")
    arrays = {name: np.zeros([len(axis) for axis in axes]) for name in names}
    seeds = iter(range(settings.seed, settings.seed + 10**6))
    for i, preset in enumerate(settings.presets):
        for j, theta in enumerate(settings.theta_r_deg):
            work.say(f"{preset}, {theta:g} degrees")
            for k, n in enumerate(settings.n):
                spot = Spot(preset, theta, n)
                for s, members in enumerate(settings.sets.values()):
                    equal = [1 / len(members)] * len(members)
                    for m, model in enumerate(MODELS):
                        for r, rule in enumerate(heuristics.values()):
                            at = (i, j, k, s, r, m)
                            arrays["exact"][at], arrays["quadrature_error"][at] = spot.variance(
                                members, equal, rule, model
                            )
                        sampled = measure(
                            spot, members, equal, list(heuristics.values()), model,
                            settings.samples, settings.repeats, next(seeds),
                        )  # fmt: skip
                        for r, one in enumerate(sampled):
                            for name, value in vars(one).items():
                                arrays[name][i, j, k, s, r, m] = value
    return arrays


def _seconds(settings: MisVariance, heuristics: dict[str, Any]) -> np.ndarray:
    """CPU seconds per sample `[set, rule, model]` of `dsfit.estimate` without its tests, medians of repeats; they
    depend on the proposals, hardly on the context."""
    spot = Spot(settings.presets[0], settings.theta_r_deg[0], settings.n[0])
    found = np.zeros((len(settings.sets), len(heuristics), len(MODELS)))
    for s, members in enumerate(settings.sets.values()):
        modules = [proposals(spot.preset)[name] for name in members]
        for r, rule in enumerate(heuristics.values()):
            for m, model in enumerate(MODELS):
                generator = torch.Generator().manual_seed(settings.seed)

                def once(modules: Any = modules, rule: Any = rule, model: str = model, g: Any = generator) -> None:
                    count = settings.timing_samples
                    estimate(spot.integrand, modules, spot.context, count, rule, model=model, generator=g, test=False)

                found[s, r, m] = median_seconds(once, settings.timing_repeats) / settings.timing_samples
    return found


def _pair(settings: MisVariance, heuristics: dict[str, Any], pair: dict[str, Any], index: int) -> dict[str, np.ndarray]:
    """Variance against the share of the first of two proposals, by quadrature at every share and measured at some."""
    spot = Spot(settings.pair_preset, settings.pair_theta_r_deg, pair["n"])
    names = [pair["first"], pair["second"]]
    grid = np.linspace(0, 1, settings.shares + 2)[1:-1]
    exact = np.zeros((len(heuristics), len(MODELS), len(grid)))
    sampled = np.zeros((2, len(heuristics), len(MODELS), len(settings.measured_shares)))
    for m, model in enumerate(MODELS):
        for r, rule in enumerate(heuristics.values()):
            exact[r, m] = [spot.value(names, (c, 1 - c), rule, model) for c in grid]
        for c, share in enumerate(settings.measured_shares):
            seed = settings.seed + 10**6 + 1000 * index + 10 * c + m
            one = measure(
                spot, names, (share, 1 - share), list(heuristics.values()), model,
                settings.samples, settings.repeats, seed,
            )  # fmt: skip
            sampled[:, :, m, c] = np.array([[x.variance, x.variance_se] for x in one]).T
    alone = np.array([spot.single(name) for name in names])
    return {"exact": exact, "alone": alone, "variance": sampled[0], "variance_se": sampled[1]}


EXPERIMENT = Experiment(
    title="Variance of the MIS heuristics",
    shows="Balance, power, maximum, cutoff and optimal weights over contexts, proposals and shares of the samples, by "
    "quadrature and measured, per sample and per second.",
    settings=MisVariance,
    compute=compute,
    minutes=2.3,
    reproduces={
        "exact": Close(1e-3),
        "quadrature_error": MeasuredRule(),
        "pair*.exact": Close(1e-3),
        "pair*.alone": Close(1e-3),
        "variance": Estimate("variance_se"),
        "mean": Estimate("mean_se"),
        "pair*.variance": Estimate("pair*.variance_se"),
        "*_se": MeasuredRule(),
        "seconds_per_sample": MeasuredRule(),
        "shares": Close(1e-12),
    },
    small=(
        'presets=["blond"]', "theta_r_deg=[0.0]", "n=[3.0]", "samples=280", "repeats=4", "timing_samples=280",
        "timing_repeats=1", "shares=9", "measured_shares=[0.5]",
    ),
)  # fmt: skip
