"""Solvers against problems: how much of the way to the best value each of them went, and which claims were false."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from dsfit.experiment.files import number
from dsfit.experiment.plots.style import new_figure
from dsfit.experiment.rundir import RunDirectory

_DECADES = 6.0


def figures(directory: RunDirectory, result: dict[str, Any]) -> Iterator[tuple[str, Figure]]:
    """One figure: a row per problem and objective, a column per solver, coloured by what is left of the way from the
    start to the best known value."""
    findings = [f for cell in result["cells"] if cell["suite"] == "stiff_fits" for f in cell["findings"]]
    findings = [f for f in findings if "solver" in f["data"] and not f["data"]["refused"]]
    if not findings:
        return
    rows = list(dict.fromkeys(f["case"] for f in findings))
    columns = list(dict.fromkeys(f["subject"] for f in findings))
    left = np.full((len(rows), len(columns)), math.nan)
    figure = new_figure(2.5 + 0.75 * len(columns), 1.6 + 0.2 * len(rows))
    axes = figure.subplots()
    for finding in findings:
        k, j = rows.index(finding["case"]), columns.index(finding["subject"])
        left[k, j] = _left(finding["data"])
        mark = "✗" if number(finding["value"]) > 0 else "" if finding["data"]["converged"] else "•"
        color = "#d62728" if mark == "✗" else "white" if left[k, j] > -0.4 * _DECADES else "black"
        axes.text(j, k, mark, ha="center", va="center", fontsize=8, color=color)
    image = axes.imshow(left, aspect="auto", cmap="viridis_r", vmin=-_DECADES, vmax=0)
    figure.colorbar(image, label="decades of the way from the start to the best value that are left")
    axes.set_xticks(range(len(columns)), [name.partition(".")[2] for name in columns], rotation=45, ha="right")
    axes.set_yticks(range(len(rows)), rows, fontsize=7)
    axes.grid(False)
    axes.set_title("dot: did not claim convergence;  cross: something said is false;  white: not tried", fontsize=8)
    yield "stiff_fits", figure


def _left(data: dict[str, Any]) -> float:
    start, best, optimum = (number(data[key]) for key in ("start", "objective", "optimum"))
    if not math.isfinite(start):
        return 0.0 if not math.isfinite(best) else -_DECADES
    share = (best - optimum) / (start - optimum) if start > optimum else 0.0
    return max(math.log10(share), -_DECADES) if share > 0 else -_DECADES
