"""Draws the stability atlas as maps, functions by classes of regimes, and tabulates the worst of them."""

from __future__ import annotations

import math

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle

from dsfit.figures import Data, Table
from dsfit.figures.page import Page

_DTYPES, _QUANTITIES = ("float64", "float32"), ("value", "gradient")
_STEPS = {"float64": np.arange(-16, 1), "float32": np.arange(-8, 1)}  # powers of ten between which colours change
_BAD, _NONE, _BEYOND = "#7f0000", "#f2f2f2", "#d000d0"
_MARKS = ("", "0", "−", "∞", "×")
_ROW = 0.0143  # height of a row in widths of the page: 85 rows are no higher than a page


def figures(data: Data, page: Page) -> dict[str, Figure]:
    """Families of functions, all four panels; every function, float64 and float32; and the naive formulas beside."""
    names = data.record["functions"]
    families, kinds = _families(data)
    panels = [(d, f"{d}, {q}", kinds[f"{d}.{q}"]) for d in _DTYPES for q in _QUANTITIES]
    drawn = {"families": _sheet(page, data, families, panels, 2)}
    for dtype in _DTYPES:
        panels = [(dtype, quantity, _Grid.of(data, dtype, quantity)) for quantity in _QUANTITIES]
        drawn[f"atlas_{dtype}"] = _sheet(page, data, names, panels)
        compared = [k for k in range(len(names)) if not np.isnan(data.arrays[f"naive.{dtype}.value"][k]).all()]
        if compared:
            panels = [
                (dtype, title, _Grid.of(data, dtype, "value", prefix).only(compared))
                for title, prefix in (("dsfit", ""), ("formula as first written", "naive"))
            ]
            drawn[f"naive_{dtype}"] = _sheet(page, data, [names[k] for k in compared], panels)
    return drawn


def captions(data: Data) -> dict[str, str]:
    """What the figures show."""
    worst = "Worst relative error against 50-digit arithmetic, by class of regimes"
    return {
        "families": f"{worst}: all functions of a family together (how many).",
        **{f"atlas_{dtype}": f"{worst}: every function in {dtype}, value and gradient." for dtype in _DTYPES},
        **{
            f"naive_{dtype}": f"{worst}: values in {dtype}, and those of the formula as one would write it down first."
            for dtype in _DTYPES
            if not np.isnan(data.arrays[f"naive.{dtype}.value"]).all()
        },
    }


class _Grid:
    """Worst error, fault and verdict of each row and class of regimes."""

    def __init__(self, error: np.ndarray, fault: np.ndarray, beyond: np.ndarray) -> None:
        self.error, self.fault, self.beyond = error, fault, beyond

    @classmethod
    def of(cls, data: Data, dtype: str, quantity: str, prefix: str = "") -> _Grid:
        """The library's errors, or those of the naive formulas."""
        error, fault = ("naive", "naive_fault") if prefix else ("error", "fault")
        found, faults, beyond = (data.arrays[f"{key}.{dtype}.{quantity}"] for key in (error, fault, "beyond"))
        return cls(found, faults, np.zeros_like(beyond) if prefix else beyond)

    def only(self, rows: list[int]) -> _Grid:
        """Some of the rows."""
        return _Grid(self.error[rows], self.fault[rows], self.beyond[rows])


def _families(data: Data) -> tuple[list[str], dict[str, _Grid]]:
    """Worst of each family, the part of a function's name before its dot."""
    owner = [name.partition(".")[0] for name in data.record["functions"]]
    names = list(dict.fromkeys(owner))
    members = [[k for k, own in enumerate(owner) if own == name] for name in names]
    grids = {}
    for dtype in _DTYPES:
        for quantity in _QUANTITIES:
            grid = _Grid.of(data, dtype, quantity)
            error = np.stack([np.fmax.reduce(grid.error[rows], axis=0) for rows in members])
            fault = np.stack([grid.fault[rows].max(axis=0) for rows in members])
            grids[f"{dtype}.{quantity}"] = _Grid(error, fault, np.stack([grid.beyond[r].any(axis=0) for r in members]))
    counts = [f"{name} ({len(rows)})" for name, rows in zip(names, members, strict=True)]
    return counts, grids


def _sheet(page: Page, data: Data, names: list[str], panels: list[tuple[str, str, _Grid]], lines: int = 1) -> Figure:
    """Panels in lines of two, with one list of rows."""
    per_line = 0.13 + max(_ROW, 0.02 if lines > 1 else 0) * len(names)
    figure = page.figure(0.19 + lines * per_line)
    figure.get_layout_engine().set(rect=(0.03, 0, 0.97, 1))  # the layout counts names at the left short by as much
    classes = [name for name, _ in data.record["classes"]]
    axes = figure.subplots(lines, 2, sharey=True, squeeze=False)
    for axis, (dtype, title, grid) in zip(axes.flat, panels, strict=True):
        _panel(axis, names, dtype, title, grid, classes)
    for row in axes:
        row[0].set_yticks(range(len(names)), names, fontsize=6)
    for line, row in enumerate(axes):
        dtypes = {dtype for dtype, _, _ in panels[2 * line : 2 * line + 2]}
        for dtype in [d for d in _DTYPES if d in dtypes]:
            _bar(figure, list(row), dtype)
    marks = [
        Patch(facecolor=_BAD, label="no digit: × NaN, ∞ infinite, 0 wrong zero, − negative"),
        Patch(facecolor=_NONE, edgecolor="#bbbbbb", linewidth=0.5, label="not measured"),
        Patch(facecolor="white", edgecolor=_BEYOND, linewidth=1.2, label="beyond the stated limit"),
    ]
    figure.legend(handles=marks, loc="outside lower center", ncols=3, frameon=False, fontsize=6.5)
    return figure


