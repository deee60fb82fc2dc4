"""Draws error against run time and excess of estimators; tabulates medians over contexts, and every context."""

from __future__ import annotations

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from dsfit.experiment.plots.style import COLORS, MARKERS, spread
from dsfit.experiment.race_report import seconds
from dsfit.figures import Data, Table
from dsfit.figures.page import Page

_TARGET = 0.01
_PANELS = 3
_HIGHEST = 1e9
_DRAWN = ("uniform", "M_R only", "", "all, balance", "all, optimal", "best heuristic mix", "structured", "fitted")
_SINGLE = " only"
_PALETTE = (7, 1, 4, 3, 5, 2, 0, 6)  # grey for what is there to compare with, black for the fit


def figures(data: Data, page: Page) -> dict[str, Figure]:
    """Error against run time, median and single contexts; excess of every method and context."""
    return {"error_time": _error_time(data, page), "excess": _excess(data, page)}


def captions(data: Data) -> dict[str, str]:
    """What the two figures show."""
    return {
        "error_time": "Relative error against the run time of one estimate, one thread, float64. Points: measured; "
        "bars: standard errors, in the first panel the middle 80 % of the contexts. Lines: sqrt(variance/N) from "
        "quadrature, at the time per sample of the longest estimates, which the fixed cost of a call exceeds on the "
        "left; dashed: with the time of the fit before. Errors of M_R alone have no line: its variance is infinite or "
        "as good as, and what is measured understates it.",
        "excess": "Excess of every method at every context, by quadrature: 0 is the limit of any density. Bars: "
        "medians. At the right end 1e9 or more; optimal MIS weights can be below 0, shown at the left end.",
    }


def _drawn(data: Data) -> list[str]:
    """The methods to tell apart in curves: those of every kind, and the best single proposal."""
    methods = data.record["methods"]
    best = _best_single(data)
    return [name for name in methods if name == best or (name.startswith(tuple(d for d in _DRAWN if d)))]


def _best_single(data: Data) -> str:
    """The proposal of least median time to 1 % among those alone."""
    single = [name for name in data.record["methods"] if name.endswith(_SINGLE)]
    return min(single, key=lambda name: (np.median(_to_target(data, name)), name)) if single else ""


def _to_target(data: Data, name: str) -> np.ndarray:
    """Seconds to 1 % error `[contexts]`, without the fit: variance / 0.01^2 samples."""
    return data.arrays[f"variance.{name}"] / _TARGET**2 * data.arrays[f"per_sample.{name}"]


def _error_time(data: Data, page: Page) -> Figure:
    """First panel: medians over contexts, with the range of the middle 80 %; then single contexts."""
    labels, names = data.record["contexts"], _drawn(data)
    chosen = [labels.index(label) for label in data.record["panels"] if label in labels] or spread(len(labels), 1)
    chosen = chosen[:_PANELS]
    figure = page.figure(1.0 if len(chosen) > 1 else 0.62)
    axes = figure.subplots(2 if len(chosen) > 1 else 1, 1 + (len(labels) > 1), sharex=True, sharey=True, squeeze=False)
    limits = _limits(data, names)
    groups = [(f"median of {len(labels)} contexts", None), *((labels[k], k) for k in chosen)][len(labels) == 1 :]
    for axis, (title, context) in zip(axes.flat, groups, strict=False):
        _panel(axis, data, names, context, limits)
        axis.set_title(title)
    for axis in list(axes.flat)[len(groups) :]:
        axis.set_visible(False)
    for axis in axes[-1]:
        axis.set_xlabel("run time of one estimate / s")
    for row in axes:
        row[0].set_ylabel("relative error (RMSE)")
    handles, words = axes[0][0].get_legend_handles_labels()
    figure.legend(handles, words, loc="outside lower center", ncols=3, frameon=False)
    return figure


def _panel(axis: Axes, data: Data, names: list[str], context: int | None, limits: tuple[float, ...]) -> None:
    axis.set(xscale="log", yscale="log", xlim=limits[:2], ylim=limits[2:])
    axis.grid(True)
    axis.axhline(_TARGET, color="#555555", linestyle=":", linewidth=1)
    for k, name in enumerate(names):
        color, marker = COLORS[_PALETTE[k % len(_PALETTE)]], MARKERS[k % len(MARKERS)]
        _measured(axis, data, name, context, color, marker)
        _predicted(axis, data, name, context, color, limits)
    axis.xaxis.set_major_formatter(FuncFormatter(_power))
    axis.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{100 * value:g} %"))


