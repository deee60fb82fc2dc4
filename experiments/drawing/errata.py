"""Draws how clearly each wrong equation is rejected and what it does to the light; tabulates the errata."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from dsfit.experiment.plots.style import COLORS
from dsfit.figures import Data, Table
from dsfit.figures.page import Page

_RATIOS = (0.2, 0.5, 1.0, 2.0)


def figures(data: Data, page: Page) -> dict[str, Figure]:
    """A row for each control in the order of the equations, two panels."""
    labels = data.record["controls"]
    figure = page.figure(0.16 + 0.0245 * len(labels))
    clear, effect = figure.subplots(1, 2, sharey=True, width_ratios=[1.2, 1])
    rows = np.arange(len(labels))
    decades, needed, ratio = (data.arrays[name] for name in ("decades", "needed", "ratio"))
    clear.hlines(rows, 0, decades, color="#bbbbbb", linewidth=0.9)
    most = decades >= 16
    clear.plot(decades[~most], rows[~most], "o", color=COLORS[0], markersize=3.5, label="printed form")
    clear.plot(decades[most], rows[most], ">", color=COLORS[0], markersize=4, label="16 or more")
    clear.plot(needed, rows, "|", color=COLORS[1], markersize=7, markeredgewidth=1.4, label="needed")
    effect.hlines(rows, 1, ratio, color="#bbbbbb", linewidth=0.9)
    effect.plot(ratio, rows, "o", color=COLORS[0], markersize=3.5)
    effect.axvline(1, color="#555555", linewidth=0.9)
    clear.set_yticks(rows, labels, fontsize=6.5)
    clear.set(ylim=(len(labels) - 0.4, -0.6), xlim=(0, 17), xticks=range(0, 17, 4))
    clear.set_xlabel("decades of p or deviation", fontsize=8)
    clear.set_title("how clearly it is rejected")
    effect.set_xscale("log")
    effect.set_xlim(0.17, 2.4)
    effect.set_xticks(_RATIOS, [f"{value:g}" for value in _RATIOS])
    effect.xaxis.set_minor_locator(NullLocator())
    effect.set_xlabel("integral, printed over right", fontsize=8)
    effect.set_title("effect (where it is a bias)")
    for axis in (clear, effect):
        axis.grid(True, axis="x")
        axis.tick_params(axis="y", length=0)
    figure.legend(*clear.get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
    return {"errata": figure}


def captions(data: Data) -> dict[str, str]:
    """What the figure shows."""
    return {
        "errata": "Every wrong equation under a check that its correction passes. Left: how clearly the printed form "
        "is rejected, in decades of the p-value, or of the deviation over its bound; bars: what was needed. Right: the "
        "integral as printed over the right one, for slips that scale the light of the scene."
    }


def tables(data: Data) -> list[Table]:
    """All errata in the order of the equations, those without effect among them."""
    head = ["equation", "printed", "corrected", "measured effect", "caught by"]
    rows = [
        [
            row["equations"],
            row["printed"],
            row["corrected"],
            f"{row['kind']}: {row['effect']}" if row["effect"] else row["kind"],
            f"{row['check']} ({row['control']})" if row["control"] else "",
        ]
        for row in data.record["errata"]
    ]
    caption = (
        f"Errata of the chapter. Measured in: {data.record['scene']}, if not said otherwise. ×: integral as printed "
        "over the right one."
    )
    return [Table("errata", caption, head, rows, "lllll")]
