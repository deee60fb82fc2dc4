"""Excess by method and context, and over the grid of a sweep."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from dsfit.experiment.files import number
from dsfit.experiment.plots.style import COLORS, MARKERS, look, new_figure, short

MOST_GROUPS = 8
MOST_BARS = 8
HIGHEST = 1e9
FLOOR = 1e-6


def _table(result: dict[str, Any]) -> tuple[list[str], np.ndarray]:
    names = [m["name"] for m in result["cells"][0]["methods"]]
    values = np.array([[number(m["excess"]) for m in cell["methods"]] for cell in result["cells"]])
    return names, np.maximum(values, FLOOR)


def _ends(values: np.ndarray) -> tuple[float, float]:
    """Ends of a logarithmic axis for the values; infinite and huge ones end at its top."""
    finite = values[np.isfinite(values)]
    low, high = np.log10(finite.min()), np.log10(min(finite.max(), HIGHEST))
    return 10 ** np.floor(low - 0.3), 10 ** np.ceil(high + 0.3)


def excess_bars(result: dict[str, Any]) -> Figure:
    """Excess of every method: one group of bars per context, or, for more than eight contexts, one dot per context
    and the median."""
    names, values = _table(result)
    cells = result["cells"]
    if len(cells) > MOST_GROUPS or len(names) > MOST_BARS:
        return _dots(result, names, values)
    figure = new_figure(
        1.6 + max(4.5, 0.17 * len(names) * len(cells) + 0.5 * len(cells)), 3.4 + 0.2 * (len(names) // 3)
    )
    axis = figure.subplots()
    bottom, top = _ends(values)
    width = 0.85 / len(names)
    for index, name in enumerate(names):
        x = np.arange(len(cells)) + (index - (len(names) - 1) / 2) * width
        hatch = "///" if index >= len(COLORS) else None
        axis.bar(
            x,
            np.minimum(values[:, index], top) - bottom,
            width,
            bottom=bottom,
            color=look(index)["color"],
            label=name,
            hatch=hatch,
            edgecolor="white",
            linewidth=0.3,
        )
    for text, where, at in (("< 0", values <= FLOOR, FLOOR), ("∞", values > top, top)):
        for k, index in np.argwhere(where):
            x = k + (index - (len(names) - 1) / 2) * width
            axis.text(x, at, text, fontsize=7, ha="center", va="bottom")
    axis.set(yscale="log", ylabel="excess  M(p) / M* − 1", ylim=(bottom, top * 3))
    axis.set_xticks(np.arange(len(cells)), [cell["label"].replace(", ", "\n") for cell in cells])
    axis.grid(True, axis="y")
    figure.legend(loc="outside lower center", ncols=min(4, len(names)), frameon=False)
    figure.suptitle("Distance from the best possible density (quadrature; 0 is the limit)", fontsize=10)
    return figure


def _dots(result: dict[str, Any], names: list[str], values: np.ndarray) -> Figure:
    figure = new_figure(7.2, 1.4 + 0.34 * len(names))
    axis = figure.subplots()
    top = _ends(values)[1]
    note = "\nright end: more, or infinite" if (values > top).any() else ""
    note += "\nleft end: less, or negative" if (values <= FLOOR).any() else ""
    values = np.minimum(values, top)
    shift = np.linspace(-0.28, 0.28, len(values))
    for index in range(len(names)):
        style = look(index)
        axis.scatter(values[:, index], index + shift, s=14, linewidths=0, zorder=3, alpha=0.8, **style)
        axis.plot([np.median(values[:, index])] * 2, [index - 0.4, index + 0.4], color="black", linewidth=1.4)
    axis.set(xscale="log", xlabel=f"excess  M(p) / M* − 1  (line: median){note}", ylim=(len(names) - 0.5, -0.5))
    axis.set_yticks(range(len(names)), [short(name, 34) for name in names])
    axis.grid(True, axis="x")
    figure.suptitle(f"Distance from the best possible density, {len(values)} contexts", fontsize=10)
    return figure


def excess_grid(result: dict[str, Any]) -> Figure | None:
    """Excess over the first two axes of a sweep (or against the only one): lines against the last axis, one panel per
    method.

    Contexts that share a grid point are summarised by their median. None without a numeric axis.
    """
    keys, points = _axes(result)
    if not keys:
        return None
    names, values = _table(result)
    x_key, hue_key = keys[-1], keys[0] if len(keys) > 1 else None
    hues = sorted({p[hue_key] for p in points}) if hue_key else [None]
    columns = min(3, len(names))
    rows = -(-len(names) // columns)
    figure = new_figure(1.4 + 2.7 * columns, 1.4 + 2.2 * rows)
    axes = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    shades = [COLORS[i % len(COLORS)] for i in range(len(hues))]
    for index, (axis, name) in enumerate(zip(axes.flat, names, strict=False)):
        for shade, hue, marker in zip(shades, hues, MARKERS * len(hues), strict=False):
            chosen = [i for i, p in enumerate(points) if hue is None or p[hue_key] == hue]
            xs = sorted({points[i][x_key] for i in chosen})
            ys = [np.median([values[i, index] for i in chosen if points[i][x_key] == x]) for x in xs]
            label = None if hue is None else f"{hue:g}"
            axis.plot(
                xs, ys, color=shade, marker=marker, markersize=3.5, linewidth=1.1, label=label if index == 0 else None
            )
        axis.set(yscale="log", title=short(name))
        axis.grid(True)
    for axis in list(axes.flat)[len(names) :]:
        axis.set_visible(False)
    for axis in axes[-1]:
        axis.set_xlabel(x_key)
    for row in axes:
        row[0].set_ylabel("excess")
    if hue_key:
        figure.legend(loc="outside lower center", ncols=min(8, len(hues)), frameon=False, title=hue_key)
    figure.suptitle(short(result["title"] or result["name"], 90), fontsize=10)
    return figure


def _axes(result: dict[str, Any]) -> tuple[list[str], list[dict[str, float]]]:
    """Numeric keys that vary over the cells (grid keys first, then context), and every cell's values."""
    points = [{**cell["identity"]["grid"], **cell["identity"]["context"]} for cell in result["cells"]]
    keys = [
        key
        for key in points[0]
        if key not in ("v", "phi_r_deg")
        and all(isinstance(p[key], int | float) for p in points)
        and len({p[key] for p in points}) > 1
    ]
    return keys[:2], points