def _power(value: float, _: float) -> str:
    return f"1e{round(math.log10(value))}" if value > 0 else ""


def _measured(axis: Axes, data: Data, name: str, context: int | None, color: str, marker: str) -> None:
    """What was measured; bars are standard errors, or the middle 80 % of the contexts."""
    error, bars, time = (data.arrays[f"{key}.{name}"] for key in ("rmse", "rmse_error", "time"))
    if context is None:
        middle, ends = np.nanmedian(error, axis=0), np.nanquantile(error, (0.1, 0.9), axis=0)
        x = np.nanmedian(time[..., 1], axis=0)
        across = np.stack([middle - ends[0], ends[1] - middle])
    else:
        middle, x = error[context], time[context, :, 1]
        across = np.stack([np.minimum(bars[context], 0.9 * middle), bars[context]])
    axis.errorbar(
        x, middle, yerr=across, color=color, marker=marker, linestyle="none", markersize=3.6, elinewidth=0.8, label=name
    )


def _predicted(axis: Axes, data: Data, name: str, context: int | None, color: str, limits: tuple[float, ...]) -> None:
    """sqrt(variance / N) at the time of N samples, and, dashed, with the time of the fit before it."""
    chosen = slice(None) if context is None else slice(context, context + 1)
    product = data.arrays[f"variance.{name}"][chosen] * data.arrays[f"per_sample.{name}"][chosen]
    level = float(np.median(np.sqrt(np.maximum(product, 0.0))))
    if not (math.isfinite(level) and level > 0):
        return
    time = np.logspace(math.log10(limits[0]), math.log10(limits[1]), 300)
    if name != "M_R only":  # its variance is infinite, or as good as: what is measured understates it
        axis.plot(time, level / np.sqrt(time), color=color, linewidth=0.9)
    fit = float(np.nanmedian(data.arrays[f"fit_time.{name}"][chosen])) if _fitted(data, name) else 0.0
    if fit > 0:
        axis.plot(time + fit, level / np.sqrt(time), color=color, linewidth=1.1, linestyle=(0, (4, 2)))


def _fitted(data: Data, name: str) -> bool:
    return bool(np.isfinite(data.arrays[f"fit_time.{name}"]).any())


def _limits(data: Data, names: list[str]) -> tuple[float, float, float, float]:
    """x0, x1, y0, y1 that hold what was measured, with room for fits at the right."""
    arrays = data.arrays
    times = [arrays[f"time.{name}"] for name in names]
    errors = np.concatenate([np.ravel(arrays[f"rmse.{name}"]) for name in names])
    fits = [float(np.nanmax(arrays[f"fit_time.{name}"])) for name in names if _fitted(data, name)]
    right = max(float(max(np.nanmax(t) for t in times)), 10 * max(fits, default=0.0))
    return (
        float(min(np.nanmin(t) for t in times)) / 1.6,
        right,
        max(float(np.nanmin(errors)) / 2, 1e-5),
        min(float(np.nanmax(errors)) * 2, 3.0),
    )


def _excess(data: Data, page: Page) -> Figure:
    """A row for every method, a dot for every context, coloured by fibre; the bar is the median."""
    names, labels = data.record["methods"], data.record["contexts"]
    fibres = [label.partition(",")[0] for label in labels]
    kinds = list(dict.fromkeys(fibres))
    figure = page.figure(0.2 + 0.036 * len(names))
    axis = figure.subplots()
    shift = np.linspace(-0.3, 0.3, len(labels)) if len(labels) > 1 else np.zeros(1)
    for row, name in enumerate(names):
        excess = np.clip(data.arrays[f"excess.{name}"], 1e-6, _HIGHEST)
        for k, kind in enumerate(kinds):
            own = [i for i, fibre in enumerate(fibres) if fibre == kind]
            style = {"color": COLORS[k], "marker": MARKERS[k], "linestyle": "none", "markersize": 3}
            axis.plot(excess[own], row + shift[own], label=kind if row == 0 else None, **style)
        axis.plot([np.median(excess)] * 2, [row - 0.42, row + 0.42], color="black", linewidth=1.4)
    axis.set(xscale="log", ylim=(len(names) - 0.5, -0.5))
    axis.set_yticks(range(len(names)), names)
    axis.set_xlabel("excess M(p)/M* − 1")
    axis.xaxis.set_major_formatter(FuncFormatter(_power))
    axis.grid(True, axis="x")
    figure.legend(loc="outside lower center", ncols=len(kinds), frameon=False, title="fibre")
    return figure


