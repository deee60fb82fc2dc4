"""Whether ensembles have found all of p*, or only agree because all of them are stuck.

What counts as a chain: the walkers of an ensemble move by each other's places, so they are not independent chains, and
averages over them are judged by the scatter between ensembles. But a walker that never leaves its lobe shows best in
its own trace. So R-hat and the autocorrelation time take walkers as chains, and nested R-hat (Margossian et al. 2024,
Bayesian Analysis) takes ensembles as superchains of walkers.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
from arviz_stats.base import array_stats

from dsfit.checks.independent.chains import STARTS, Chains
from dsfit.checks.independent.welch import Sample, smallest_p, welch

_BINS = 24


@dataclass(frozen=True)
class Limits:
    """What is accepted as converged.

    Attributes:
        r_hat: largest rank-normalised split R-hat over walkers (Vehtari et al. 2021, Bayesian Analysis 16). Well mixed
            chains of 400 steps reach 1.05, as a walker takes only some twenty independent steps.
        nested: largest nested R-hat over ensembles; 1.005 is a scatter of ensembles by a tenth of the spread of p*.
        steps: least number of autocorrelation times in the kept steps.
        burn_in: least number of autocorrelation times in the burn-in.
        acceptance: least share of accepted steps of any ensemble.
        start: least p-value of equal means of ensembles from different starts.
        unvisited: largest share of p* in places that the quadrature knows and the walkers hardly visited.
    """

    r_hat: float = 1.1
    nested: float = 1.005
    steps: float = 8.0
    burn_in: float = 3.0
    acceptance: float = 0.05
    start: float = 1e-3
    unvisited: float = 0.005


@dataclass(frozen=True)
class Diagnostics:
    """How the ensembles did; worst over sin theta, cos phi, sin phi and log |F|.

    Attributes:
        r_hat, nested_r_hat, autocorrelation: see `Limits`; the autocorrelation time in steps, about the mean over all
            walkers, so that walkers stuck in different lobes count as endless correlation.
        bulk_ess: effective number of samples if ensembles were as good as their walkers' traces.
        between_ess: the same from the scatter between ensembles.
        acceptance: smallest of any ensemble.
        start_p: equal means of the two kinds of start.
        unvisited: see `Limits`; nan where no quadrature was given.
        reasons: why the chains are not to be trusted; empty if they are.
    """

    r_hat: float
    nested_r_hat: float
    autocorrelation: float
    bulk_ess: float
    between_ess: float
    acceptance: float
    start_p: float
    unvisited: float
    reasons: tuple[str, ...]

    def to_dict(self) -> dict[str, object]:
        """As plain data."""
        return asdict(self)

    @property
    def line(self) -> str:
        """One line for tables and titles."""
        return (
            f"R-hat {self.r_hat:.3f}, nested {self.nested_r_hat:.4f}, autocorrelation {self.autocorrelation:.0f} "
            f"steps, acceptance {self.acceptance:.2f}, equal starts p = {self.start_p:.2g}, "
            f"unvisited {self.unvisited:.2g}"
        )


def traces(chains: Chains) -> dict[str, np.ndarray]:
    """The functions that convergence is judged by, `[steps, E, W]` each."""
    theta, phi = chains.place[..., 0], chains.place[..., 1]
    finite = np.where(np.isfinite(chains.log_size), chains.log_size, -1e3)  # a walker that never found |F| > 0
    return {"sin theta": np.sin(theta), "cos phi": np.cos(phi), "sin phi": np.sin(phi), "log |F|": finite}


def diagnose(
    chains: Chains, nodes: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None, limits: Limits | None = None
) -> Diagnostics:
    """Convergence of the chains; `nodes` are places `[Q, 2]`, log |F| `[Q]` and shares of p* `[Q]` of a quadrature of
    the density that the chains were run on.
    """
    limits = Limits() if limits is None else limits
    steps, ensembles, walkers, _ = chains.place.shape
    owner = np.repeat(np.arange(ensembles), walkers)
    r_hat, nested, bulk, between, starts = [], [], [], [], []
    for trace in traces(chains).values():
        flat = trace.reshape(steps, -1).T
        if np.ptp(flat) == 0:
            r_hat.append(np.inf)
            continue
        r_hat.append(_number(array_stats.rhat(flat)))
        nested.append(_number(array_stats.rhat_nested(flat, owner)))
        bulk.append(min(_number(array_stats.ess(flat, method=m), 0.0) for m in ("mean", "bulk")))
        means = trace.mean(axis=(0, 2))
        between.append(float(trace.var() / max(means.var(ddof=1) / ensembles, 1e-300)))
        sides = [means[chains.start == k] for k in range(len(STARTS))]
        if min(map(len, sides)) > 1:
            starts.append(welch(*(Sample.of_independent(side) for side in sides)))
    ess = min(bulk, default=0.0)
    values = {
        "r_hat": max(r_hat),
        "nested_r_hat": max(nested, default=np.inf),
        "autocorrelation": steps * ensembles * walkers / max(ess, 1.0),
        "bulk_ess": ess,
        "between_ess": min(between, default=0.0),
        "acceptance": float(chains.acceptance.min()),
        "start_p": smallest_p(np.array(starts)) if starts else float("nan"),
        "unvisited": float("nan") if nodes is None else unvisited(chains, *nodes, ess=max(ess, 1.0)),
    }
    return Diagnostics(**values, reasons=_reasons(chains, values, limits))


def _number(value: object, fallback: float = np.inf) -> float:
    found = float(np.asarray(value))
    return found if np.isfinite(found) else fallback


def _reasons(chains: Chains, values: dict[str, float], limits: Limits) -> tuple[str, ...]:
    tau, nested = values["autocorrelation"], values["nested_r_hat"]
    lost = float(np.mean(~np.isfinite(chains.log_size[-1])))
    found = [
        (values["r_hat"] > limits.r_hat, f"R-hat of walkers {values['r_hat']:.3g} > {limits.r_hat:g}"),
        (nested > limits.nested, f"R-hat of ensembles {nested:.4g} > {limits.nested:g}"),
        (chains.steps < limits.steps * tau, f"{chains.steps} steps are {chains.steps / tau:.2g} autocorrelation times"),
        (chains.burn_in < limits.burn_in * tau, f"burn-in of {chains.burn_in / tau:.2g} autocorrelation times"),
        (values["acceptance"] < limits.acceptance, f"acceptance {values['acceptance']:.2g} < {limits.acceptance:g}"),
        (bool(chains.stuck.max() > 0), f"{chains.stuck.mean():.1%} of walkers never moved"),
        (lost > 0, f"{lost:.1%} of walkers never found |F| > 0"),
        (values["start_p"] < limits.start, f"ensembles of different starts differ, p = {values['start_p']:.2g}"),
        (values["unvisited"] > limits.unvisited, f"{values['unvisited']:.2%} of |F| hardly visited"),
    ]
    return tuple(text for bad, text in found if bad)


def unvisited(
    chains: Chains, place: np.ndarray, log_size: np.ndarray, share: np.ndarray, *, ess: float, most: int = 200_000
) -> float:
    """Share of p* in cells of (theta, log |F|) or (phi, log |F|) that hold more than 30 effective samples' worth of
    nodes, but in which, neighbours included, walkers spent less than a tenth of that.

    Cells of |F| tell a narrow lobe from the broad one that it sits on.
    """
    every = max(1, chains.log_size.size // most)
    seen, seen_size = chains.place[::every].reshape(-1, 2), chains.log_size[::every].reshape(-1)
    top = float(np.max(log_size[share > 0]))
    worst = 0.0
    for column, reach, periodic in ((0, np.pi / 2, False), (1, np.pi, True)):
        expected = _histogram(place[:, column], log_size, share, reach, top)
        found = _histogram(seen[:, column], seen_size, np.full(len(seen), 1 / len(seen)), reach, top)
        # a node stands for a neighbourhood that may lie in the next cell
        near = sum(np.roll(found, k, axis=0) for k in (-1, 0, 1)) if periodic else _neighbours(found, 0)
        near = _neighbours(near, 1)
        missed = (expected * ess > 30) & (near < 0.1 * expected)
        worst = max(worst, float(expected[missed].sum()))
    return worst


def _histogram(x: np.ndarray, log_size: np.ndarray, share: np.ndarray, reach: float, top: float) -> np.ndarray:
    """Cells `[24, 24]`: of x in [-reach, reach], and of |F| by factors of e downwards from its largest value."""
    column = np.clip(((x + reach) / (2 * reach) * _BINS).astype(int), 0, _BINS - 1)
    depth = np.clip(np.nan_to_num(top - log_size, nan=1e3, posinf=1e3, neginf=0.0), 0, _BINS - 1).astype(int)
    cells = np.bincount(column * _BINS + depth, weights=share, minlength=_BINS * _BINS)
    return cells.reshape(_BINS, _BINS)


def _neighbours(cells: np.ndarray, axis: int) -> np.ndarray:
    wide = np.pad(cells, [(1, 1) if k == axis else (0, 0) for k in range(2)])
    count = cells.shape[axis]
    return sum(np.take(wide, range(k, k + count), axis=axis) for k in range(3))
