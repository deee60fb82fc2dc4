"""What averaging estimators costs: the mean of single-proposal estimates against the balance heuristic of the same
samples and against the best proposal alone."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import torch

from dsfit.figures import Close, Data, Estimate, Experiment, Measured, Settings, Work
from experiments._averaging_sampled import draws, estimators, forms
from experiments._mis_spot import Spot, error_and_seconds, proposals


class Averaging(Settings):
    """`configs/figures/averaging.toml` says what each key is."""

    contexts: list[dict[str, Any]]
    order: list[str]
    bad: list[str]
    shares: int
    reach: float
    samples: int
    repeats: int
    growth: list[int]
    seed: int
    timed_proposals: int
    timed_samples: list[int]
    timed_repeats: int


def average_variance(single: np.ndarray) -> float:
    """N Var of 1/K sum_k F_k, each F_k with N/K samples: 1/K^2 sum_k V_k / (N/K) N = the mean of the V_k."""
    return float(np.mean(single))


def compute(settings: Averaging, work: Work) -> Data:
    """Arrays by context: V of single proposals, and of combinations of the first K in the order given."""
    spots = [Spot(**context) for context in settings.contexts]
    arrays: dict[str, np.ndarray] = {"single": np.array([[s.single(k) for k in settings.order] for s in spots])}
    work.say("numbers of proposals")
    arrays |= _growing(settings, spots, arrays["single"])
    work.say("pairs")
    arrays["pairs"] = _pairs(settings, spots, arrays["single"])
    work.say("one bad proposal")
    arrays |= _bad(settings, spots[0], arrays["single"][0])
    work.say("readings of equations 2 and 3")
    readings = forms(spots[0], settings.samples, settings.repeats, settings.seed + 50)
    arrays["readings.mean"] = np.array([row.pop("mean") for row in readings])
    arrays["readings.mean_se"] = np.array([row.pop("mean_se") for row in readings])
    work.say("error against run time")
    arrays |= _timed(settings, spots, arrays["single"])
    record = {
        **settings.model_dump(exclude={"seed"}),
        "names": list(proposals(settings.contexts[0]["preset"])), "readings": readings,
        "good": settings.order[_best(arrays["single"][0])],
        "best": [settings.order[_best(row)] for row in arrays["single"]],
    }  # fmt: skip
    return Data(arrays, record)


def _best(single: np.ndarray) -> int:
    return int(np.nanargmin(single))


def _growing(settings: Averaging, spots: list[Spot], single: np.ndarray) -> dict[str, np.ndarray]:
    """Balance of the first K proposals `[context, K]` by quadrature, measured with its standard error; the average
    measured where the variance can be seen (`average_at`: context, K), and relative means."""
    size = len(settings.order)
    exact, error = np.zeros((2, len(spots), size))
    balance, seen, at = np.zeros((4, len(spots), size)), [], []
    for i, spot in enumerate(spots):
        for k in range(1, size + 1):
            names = settings.order[:k]
            exact[i, k - 1], error[i, k - 1] = spot.variance(names, [1 / k] * k)
            seed = settings.seed + 10_000 * (i + 1) + 10 * k
            some = draws(spot, names, settings.samples // k, settings.repeats, seed)
            balance[:, i, k - 1] = _statistics(spot, *some.balance())
            if bool((single[i, :k] < settings.reach).all()):
                seen.append(_statistics(spot, *some.average()))
                at.append((i, k))
    average = np.array(seen).reshape(-1, 4).T
    names = ("variance", "variance_se", "mean", "mean_se")
    found = {f"balance.{name}": x for name, x in zip(names, balance, strict=True)}
    found |= {f"average.{name}": x for name, x in zip(names, average, strict=True)}
    found["average_at"] = np.array(at).reshape(-1, 2)
    return {**found, "balance.exact": exact, "balance.quadrature_error": error}


def _statistics(spot: Spot, value: torch.Tensor, variance: torch.Tensor) -> list[float]:
    """Relative variance, its standard error, relative mean, its standard error."""
    found = []
    for x in (variance.sum(-1) / spot.integral.square().sum(), value.sum(-1) / spot.integral.sum()):
        found += [float(x.mean()), float(x.std() / len(x) ** 0.5)]
    return found


def _pairs(settings: Averaging, spots: list[Spot], single: np.ndarray) -> np.ndarray:
    """`[M, 5]`: context, the better proposal, the other, V of the other over V of the better, and V of their balance
    with equal shares over V of the better, for all pairs with finite variance."""
    rows = []
    for i, spot in enumerate(spots):
        finite = [k for k in range(len(settings.order)) if np.isfinite(single[i, k])]
        for pair in itertools.combinations(finite, 2):
            good, bad = sorted(pair, key=lambda k: single[i, k])
            value = spot.value([settings.order[good], settings.order[bad]], (0.5, 0.5))
            rows.append((i, good, bad, single[i, bad] / single[i, good], value / single[i, good]))
    return np.array(rows)


def _bad(settings: Averaging, spot: Spot, single: np.ndarray) -> dict[str, np.ndarray]:
    """Balance of the best proposal and a bad one over the bad one's share `[bad, share]`, and the measured variance of
    average and balance with equal shares over the number of samples `[bad, growth]` as quartiles `[3]` of the
    repeats."""
    good = settings.order[_best(single)]
    grid = np.linspace(0, 1, settings.shares + 2)[1:-1]
    exact = np.array([[spot.value([good, name], (1 - c, c)) for c in grid] for name in settings.bad])
    rows = np.zeros((2, len(settings.bad), len(settings.growth), 3))
    for b, name in enumerate(settings.bad):
        for g, count in enumerate(settings.growth):
            some = draws(spot, [good, name], count // 2, settings.repeats, settings.seed + 100 + 10 * b + g)
            for row, (_, variance) in zip(rows[:, b, g], (some.average(), some.balance()), strict=True):
                relative = variance.sum(-1) / spot.integral.square().sum()
                row[:] = np.quantile(relative.numpy(), [0.25, 0.5, 0.75])
    singles = np.array([spot.single(name) for name in settings.bad])
    return {"bad.shares": grid, "bad.balance": exact, "bad.single": singles, "growth.average": rows[0],
            "growth.balance": rows[1]}  # fmt: skip


def _timed(settings: Averaging, spots: list[Spot], single: np.ndarray) -> dict[str, np.ndarray]:
    """Relative error (root mean square of repeats), its standard error, and median CPU seconds of one estimate
    `[context, estimator, samples]`."""
    names = settings.order[: settings.timed_proposals]
    shape = (len(spots), 3, len(settings.timed_samples))
    error, error_se, seconds = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    for i, spot in enumerate(spots):
        kinds = estimators(spot, names, settings.order[_best(single[i])])
        for e, estimator in enumerate(kinds.values()):
            for g, count in enumerate(settings.timed_samples):
                seed = settings.seed + 1000 * i + 100 * e + g
                error[i, e, g], error_se[i, e, g], seconds[i, e, g] = error_and_seconds(
                    estimator, spot.integral, count, settings.timed_repeats, seed
                )
    return {"timed.error": error, "timed.error_se": error_se, "timed.seconds": seconds}


EXPERIMENT = Experiment(
    title="Averaging estimators against weighting their samples",
    shows="The chapter's claim that averaging makes things worse: variance of averages, of the balance heuristic "
    "and of the best proposal, and what one bad proposal does to each.",
    settings=Averaging,
    compute=compute,
    minutes=1.3,
    reproduces={
        "average_at": Close(0.0),
        "single": Close(1e-3),
        "pairs": Close(1e-3),
        "balance.exact": Close(1e-3),
        "bad.shares": Close(1e-12),
        "bad.*": Close(1e-3),
        "balance.variance": Estimate("balance.variance_se"),
        "balance.mean": Estimate("balance.mean_se"),
        "average.variance": Estimate("average.variance_se"),
        "average.mean": Estimate("average.mean_se"),
        "readings.mean": Estimate("readings.mean_se"),
        "growth.*": Measured(),
        "timed.error": Estimate("timed.error_se"),
        "timed.seconds": Measured(),
        "*_se": Measured(),
        "*_error": Measured(),
    },
    small=(
        "samples=96", "repeats=6", "growth=[64]", "shares=5", "timed_samples=[64]", "timed_repeats=3",
        'contexts=[{preset="blond", theta_r_deg=0.0, n=0.0}]',
        'order=["transmittance_gaussian", "uniform", "M_TRT", "R"]', "timed_proposals=3",
    ),
)  # fmt: skip
