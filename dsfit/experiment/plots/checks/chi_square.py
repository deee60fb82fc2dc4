"""Expected and observed counts per cell with their residual, for what failed and for the least likely that passed."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from dsfit.experiment.files import number
from dsfit.experiment.plots.style import new_figure
from dsfit.experiment.rundir import RunDirectory, slug

_MOST = 12  # figures


def figures(directory: RunDirectory, result: dict[str, Any]) -> Iterator[tuple[str, Figure]]:
    """One figure for each failed test, or for the least likely one where none failed; then all p-values."""
    cells = [cell for cell in result["cells"] if cell["suite"] == "chi_square"]
    tests = [(number(f["p_value"]), cell, f) for cell in cells for f in cell["findings"] if f["p_value"] is not None]
    if not tests:
        return
    level = next(row["level"] for row in result["report"]["suites"] if row["suite"] == "chi_square")
    tests.sort(key=lambda test: test[0])
    failed = [test for test in tests if test[0] <= number(level)]
    for p_value, cell, finding in (failed or tests[:1])[:_MOST]:
        arrays, name = directory.arrays(cell["index"]), finding["subject"]
        if f"{name}/observed" in arrays:
            yield f"chi_square-{cell['index']:04d}-{slug(name)}", _cells(arrays, name, cell["label"], p_value)
    yield "chi_square", _p_values([test[0] for test in tests], number(level))


def _cells(arrays: dict[str, np.ndarray], name: str, label: str, p_value: float) -> Figure:
    observed, expected = arrays[f"{name}/observed"], arrays[f"{name}/expected"]
    theta, phi = (np.degrees(arrays[f"{name}/{key}"]) for key in ("theta", "phi"))
    area = np.outer(np.diff(theta), np.diff(phi))
    residual = (observed - expected) / np.sqrt(np.maximum(expected, 5.0))
    figure = new_figure(9.5, 3.2)
    figure.suptitle(f"{name}, {label}: p = {p_value:.2g}")
    axes = figure.subplots(1, 3, sharey=True)
    top = max(float((expected / area).max()), float((observed / area).max()))
    norm = LogNorm(max(top * 1e-5, 1e-12), top)
    for axis, counts, title in zip(axes[:2], (expected, observed), ("expected", "observed"), strict=True):
        shown = np.ma.masked_less_equal(counts / area, 0)
        image = axis.pcolormesh(phi, theta, shown, norm=norm, cmap="viridis", rasterized=True)
        axis.set_title(f"{title} per deg²")
        figure.colorbar(image, ax=axis)
    span = max(5.0, float(np.abs(residual).max()))
    image = axes[2].pcolormesh(phi, theta, residual, cmap="RdBu_r", vmin=-span, vmax=span, rasterized=True)
    axes[2].set_title("(observed − expected) / √expected")
    figure.colorbar(image, ax=axes[2])
    for axis in axes:
        axis.set_xlabel("φ / °")
        axis.set_xlim(-180, 180)
        axis.set_xticks((-180, -90, 0, 90, 180))
    axes[0].set_ylabel("θᵢ / °")
    return figure


def _p_values(p_values: list[float], level: float) -> Figure:
    """The sorted p-values against those of a uniform law, with the band that 99 % of ordered uniforms stay in."""
    from scipy import stats

    count = len(p_values)
    rank = np.arange(1, count + 1)
    figure = new_figure(4.6, 3.4)
    axis = figure.subplots()
    low, high = (stats.beta.ppf(q, rank, count + 1 - rank) for q in (0.005, 0.995))
    axis.fill_between(rank / (count + 1), low, high, color="#dddddd", label="99 % of uniform p-values")
    axis.loglog(rank / (count + 1), np.maximum(p_values, 1e-16), ".", color="#0072B2", label=f"{count} tests")
    axis.axhline(level, color="#D55E00", linewidth=1, label=f"needed: p > {level:.1g}")
    axis.set_xlabel("expected")
    axis.set_ylabel("p-value")
    axis.set_ylim(bottom=min(1e-2 / math.sqrt(count), max(min(p_values) / 2, 1e-17), level / 3))
    axis.legend(loc="lower right", frameon=False)
    figure.suptitle("chi-square: samples against densities")
    return figure