def _bar(figure: Figure, axes: list[Axes], dtype: str) -> None:
    colors, norm = _scale(dtype)
    bar = figure.colorbar(
        matplotlib.cm.ScalarMappable(norm, colors), ax=axes, location="bottom", aspect=50, shrink=0.8, pad=0.015
    )
    bar.set_ticks(_STEPS[dtype][::2], labels=[f"1e{k}" for k in _STEPS[dtype][::2]])
    bar.ax.tick_params(labelsize=6.5)
    bar.set_label(f"worst relative error, {dtype}; in the cells: digits that are right", fontsize=7)


def _panel(axis: Axes, names: list[str], dtype: str, title: str, grid: _Grid, classes: list[str]) -> None:
    colors, norm = _scale(dtype)
    axis.set_facecolor(_NONE)
    with np.errstate(divide="ignore", invalid="ignore"):
        shown = np.clip(np.log10(grid.error), norm.boundaries[0] + 0.01, norm.boundaries[-1] + 0.5)
    axis.imshow(np.ma.masked_invalid(shown), cmap=colors, norm=norm, aspect="auto", interpolation="none")
    for row, column in zip(*np.nonzero(~np.isnan(grid.error)), strict=True):
        text = _MARKS[grid.fault[row, column]] or _digits(float(grid.error[row, column]), dtype)
        dark = not norm.boundaries[0] * 0.78 < shown[row, column] < -1
        axis.text(
            column, row, text, ha="center", va="center_baseline", fontsize=5, color="white" if dark else "#333333"
        )
        if grid.beyond[row, column]:
            frame = Rectangle((column - 0.5, row - 0.5), 1, 1, fill=False, edgecolor=_BEYOND, linewidth=1.2)
            axis.add_patch(frame)
    for row in range(1, len(names)):
        if names[row].partition(".")[0] != names[row - 1].partition(".")[0]:
            axis.axhline(row - 0.5, color="white", linewidth=1.2)
    axis.set_xticks(range(len(classes)), classes, rotation=90, fontsize=6)
    axis.xaxis.tick_top()
    axis.tick_params(length=0, pad=2)
    axis.spines[:].set_visible(False)
    axis.set_title(title, pad=4, fontsize=8)


def _digits(error: float, dtype: str) -> str:
    """How many digits are right."""
    if error <= 10.0 ** _STEPS[dtype][0]:
        return str(-_STEPS[dtype][0])
    return "0" if error >= 1 else f"{math.floor(-math.log10(error)):.0f}"


def _scale(dtype: str) -> tuple[ListedColormap, BoundaryNorm]:
    """One colour per power of ten, from blue over sand to red; beyond 1, where no digit is left, dark red."""
    steps = _STEPS[dtype]
    colors = matplotlib.colormaps["RdYlBu_r"](np.linspace(0.02, 0.93, len(steps) - 1))
    return ListedColormap(list(colors)).with_extremes(over=_BAD), BoundaryNorm(steps, len(steps) - 1)


def tables(data: Data) -> list[Table]:
    """The worst of each class of regimes and whose it is; and every function."""
    names, arrays = data.record["functions"], data.arrays
    columns = [f"{dtype}.{quantity}" for dtype in _DTYPES for quantity in _QUANTITIES]
    head = ["float64", "its gradient", "float32", "its gradient"]
    by_class = []
    for k, (name, what) in enumerate(data.record["classes"]):
        by_class.append([f"{name}: {what}", *(_worst(arrays[f"error.{column}"][:, k], names) for column in columns)])
    by_function = []
    for k, name in enumerate(names):
        cells = [_number(_most(arrays[f"error.{column}"][k])) for column in columns]
        cells += [_number(_most(arrays[f"naive.{dtype}.value"][k])) for dtype in _DTYPES]
        by_function.append([name, *cells, data.record["worst_regime"][k]])
    worst = "Worst relative error of all functions in each class of regimes, and whose it is."
    every = (
        "Worst relative error of every function over all regimes; naive: the value by the formula as first written "
        "down, where that is another one; last: the regime in which the float64 value is worst."
    )
    return [
        Table("regimes", worst, ["regime", *head], by_class, "lllll"),
        Table(
            "functions",
            every,
            ["function", *head, "naive, float64", "naive, float32", "worst"],
            by_function,
            "lrrrrrrl",
        ),
    ]


def _most(errors: np.ndarray) -> float:
    return float(np.fmax.reduce(errors))


def _worst(errors: np.ndarray, names: list[str]) -> str:
    most = _most(errors)
    return "" if math.isnan(most) else f"{_number(most)} {names[int(np.nanargmax(errors))]}"


def _number(value: float) -> str:
    return "" if math.isnan(value) else f"{value:.1e}" if value else "0"