def tables(data: Data) -> list[Table]:
    """Medians over contexts, and every context."""
    return [_medians(data), _contexts(data)]


def _medians(data: Data) -> Table:
    head = ["method", "excess", "worst", "time to 1 %", "fit", "× uniform", "× best mix"]
    methods = data.record["methods"]
    uniform = next((name for name in methods if name.startswith("uniform")), methods[0])
    mix = next((name for name in methods if name.startswith("best heuristic")), methods[0])
    rows = []
    for name in methods:
        excess, time = data.arrays[f"excess.{name}"], _to_target(data, name)
        fit = seconds(float(np.nanmedian(data.arrays[f"fit_time.{name}"]))) if _fitted(data, name) else ""
        gains = [_short(float(np.median(_to_target(data, other) / time))) for other in (uniform, mix)]
        rows.append(
            [
                name,
                _short(float(np.median(excess))),
                _short(float(excess.max())),
                _time(float(np.median(time))),
                fit,
                *gains,
            ]
        )
    caption = (
        f"Medians over {len(data.record['contexts'])} contexts, one thread; worst: the largest excess. Time to 1 % is "
        "that of variance / 0.01² samples, without the fit, at the time per sample of "
        "the longest estimates. × uniform, × best mix: how many times as long these take, "
        "medians of the ratios."
    )
    return Table("medians", caption, head, rows)


def _contexts(data: Data) -> Table:
    """Excess and time by context, and what the fit gains over the best heuristic mix."""
    shown = [name for name in _drawn(data) if name not in ("M_R only", _best_single(data))]
    single = [name for name in data.record["methods"] if name.endswith(_SINGLE)]
    rows = []
    for k, label in enumerate(data.record["contexts"]):
        for kind, of in (
            ("excess", lambda name: data.arrays[f"excess.{name}"]),
            ("s to 1 %", lambda name: _to_target(data, name)),
        ):
            values = [float(of(name)[k]) for name in shown]
            best = min((float(of(name)[k]) for name in single), default=math.nan)
            weight = _short(float(data.arrays["weight.fitted"][k])) if kind == "excess" else ""
            rows.append([label, kind, *map(_short, values), _short(best), weight])
    ratio = data.arrays["excess.best heuristic mix"] / data.arrays["excess.fitted"]
    speed = _to_target(data, "best heuristic mix") / _to_target(data, "fitted")
    fitted = data.arrays["excess.fitted"]
    caption = (
        f"Excess and seconds to 1 % error. Fitted: median excess {np.median(fitted):.2g}, worst {fitted.max():.2g}, "
        f"below the best heuristic mix by {ratio.min():.3g} at least, {np.median(ratio):.3g} in the median, "
        f"{ratio.max():.3g} at most, by less than 100 in {int((ratio < 100).sum())} of {len(ratio)} contexts; "
        f"{_short(float(speed.min()))}, {_short(float(np.median(speed)))} and {_short(float(speed.max()))} times "
        "quicker to 1 %. Best single: the least of all proposals alone. Weight: the largest that a "
        "sample of the fit can have."
    )
    head = ["context", "", *shown, "best single", "weight"]
    return Table("contexts", caption, head, rows, "ll" + "r" * (len(shown) + 2))


def _short(value: float) -> str:
    if math.isnan(value):
        return "-"
    if value >= 1e16 or value < 1e-12:
        return "> 1e16" if value > 1 else "< 1e-12"
    return f"{value:.3g}" if 1e-3 <= abs(value) < 1e4 else f"{value:.1e}"


def _time(value: float) -> str:
    return "never" if value > 3e9 else seconds(value)  # a century
