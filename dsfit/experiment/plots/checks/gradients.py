"""Monte Carlo gradients of the second moment beside those of quadrature, and what they cost."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from dsfit.experiment.plots.style import COLORS, MARKERS, new_figure, spread
from dsfit.experiment.rundir import RunDirectory

_CONTEXTS = 4
_EXACT = "#555555"
_LINEAR = 0.03  # gradients relative to the largest below which their axis is linear


def figures(directory: RunDirectory, result: dict[str, Any]) -> Iterator[tuple[str, Figure]]:
    """One figure for each of at most four contexts."""
    cells = [cell for cell in result["cells"] if cell["suite"] == "gradients"]
    for index in spread(len(cells), _CONTEXTS):
        cell = cells[index]
        arrays = directory.arrays(cell["index"])
        if len(arrays["names"]):
            yield f"gradients-{cell['index']:04d}", context_figure(cell["label"], arrays)


def context_figure(label: str, arrays: dict[str, np.ndarray]) -> Figure:
    """A row for each proposal: every parameter's gradient with one standard error, and variance times time."""
    names, estimators = arrays["names"].tolist(), arrays["estimators"].tolist()
    figure = new_figure(13.0, 1.2 + 2.35 * len(names))
    axes = figure.subplots(len(names), 2, squeeze=False, width_ratios=(4.2, 1))
    for k, name in enumerate(names):
        _gradient(axes[k, 0], name, arrays, k)
        _cost(axes[k, 1], arrays[f"cost_{k}"], estimators)
    axes[0, 1].set_title("variance × time / |∇M|², µs", loc="right")
    handles = [
        Line2D([], [], color=_EXACT, marker="_", linestyle="", markersize=12, markeredgewidth=2, label="quadrature"),
        *(_handle(j, x) for j, x in enumerate(estimators)),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)
    figure.suptitle(f"∂M/∂parameter by Monte Carlo, ± one standard error: {label}", fontsize=10)
    return figure


def _handle(j: int, name: str) -> Line2D:
    return Line2D([], [], color=COLORS[j], marker=MARKERS[j], linestyle="", markersize=4, label=name)


def _gradient(axis: Any, name: str, arrays: dict[str, np.ndarray], k: int) -> None:
    exact, labels = arrays[f"exact_{k}"], arrays[f"labels_{k}"].tolist()
    mean, error = arrays[f"mean_{k}"], arrays[f"error_{k}"]
    unit = max(float(np.abs(exact).max()), 1e-300)
    x = np.arange(len(exact))
    for place in x[1::2]:
        axis.axvspan(place - 0.5, place + 0.5, color="#f4f4f4", linewidth=0)
    axis.hlines(exact / unit, x - 0.42, x + 0.42, color=_EXACT, linewidth=2)
    for j in range(len(mean)):
        at = x + 0.62 * ((j + 0.5) / len(mean) - 0.5)
        axis.errorbar(
            at, mean[j] / unit, error[j] / unit, color=COLORS[j], marker=MARKERS[j], markersize=3, linestyle="",
            elinewidth=1, zorder=3,
        )  # fmt: skip
    axis.axhline(0, color="#999999", linewidth=0.6)
    axis.set_xticks(x, labels, rotation=60, ha="right", rotation_mode="anchor", fontsize=6.5)
    axis.set_yscale("symlog", linthresh=_LINEAR, linscale=0.6)
    axis.set_yticks([-1, -0.1, 0, 0.1, 1], ["−1", "−0.1", "0", "0.1", "1"])
    axis.set(xlim=(-0.5, len(exact) - 0.5), ylim=(-2, 2), ylabel=f"∂M / {unit:.3g}")
    axis.set_title(name, loc="left")
    axis.grid(True, axis="y")


def _cost(axis: Any, cost: np.ndarray, names: list[str]) -> None:
    axis.bar(range(len(cost)), cost, color=COLORS[: len(cost)], width=0.7)
    for j, value in enumerate(cost):
        axis.text(j, value, f"{value:,.0f}" if value >= 10 else f"{value:.2g}", ha="center", va="bottom", fontsize=7)
    axis.set_yscale("log")
    axis.set_ylim(float(cost.min()) / 4, float(cost.max()) * 4)
    axis.set_xticks(range(len(cost)), names, rotation=30, ha="right", rotation_mode="anchor", fontsize=7)
    axis.grid(True, axis="y")
