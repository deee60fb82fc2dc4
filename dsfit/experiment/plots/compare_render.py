"""Error against run time of every technique on an image."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from dsfit.experiment.compare_render_summary import painted, reference_of, samples_light
from dsfit.experiment.files import number
from dsfit.experiment.plots.style import COLORS, new_figure, short

_MARKERS = ("o", "s", "^", "D", "v", "h", "<", ">")
_HIGHEST = 10.0


def compare_curves(result: dict[str, Any]) -> Figure:
    """Relative error against CPU seconds: left of what is already prepared, right with preparation counted.

    A colour for every way of drawing directions; solid with Sobol points, dashed with random ones; hollow markers where
    light is sampled too; dotted where a few pixels decide the error (it is understated). The grey line is the
    reference's own error, which has been taken out of the others.
    """
    cells = painted(result)
    figure = new_figure(12.5, 6.0)
    axes = figure.subplots(1, 2, sharey=True)
    for axis, counted in zip(axes, (False, True), strict=True):
        for cell in cells:
            _curve(axis, cell, _style(cell, cells), counted)
        _dress(axis, result, counted)
    axes[0].set_ylabel("relative error (root mean square)")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right center", frameon=False, fontsize=7.5)
    figure.suptitle(short(result["title"] or result["name"], 110), fontsize=10)
    return figure


def way(cell: dict[str, Any]) -> str:
    """What cells have in common that differ in their points and in light sampling only."""
    return str([cell["kind"], {k: v for k, v in cell["options"].items() if k != "light_sampling"}])


def _style(cell: dict[str, Any], cells: list[dict[str, Any]]) -> dict[str, Any]:
    ways = list(dict.fromkeys(way(c) for c in cells))
    k = ways.index(way(cell))
    line = "-" if cell["uniforms"] == "sobol" else (0, (4, 2))
    return {
        "color": COLORS[k % len(COLORS)],
        "marker": _MARKERS[k % len(_MARKERS)],
        "linestyle": ":" if cell["heavy"] else line,
        "markerfacecolor": "white" if samples_light(cell) else None,
        "linewidth": 1.3,
        "markersize": 4.0,
        "markeredgewidth": 0.9,
    }


def _curve(axis: Axes, cell: dict[str, Any], style: dict[str, Any], counted: bool) -> None:
    before = number(cell["prepare"]["seconds"]) if counted else 0.0
    seconds = np.array([before + number(rung["seconds"]) for rung in cell["rungs"]])
    error = np.array([number(rung["error"]) for rung in cell["rungs"]])
    good = np.isfinite(error) & (error > 0)
    slope = number(cell["slope"])
    label = short(cell["technique"], 44) + ("" if math.isnan(slope) else f"  ({slope:.2f})")
    axis.plot(seconds[good], error[good], label=label, **style)


def _dress(axis: Axes, result: dict[str, Any], counted: bool) -> None:
    axis.set(xscale="log", yscale="log")
    axis.set_xlabel("CPU seconds, preparation counted" if counted else "CPU seconds, prepared")
    own = number(reference_of(result)["own_error"])
    axis.axhline(own, color="#999999", linewidth=1.0)
    axis.annotate(
        "the reference's own error", (0.99, own), xycoords=("axes fraction", "data"), ha="right", va="bottom",
        fontsize=7, color="#777777",
    )  # fmt: skip
    for target in result["config"]["compare"]["targets"]:
        axis.axhline(number(target), color="#555555", linestyle=":", linewidth=0.8)
    low, high = axis.get_ylim()
    axis.set_ylim(low, min(high, _HIGHEST))
    axis.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{100 * value:g} %"))
    axis.grid(True, which="major")
    axis.set_title("slopes in brackets" if not counted else "everything counted")
