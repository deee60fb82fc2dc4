"""Draws and tabulates what averaging estimators costs."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from dsfit.experiment.files import number
from dsfit.experiment.plots.style import COLORS, MARKERS
from dsfit.figures import Data, Table
from dsfit.figures.page import Page
from experiments.drawing import _averaging_captions

AVERAGE, BALANCE, BEST, WEIGHTED = COLORS[1], COLORS[0], COLORS[2], COLORS[3]
TOP = 100.0


def figures(data: Data, page: Page) -> dict[str, Figure]:
    """Number of proposals, pairs, one bad proposal, run time."""
    return {"proposals": _proposals(data, page), "pairs": _pairs(data, page), "bad": _bad(data, page),
            "time": _time(data, page)}  # fmt: skip


def captions(data: Data) -> dict[str, str]:
    """What the figures show."""
    return _averaging_captions.captions(data, averages, TOP)


def tables(data: Data) -> list[Table]:
    """Combinations by context, all pairs, readings of eqs 2 and 3, error at equal time."""
    return [_combinations(data), _pair_counts(data), _readings(data), _efficiency(data)]


def averages(single: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """V of the average, of the average with weights 1/V_k (harmonic mean of the V_k) and of the best one, of the first
    K proposals `[K]`."""
    size = np.arange(1, len(single) + 1)
    with np.errstate(divide="ignore"):
        return np.cumsum(single) / size, size / np.cumsum(1 / single), np.minimum.accumulate(single)


def _short_name(name: str) -> str:
    return name.replace("transmittance_", "transm. ")


def _title(context: dict[str, Any]) -> str:
    return f"{context['preset']}, θ_r = {number(context['theta_r_deg']):g}°, n = {number(context['n']):g}"


def _proposals(data: Data, page: Page) -> Figure:
    a, record = data.arrays, data.record
    order = record["order"]
    figure = page.figure(0.98)
    axes = figure.subplots(2, 2, sharex=True, squeeze=False).ravel()
    x = np.arange(1, len(order) + 1)
    for i, (axis, context) in enumerate(zip(axes, record["contexts"], strict=False)):
        average, weighted, best = averages(a["single"][i])
        shown = average < TOP
        axis.plot(x[shown], average[shown], color=AVERAGE, lw=1.1)
        axis.plot(x[~shown], np.full(int((~shown).sum()), 0.8 * TOP), "^", ms=4, color=AVERAGE)
        axis.plot(x, weighted, color=WEIGHTED, lw=1.1, ls="--")
        axis.plot(x, best, color=BEST, lw=1.1, drawstyle="steps-mid")
        axis.plot(x, a["balance.exact"][i], color=BALANCE, lw=1.1)
        axis.errorbar(x, a["balance.variance"][i], a["balance.variance_se"][i], fmt="o", ms=2.4, lw=0.8, color=BALANCE)
        at = a["average_at"][:, 0] == i
        axis.errorbar(
            a["average_at"][at, 1], a["average.variance"][at], a["average.variance_se"][at], fmt="s", ms=2.4, lw=0.8,
            color=AVERAGE,
        )  # fmt: skip
        low = 0.6 * min(float(a["balance.exact"][i].min()), float(best.min()))
        axis.set(title=_title(context), yscale="log", ylim=(low, TOP))
        axis.set_xticks(x, [_short_name(name) for name in order], rotation=60, ha="right")
        axis.grid(True)
    for axis in axes[::2]:
        axis.set_ylabel("N Var / |∫F|²")
    for axis in axes[2:]:
        axis.set_xlabel("proposal that joins")
    handles = [
        Line2D([], [], color=AVERAGE, marker="s", ms=3, label="average"),
        Line2D([], [], color=AVERAGE, marker="^", ls="", ms=4, label="average above the scale"),
        Line2D([], [], color=WEIGHTED, ls="--", label="average, weights 1/V"),
        Line2D([], [], color=BALANCE, marker="o", ms=3, label="balance, same samples"),
        Line2D([], [], color=BEST, label="best of them alone"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False)
    return figure


def _pairs(data: Data, page: Page) -> Figure:
    pairs, record = data.arrays["pairs"], data.record
    figure = page.figure(0.72)
    axis = figure.subplots()
    r = np.geomspace(1, 1e3, 200)
    axis.plot(r, (1 + r) / 2, color=AVERAGE, label="average, N samples in all: (1 + r) / 2")
    axis.plot(r, (1 + r) / 4, color=AVERAGE, ls="--", label="average, N samples of each: (1 + r) / 4")
    axis.axhline(1, color=BEST, label="the better one alone, N samples")
    for i, context in enumerate(record["contexts"]):
        some = pairs[(pairs[:, 0] == i) & (pairs[:, 3] < 1e3)]
        axis.plot(some[:, 3], some[:, 4], MARKERS[i], ms=3.6, color=(*COLORS[4:8], *COLORS[:4])[i], mew=0,
                  label=f"balance, N in all: {_title(context)}")  # fmt: skip
    axis.axvline(3, color="0.6", lw=0.8, ls=":")
    axis.annotate("r = 3", (3, 0.13), xytext=(3, 0), textcoords="offset points", fontsize=8, color="0.4")
    axis.set(
        xscale="log", yscale="log", xlim=(1, 1e3), ylim=(0.12, 100), xlabel="r = variance of the worse / of the better",
        ylabel="variance / that of the better one",
    )  # fmt: skip
    axis.grid(True)
    figure.legend(loc="outside lower center", ncols=2, frameon=False)
    return figure


def _bad(data: Data, page: Page) -> Figure:
    a, record = data.arrays, data.record
    figure = page.figure(0.66)
    left, right = figure.subplots(1, 2)
    c = a["bad.shares"]
    good = float(a["single"][0][record["order"].index(record["good"])])
    for b, alone in enumerate(a["bad.single"]):
        color = COLORS[b]
        left.plot(c, a["bad.balance"][b], color=color, lw=1.2)
        if alone < 1e3:
            left.plot(c, 0.25 * (good / (1 - c) + alone / c), color=color, lw=1.2, ls="--")
            left.plot(c, (1 - c) * good + c * alone, color=color, lw=1.2, ls=":")
        for ls, marker, key in (("-", "o", "growth.balance"), ("--", "s", "growth.average")):
            low, middle, high = np.moveaxis(a[key][b], -1, 0)
            right.errorbar(
                record["growth"], middle, (middle - low, high - middle), color=color, ls=ls, marker=marker, ms=3, lw=1
            )
    left.axhline(good, color="0.5", lw=0.9)
    left.set(yscale="log", xlim=(0, 1), ylim=(0.08, 40), xlabel="share of the samples of the bad one",
             ylabel="N Var / |∫F|²", title="by quadrature")  # fmt: skip
    right.set(xscale="log", yscale="log", xlabel="samples N", ylabel="estimate of N Var / |∫F|²",
              title="equal shares, measured")  # fmt: skip
    for axis in (left, right):
        axis.grid(True)
    handles = [
        Line2D([], [], color=COLORS[b], lw=2, label=f"bad: {name}, V = {_power(alone)}")
        for b, (name, alone) in enumerate(zip(record["bad"], a["bad.single"], strict=True))
    ]
    handles += [
        Line2D([], [], color="0.5", lw=0.9, label=f"{_short_name(record['good'])} alone, V = {good:.3g}"),
        Line2D([], [], color="0.2", ls="-", label="balance"),
        Line2D([], [], color="0.2", ls="--", label="average, equal weights"),
        Line2D([], [], color="0.2", ls=":", label="average, weights by share"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=2, frameon=False)
    return figure


def _power(value: float) -> str:
    """A number for a legend: its power of ten where it is large."""
    if not 1e4 < value < np.inf:
        return _number(value)
    return "10" + f"{np.log10(value):.0f}".translate(str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹"))


def _time(data: Data, page: Page) -> Figure:
    a, record = data.arrays, data.record
    figure = page.figure(0.86)
    axes = figure.subplots(2, 2, squeeze=False).ravel()
    for i, (axis, context) in enumerate(zip(axes, record["contexts"], strict=False)):
        for e, color in enumerate((AVERAGE, BALANCE, BEST)):
            axis.errorbar(
                1e3 * a["timed.seconds"][i, e], 100 * a["timed.error"][i, e], 196 * a["timed.error_se"][i, e],
                color=color, marker=MARKERS[e], ms=3.2, lw=1.1,
            )  # fmt: skip
        axis.set(title=f"{_title(context)}\nbest: {_short_name(record['best'][i])}", xscale="log", yscale="log")
        for side in (axis.xaxis, axis.yaxis):
            side.set_minor_formatter(NullFormatter())
            side.set_major_locator(LogLocator(subs=(1, 3)))
            side.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
        axis.grid(True)
    for axis in axes[::2]:
        axis.set_ylabel("relative error / %")
    for axis in axes[2:]:
        axis.set_xlabel("CPU time of an estimate / ms")
    labels = (f"average of {record['timed_proposals']}", f"balance of {record['timed_proposals']}", "best alone")
    handles = [
        Line2D([], [], color=color, marker=MARKERS[e], ms=3.2, lw=1.1, label=label)
        for e, (color, label) in enumerate(zip((AVERAGE, BALANCE, BEST), labels, strict=True))
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False)
    return figure


def _kinds(data: Data, index: int) -> list[str]:
    count = data.record["timed_proposals"]
    return [f"average of {count}", f"balance of {count}", f"{data.record['best'][index]} alone"]


def _number(value: float) -> str:
    if np.isinf(value):
        return "infinite"
    return "does not cover F" if np.isnan(value) else f"{value:.3g}"


def _combinations(data: Data) -> Table:
    a, record, rows = data.arrays, data.record, []
    for i, context in enumerate(record["contexts"]):
        average, weighted, best = averages(a["single"][i])
        for k in (2, record["timed_proposals"], len(record["order"])):
            rows.append([
                _title(context), str(k), _number(best[k - 1]), _number(average[k - 1]), _number(weighted[k - 1]),
                f"{a['balance.exact'][i, k - 1]:.3g}",
                f"{a['balance.variance'][i, k - 1]:.3g} ± {a['balance.variance_se'][i, k - 1]:.1g}",
            ])  # fmt: skip
    z = (a["balance.mean"] - 1) / a["balance.mean_se"]
    z_average = (a["average.mean"] - 1) / a["average.mean_se"]
    caption = (
        "N Var / |∫F|² for the first K proposals with equal counts: the best of them alone, the average of their "
        "estimates, the average with weights 1/V, and the balance heuristic of the same samples by quadrature and "
        f"measured. Means of balance deviate from the integral by {np.sqrt(np.mean(z**2)):.2f} standard errors in the "
        f"root mean square (largest {np.abs(z).max():.1f}), those of averages by "
        f"{np.sqrt(np.mean(z_average**2)):.2f} (largest {np.abs(z_average).max():.1f})."
    )
    head = ["context", "K", "best alone", "average", "weights 1/V", "balance", "measured"]
    return Table("combinations", caption, head, rows)


def _pair_counts(data: Data) -> Table:
    pairs, record, rows = data.arrays["pairs"], data.record, []
    groups = [(_title(c), pairs[pairs[:, 0] == i]) for i, c in enumerate(record["contexts"])]
    for title, some in [*groups, ("all", pairs)]:
        r, balance = some[:, 3], some[:, 4]
        rows.append([
            title, str(len(some)), str(int(((1 + r) / 2 < 1).sum())), str(int((r < 3).sum())),
            str(int((balance < 1).sum())), f"{np.median((1 + r) / 2):.3g}", f"{np.median(balance):.3g}",
            f"{balance.max():.3g}",
        ])  # fmt: skip
    caption = (
        "Pairs of proposals with finite variance, equal shares, against the better one of the pair alone: pairs in "
        "which the average of N samples in all is better (none can be); in which the average of N samples of each is "
        "better "
        "than N of the better one, at twice the samples (r < 3); in which balance is better with N in all; median of "
        "average and balance over the better one, and the largest for balance."
    )
    head = ["context", "pairs", "average better", "r < 3", "balance better", "average, median", "balance, median",
            "balance, largest"]  # fmt: skip
    return Table("pairs", caption, head, rows)


def _readings(data: Data) -> Table:
    mean, error = data.arrays["readings.mean"], data.arrays["readings.mean_se"]
    rows = []
    for row, m, e in zip(data.record["readings"], mean, error, strict=True):
        z = (m - 1) / e
        verdict = "unbiased" if abs(z) < 4 else "biased"
        rows.append([row["density"], row["reading"], f"{m:.4f} ± {e:.4f}", f"{z:.1f}", verdict])
    caption = (
        f"Mean of the estimate over the integral, two proposals (three quarters of the samples from the one named, a "
        f"quarter from the uniform sphere; {_title(data.record['contexts'][0])}): eqs 2 and 3 as printed are right; "
        "what biases them are densities that are not those of their samplers. Biased: by more than 4 standard errors."
    )
    return Table("readings", caption, ["first proposal", "estimator", "mean", "z", "verdict"], rows, "llrrl")


def _efficiency(data: Data) -> Table:
    a, record, rows = data.arrays, data.record, []
    for i, context in enumerate(record["contexts"]):
        average, _, best = averages(a["single"][i])
        last = record["timed_proposals"] - 1
        variance = np.array([average[last], a["balance.exact"][i, last], best[-1]])
        cost = a["timed.seconds"][i, :, -1] * variance
        each = a["timed.seconds"][i, :, -1] / record["timed_samples"][-1]
        for e, label in enumerate(_kinds(data, i)):
            rows.append([_title(context), label, f"{1e6 * each[e]:.3g}", f"{100 * a['timed.error'][i, e, -1]:.2f}",
                         f"{cost[e] / cost[2]:.3g}"])  # fmt: skip
    caption = (
        f"Estimates of {record['timed_samples'][-1]} samples in one thread: CPU time a sample, relative error, and "
        "variance (quadrature) x time over that of the best proposal alone: the time it takes to the same error."
    )
    head = ["context", "estimator", "µs a sample", "error / %", "time to equal error"]
    return Table("time", caption, head, rows, "llrrr")
