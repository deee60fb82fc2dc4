"""Excess of amortised proposals at contexts that they were not trained on."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from dsfit.experiment.plots.style import COLORS, new_figure
from dsfit.experiment.rundir import RunDirectory

MEDIAN_BAR, TAIL_BAR = 0.005, 0.05
LOW, HIGH = 1e-4, 1e-1
MAPPED = 4


def amortise(directory: RunDirectory, result: dict[str, Any]) -> Figure:
    """A heat map over theta_r and n for each rule of v and fibre (four at most), and the sorted excess of all."""
    cells = result["cells"]
    arrays = [directory.arrays(cell["index"]) for cell in cells]
    shown = min(len(cells), MAPPED)
    figure = new_figure(3.4 + 2.3 * shown, 5.4)
    grid = figure.add_gridspec(2, shown + 1, width_ratios=[*[1.0] * shown, 1.5])
    image = None
    for k in range(shown):
        for row, (rule, share) in enumerate((("v = 0", np.zeros_like), ("v = exp(-n)", lambda n: np.exp(-n)))):
            axes = figure.add_subplot(grid[row, k])
            image = _map(axes, arrays[k], share)
            axes.set_title(f"{cells[k]['label']}, {rule}")
            axes.set_xlabel("θr / °" if row else "")
            axes.set_ylabel("" if k else "fibres passed, n")
    curve = figure.add_subplot(grid[:, -1])
    _sorted(curve, cells, arrays)
    bar = figure.colorbar(
        image,
        ax=figure.axes[: 2 * shown],
        location="bottom",
        shrink=0.9 if shown == 1 else 0.5,
        aspect=40,
        extend="both",
    )
    bar.set_label("excess")
    figure.suptitle(result["title"] or result["name"], fontsize=10)
    return figure


def _map(axes: Any, arrays: dict[str, np.ndarray], share: Any) -> Any:
    """Cells of one rule of v; the first row, n = 0, is direct light."""
    theta, n, v, excess = (arrays[name] for name in ("theta_r_deg", "n", "v", "excess"))
    angles, depths = np.unique(theta), np.unique(n)
    values = np.full((len(depths), len(angles)), np.nan)
    for t, x, s, e in zip(theta, n, v, excess, strict=True):
        if x == 0 or np.isclose(s, share(np.float64(x)), rtol=1e-9, atol=0):
            values[np.searchsorted(depths, x), np.searchsorted(angles, t)] = e
    image = axes.pcolormesh(values, norm=LogNorm(LOW, HIGH), cmap="viridis")
    every = range(0, len(angles), 4)
    axes.set_xticks([i + 0.5 for i in every], [f"{angles[i]:.0f}" for i in every])
    axes.set_yticks(np.arange(len(depths))[::2] + 0.5, [f"{x:g}" for x in depths[::2]])
    return image


def _sorted(axes: Any, cells: list[dict[str, Any]], arrays: list[dict[str, np.ndarray]]) -> None:
    """Excess that a share of the contexts stays below, trained and as it starts."""
    for k, (cell, found) in enumerate(zip(cells, arrays, strict=True)):
        share = (np.arange(len(found["excess"])) + 0.5) / len(found["excess"])
        color = COLORS[k % len(COLORS)]
        axes.plot(np.sort(found["start_excess"]), share, color=color, linestyle=":", linewidth=1.2)
        axes.plot(np.sort(found["excess"]), share, color=color, linewidth=1.5, label=cell["label"])
    for bar, share, name in ((MEDIAN_BAR, 0.5, "median"), (TAIL_BAR, 0.99, "99 %")):
        axes.plot([bar], [share], marker="*", markersize=11, color="#555555", linestyle="none")
        axes.annotate(f" bar: {name}", (bar, share), color="#555555", fontsize=8, va="top", ha="left")
    axes.set(xscale="log", xlabel="excess", ylabel="share of the unseen contexts below", ylim=(0, 1.02))
    axes.plot([], [], color="#555555", linestyle=":", label="untrained")
    axes.grid(True)
    axes.legend(frameon=False, loc="lower right")
