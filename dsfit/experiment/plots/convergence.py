"""Relative error against run time, for every method."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from dsfit.experiment.files import number
from dsfit.experiment.plots.style import look, new_figure, short, spread

MOST_PANELS = 6
MOST_METHODS = 8
TARGET = 0.01


def convergence(result: dict[str, Any]) -> Figure:
    """One panel per context (six at most): RMSE of |I_est - I| / |I| against seconds per estimate, both logarithmic.

    Points are measured: root mean squares over the repeats, medians of the time; bars are one standard error and the
    quartiles of the time. Lines are what quadrature predicts, sqrt(variance per sample / N), at the time per sample
    of the largest N. Dashed lines start with the time of the fit. The dotted line marks an error of 1 %.
    """
    cells = result["cells"]
    chosen = spread(len(cells), MOST_PANELS)
    columns = min(len(chosen), 3 if len(chosen) > 4 else 2)
    rows = math.ceil(len(chosen) / columns)
    figure = new_figure(1.2 + 3.4 * columns, 1.3 + 2.6 * rows)
    axes = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    shown = _shown(cells)
    panels = [_Panel(cells[index], shown) for index in chosen]
    limits = _limits(panels)
    handles: dict[str, Any] = {}
    for axis, panel in zip(axes.flat, panels, strict=False):
        panel.draw(axis, limits, handles)
    for axis in list(axes.flat)[len(chosen) :]:
        axis.set_visible(False)
    for axis in axes[-1]:
        axis.set_xlabel("run time of one estimate / s (one thread)")
    for row in axes:
        row[0].set_ylabel("relative RMSE")
    names = [name for name in handles if not name.endswith("fit time added")]
    names += [name for name in handles if name.endswith("fit time added")]
    figure.legend(
        [handles[name] for name in names],
        names,
        loc="outside lower center",
        ncols=min(4, max(2, columns + 1)),
        frameon=False,
    )
    note = "" if len(chosen) == len(cells) else f" ({len(chosen)} of {len(cells)} contexts)"
    figure.suptitle(short(result["title"] or result["name"], 90) + note, fontsize=10)
    return figure


def _shown(cells: list[dict[str, Any]]) -> list[str]:
    """The methods to draw, in their order: all of them, or the first two and those that reach 1 % soonest."""
    names = [m["name"] for m in cells[0]["methods"]]
    if len(names) <= MOST_METHODS:
        return names
    seconds = [
        np.median([number(cell["methods"][k]["seconds_to_1_percent"]) for cell in cells]) for k in range(len(names))
    ]
    fastest = [k for k in np.argsort(seconds) if k > 1][: MOST_METHODS - 2]
    return [names[k] for k in sorted([0, 1, *fastest])]


class _Panel:
    """The curves of one cell."""

    def __init__(self, cell: dict[str, Any], shown: list[str]) -> None:
        self.cell = cell
        self.methods = [(k, m) for k, m in enumerate(cell["methods"]) if m["name"] in shown and m["estimates"]]

    def points(self, method: dict[str, Any]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Quartiles of the time `[K, 3]`, error `[K]` and its standard error `[K]`."""
        estimates = method["estimates"]
        time = np.array([e["seconds"] for e in estimates], dtype=float)
        columns = (np.array([number(e[key]) for e in estimates]) for key in ("rmse", "rmse_error"))
        return time, *columns

    def draw(self, axis: Any, limits: tuple[float, float, float, float], handles: dict[str, Any]) -> None:
        """Draw all methods; `limits` are x0, x1, y0, y1."""
        axis.set(xscale="log", yscale="log", title=self.cell["label"], xlim=limits[:2], ylim=limits[2:])
        axis.grid(True, which="major")
        axis.axhline(TARGET, color="#555555", linestyle=":", linewidth=1)
        for place, (_, method) in enumerate(self.methods):
            style = look(place if len(self.methods) < len(self.cell["methods"]) else self.methods[place][0])
            time, error, spread_of = self.points(method)
            bars = np.stack([np.minimum(spread_of, 0.9 * error), spread_of])  # zero has no place on a log axis
            across = np.stack([time[:, 1] - time[:, 0], time[:, 2] - time[:, 1]])
            marks = {"linestyle": "none", "markersize": 4, "elinewidth": 0.9, "capsize": 1.5, "zorder": 3}
            line = axis.errorbar(time[:, 1], error, yerr=bars, xerr=across, **marks, **style)
            handles.setdefault(method["name"], line)
            self._predicted(axis, method, style, limits, handles)

    def _predicted(
        self,
        axis: Any,
        method: dict[str, Any],
        style: dict[str, Any],
        limits: tuple[float, ...],
        handles: dict[str, Any],
    ) -> None:
        variance, per_sample = number(method["variance"]), number(method["seconds_per_sample"])
        if not (math.isfinite(variance) and variance > 0):
            return
        samples = np.logspace(0, math.log10(limits[1] / per_sample), 200)
        error = np.sqrt(variance / samples)
        axis.plot(samples * per_sample, error, color=style["color"], linewidth=1)
        fit = number((method.get("fit") or {}).get("seconds", 0.0))
        if fit > 0:
            (dashed,) = axis.plot(
                samples * per_sample + fit, error, color=style["color"], linestyle="--", linewidth=1.2
            )
            handles.setdefault(f"{method['name']}, fit time added", dashed)


def _limits(panels: list[_Panel]) -> tuple[float, float, float, float]:
    """Common limits: all measured points, the target, and room to the right for what a fit costs."""
    times, errors, fits = [], [TARGET], [0.0]
    for panel in panels:
        for _, method in panel.methods:
            time, error, _ = panel.points(method)
            times += [time.min(), time.max()]
            errors += [e for e in error if e > 0]
            fits.append(number((method.get("fit") or {}).get("seconds", 0.0)))
    return min(times) / 1.5, max(*times, *(5 * f for f in fits)) * 1.5, min(errors) / 2, max(errors) * 2
