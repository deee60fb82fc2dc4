"""Marginals of the chains, of the quadrature and of a resampled proposal; p-values of all proposals beside them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from dsfit.experiment.files import number
from dsfit.experiment.plots.style import COLORS, MARKERS, new_figure, short, spread
from dsfit.experiment.rundir import RunDirectory

_CONTEXTS = 4
_KINDS = ("marginals", "means", "bridge")
_COLORS = (COLORS[1], COLORS[2], COLORS[5])
_FLOOR = 1e-12  # least p-value that is drawn apart


def figures(directory: RunDirectory, result: dict[str, Any]) -> Iterator[tuple[str, Figure]]:
    """One figure for each of at most four contexts."""
    cells = [cell for cell in result["cells"] if cell["suite"] == "independent"]
    levels = [row["level"] for row in result["report"]["suites"] if row["suite"] == "independent"]
    level = number(levels[0]) if levels else math.nan
    for index in spread(len(cells), _CONTEXTS):
        cell = cells[index]
        yield f"independent-{cell['index']:04d}", context_figure(cell, directory.arrays(cell["index"]), level)


def context_figure(cell: dict[str, Any], arrays: dict[str, np.ndarray], level: float) -> Figure:
    """Marginals of theta_i and phi, and the p-values of every proposal's comparisons."""
    findings = cell["findings"]
    chains = next(f for f in findings if f["subject"] == "chains")
    rows = [f["subject"].rpartition(": ")[0] for f in findings if f["subject"].endswith(": bridge")]
    figure = new_figure(11.5, max(3.6, 1.4 + 0.2 * len(rows)))
    theta_axis, phi_axis, p_axis = figure.subplots(1, 3, width_ratios=(1, 1, 1.1))
    shown = chains["data"]["shown"]
    for axis, name, label in ((theta_axis, "theta", "θᵢ / °"), (phi_axis, "phi", "φ / °")):
        _marginal(axis, arrays, name)
        reach = arrays[f"{name}_edges_deg"][-1]
        axis.set(xlabel=label, xlim=(-reach, reach), xticks=np.linspace(-reach, reach, 5), ylim=(0, None))
        axis.grid(True)
    theta_axis.set(ylabel="density / degree⁻¹", title="marginal of θᵢ")
    phi_axis.set_title("marginal of the relative azimuth φ")
    _p_values(p_axis, findings, rows, level)
    handles = [
        Line2D([], [], color=COLORS[0], label="chains"),
        Line2D([], [], color="black", linestyle="--", label="quadrature (midpoints)"),
        Line2D([], [], color=COLORS[3], marker="o", linestyle="", markersize=4, label=f"{shown}, weighted"),
        *(Line2D([], [], color=_COLORS[k], marker=MARKERS[k], linestyle="", label=x) for k, x in enumerate(_KINDS)),
        Line2D([], [], color="#555555", marker="o", markerfacecolor="white", linestyle="", label="unclear"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)
    verdict = f"unclear: {chains['unclear']}" if chains["unclear"] else chains["detail"]
    figure.suptitle(f"{cell['label']}\n{short(verdict, 160)}", fontsize=9)
    return figure


def _marginal(axis: Any, arrays: dict[str, np.ndarray], name: str) -> None:
    edges = arrays[f"{name}_edges_deg"]
    middle = 0.5 * (edges[1:] + edges[:-1])
    axis.stairs(arrays[f"{name}_chains"], edges, fill=True, color=COLORS[0], alpha=0.25)
    axis.stairs(arrays[f"{name}_chains"], edges, color=COLORS[0], linewidth=1.2)
    axis.plot(middle, arrays[f"{name}_quadrature"], color="black", linestyle="--", linewidth=1.0)
    if f"{name}_proposal" in arrays:
        axis.plot(middle, arrays[f"{name}_proposal"], "o", color=COLORS[3], markersize=3)


def _p_values(axis: Any, findings: list[dict[str, Any]], rows: list[str], level: float) -> None:
    by_subject = {f["subject"]: f for f in findings}
    for row, name in enumerate(rows):
        for k, kind in enumerate(_KINDS):
            found = by_subject.get(f"{name}: {kind}")
            if found is None or found["p_value"] is None:
                continue
            p = max(number(found["p_value"]), _FLOOR)
            fill = "white" if found["unclear"] else _COLORS[k]
            axis.plot(p, row + 0.2 * (k - 1), MARKERS[k], color=_COLORS[k], markerfacecolor=fill, markersize=4)
    if math.isfinite(level):
        axis.axvline(level, color="#555555", linestyle=":", linewidth=1.2)
    axis.set(xscale="log", xlabel="p-value", title="proposals against the chains", ylim=(len(rows) - 0.5, -0.5))
    axis.set_yticks(range(len(rows)), [short(name) for name in rows])
    low = min(1e-4, axis.get_xlim()[0], level / 3 if math.isfinite(level) else 1)
    axis.set_xlim(low, 2)
    axis.grid(True, axis="x")
