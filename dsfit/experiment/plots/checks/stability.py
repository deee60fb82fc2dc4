"""The stability atlas as maps: functions by classes of regimes, coloured by the worst relative error."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle

from dsfit.checks.stability.function import CLASSES
from dsfit.experiment.files import number
from dsfit.experiment.plots.style import new_figure
from dsfit.experiment.rundir import RunDirectory

_DTYPES = ("float64", "float32")
_STEPS = {"float64": np.arange(-16, 1), "float32": np.arange(-8, 1)}  # powers of ten between which colours change
_BAD, _NONE = "#7f0000", "#f4f4f4"
_ROW, _COLUMN = 0.165, 0.27  # inches


def figures(directory: RunDirectory, result: dict[str, Any]) -> Iterator[tuple[str, Figure]]:
    """The library's errors; and, for functions that have a naive formula, the naive ones beside them."""
    found = [f for cell in result["cells"] if cell["suite"] == "stability" for f in cell["findings"]]
    names = list(dict.fromkeys(f["subject"] for f in found))
    panels = [(f"{q}, {d}", _Grid(found, names, d, q, False)) for d in _DTYPES for q in ("value", "gradient")]
    yield "stability", _maps(names, panels, result["title"] or result["name"])
    compared = list(dict.fromkeys(f["subject"] for f in found if "naive" in f["data"]))
    for quantity in ("value", "gradient"):
        mine = [name for name in compared if any(_has_naive(f, name, quantity) for f in found)]
        panels = []
        for dtype in _DTYPES:
            panels.append((f"dsfit, {dtype}", _Grid(found, mine, dtype, quantity, False)))
            panels.append((f"naive formula, {dtype}", _Grid(found, mine, dtype, quantity, True)))
        if mine:
            yield f"stability-naive-{quantity}", _maps(mine, panels, f"The formula as first written: {quantity}")


def _has_naive(finding: dict[str, Any], name: str, quantity: str) -> bool:
    data = finding["data"]
    return finding["subject"] == name and "naive" in data and data["quantity"] == quantity


class _Grid:
    """Worst error, faults and verdict of each function and class of regimes."""

    def __init__(
        self, findings: Sequence[dict[str, Any]], names: Sequence[str], dtype: str, quantity: str, naive: bool
    ) -> None:
        self.dtype = dtype
        shape = (len(names), len(CLASSES))
        self.error = np.full(shape, np.nan)
        self.fault = np.full(shape, "", dtype="<U1")
        self.failed = np.zeros(shape, dtype=bool)
        rows, columns = {n: i for i, n in enumerate(names)}, {c: i for i, c in enumerate(CLASSES)}
        for finding in findings:
            data = finding["data"]
            if finding["subject"] not in rows or data["dtype"] != dtype or data["quantity"] != quantity:
                continue
            if naive and "naive" not in data:
                continue
            errors = data["naive"] if naive else data
            at = rows[finding["subject"]], columns[data["class"]]
            self.error[at] = np.fmax(self.error[at], number(errors["worst"]))
            for mark, key in (("0", "zero"), ("−", "negative"), ("∞", "infinite"), ("×", "nan")):
                if errors[key]:
                    self.fault[at] = mark
            self.failed[at] |= not naive and not number(finding["value"]) <= number(finding["bound"])


def _maps(names: Sequence[str], panels: Sequence[tuple[str, _Grid]], title: str) -> Figure:
    """Panels side by side with one list of functions."""
    wide, high = len(CLASSES) * _COLUMN * len(panels), len(names) * _ROW
    figure = new_figure(wide + 2.9, high + 2.3)
    figure.get_layout_engine().set(w_pad=0.1)
    axes = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    for axis, (label, grid) in zip(axes, panels, strict=True):
        _panel(axis, names, label, grid)
    axes[0].set_yticks(range(len(names)), names, fontsize=7)
    for dtype in _DTYPES:
        mine = [axis for axis, (_, grid) in zip(axes, panels, strict=True) if grid.dtype == dtype]
        colors, norm = _scale(dtype)
        mappable = matplotlib.cm.ScalarMappable(norm, colors)
        bar = figure.colorbar(mappable, ax=mine, location="bottom", aspect=40, shrink=0.9, pad=0.01)
        bar.set_ticks(_STEPS[dtype][::2], labels=[f"$10^{{{k}}}$" for k in _STEPS[dtype][::2]])
        bar.set_label(f"worst relative error, {dtype}")
    marks = [
        Patch(facecolor=_BAD, label="no digit: × NaN, ∞ infinite, 0 wrong zero, − negative"),
        Patch(facecolor="white", label="= exact"),
        Patch(facecolor=_NONE, edgecolor="#cccccc", label="not measured"),
        Patch(facecolor="white", edgecolor="#d000d0", linewidth=1.5, label="beyond the stated limit"),
    ]
    figure.legend(handles=marks, loc="outside lower center", ncols=4, frameon=False, fontsize=7)
    figure.suptitle(f"{title} (numbers: −log₁₀ of the worst relative error)", fontsize=10)
    return figure


def _panel(axis: Axes, names: Sequence[str], label: str, grid: _Grid) -> None:
    colors, norm = _scale(grid.dtype)
    axis.set_facecolor(_NONE)
    with np.errstate(divide="ignore"):
        shown = np.clip(np.log10(grid.error), norm.boundaries[0] + 0.01, norm.boundaries[-1] + 0.5)
    axis.imshow(np.ma.masked_invalid(shown), cmap=colors, norm=norm, aspect="auto", interpolation="none")
    for row, column in zip(*np.nonzero(~np.isnan(grid.error)), strict=True):
        dark = not norm.boundaries[0] * 0.78 < shown[row, column] < -1
        text = str(grid.fault[row, column]) or _digits(float(grid.error[row, column]))
        style = {"ha": "center", "va": "center", "fontsize": 5.5, "color": "white" if dark else "#333333"}
        axis.text(column, row, text, **style)
        if grid.failed[row, column]:
            frame = Rectangle((column - 0.5, row - 0.5), 1, 1, fill=False, edgecolor="#d000d0", linewidth=1.5)
            axis.add_patch(frame)
    for row in range(1, len(names)):
        if names[row].partition(".")[0] != names[row - 1].partition(".")[0]:
            axis.axhline(row - 0.5, color="white", linewidth=1.5)
    axis.set_xticks(range(len(CLASSES)), list(CLASSES), rotation=90, fontsize=7)
    axis.xaxis.tick_top()
    axis.tick_params(length=0)
    axis.spines[:].set_visible(False)
    axis.set_title(label, pad=8)


def _digits(error: float) -> str:
    """How many digits are right."""
    if error < 1e-17:
        return "="
    return "0" if error >= 1 else f"{-math.log10(error):.0f}"


def _scale(dtype: str) -> tuple[ListedColormap, BoundaryNorm]:
    """One colour per power of ten, from blue over sand to red; beyond 1, where no digit is left, dark red."""
    steps = _STEPS[dtype]
    colors = matplotlib.colormaps["RdYlBu_r"](np.linspace(0.02, 0.93, len(steps) - 1))
    return ListedColormap(list(colors)).with_extremes(over=_BAD), BoundaryNorm(steps, len(steps) - 1)
