"""Draws solvers against problems; tabulates the solvers."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from dsfit.figures import Data, Table
from dsfit.figures.page import Page

_DECADES = 6.0


def figures(data: Data, page: Page) -> dict[str, Figure]:
    """A row per problem and objective, a column per solver, coloured by what is left of the way to the best value."""
    left, converged, faults = (data.arrays[key] for key in ("left", "converged", "faults"))
    problems, solvers = data.record["problems"], data.record["solvers"]
    figure = page.figure(max(0.3 + 0.026 * len(problems), 0.5))
    axes = figure.subplots()
    image = axes.imshow(left, aspect="auto", cmap="viridis_r", vmin=-_DECADES, vmax=0, interpolation="none")
    for row, column in zip(*np.nonzero(~np.isnan(left)), strict=True):
        white = left[row, column] > -0.4 * _DECADES
        if faults[row, column]:
            axes.plot(column, row, "x", color="#d62728", markersize=5, markeredgewidth=1.5)
        elif not converged[row, column]:
            axes.plot(column, row, "o", color="white" if white else "black", markersize=2.6)
    bar = figure.colorbar(image, location="right", aspect=35, pad=0.02)
    bar.set_label("what is left of the way from start to best value")
    ticks = [-6, -4, -2, 0]
    bar.set_ticks(ticks, labels=["≤ 1e-6", "1e-4", "1 %", "all"])
    names = [name.replace("optimistix.", "").replace("torch.", "torch ").replace("_", " ") for name in solvers]
    axes.set_xticks(range(len(solvers)), names, rotation=35, ha="right", rotation_mode="anchor")
    axes.set_yticks(range(len(problems)), problems, fontsize=6.5)
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    dot = Line2D([], [], linestyle="none", marker="o", markersize=2.6, color="black", label="convergence not claimed")
    cross = Line2D([], [], linestyle="none", marker="x", markersize=5, color="#d62728", label="a false claim")
    gap = Line2D([], [], linestyle="none", marker="s", markersize=6, color="white", markeredgecolor="#bbbbbb")
    gap.set_label("not tried")
    figure.legend(handles=[dot, cross, gap], loc="outside lower center", ncols=3, frameon=False)
    return {"stiff_fits": figure}


def captions(data: Data) -> dict[str, str]:
    """What the figure shows."""
    return {
        "stiff_fits": "Fits that start badly or have no single answer: what each solver leaves of the way from the "
        "start to the best value that is known (an optimum, or the best that any of them found)."
    }


def tables(data: Data) -> list[Table]:
    """One row per solver, best first."""
    head = ["solver", "problems", "solved / %", "converged / %", "false claims / %", "evaluations", "seconds"]
    rows = [
        [
            solver,
            str(row["problems"]),
            *(f"{100 * row[key]:.0f}" for key in ("solved", "converged", "faulty")),
            f"{row['evaluations']:.0f}",
            f"{row['seconds']:.2f}",
        ]
        for solver, row in sorted(
            data.record["rows"].items(), key=lambda item: (-item[1]["solved"], item[1]["seconds"])
        )
    ]
    caption = (
        "Solvers on badly posed fits. Solved: at the best known value; converged: claimed; evaluations and seconds: "
        "medians of those that were solved, one core. A solver is tried where it applies."
    )
    return [Table("solvers", caption, head, rows)]
