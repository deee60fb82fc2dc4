"""The white furnace over inclinations, and ring by ring what was sampled over what was expected."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dsfit.experiment.plots.style import COLORS, MARKERS, new_figure, short
from dsfit.experiment.rundir import RunDirectory

_MOST = 4  # scenes
_RIGHT = ("uniform", "TT", "mixture", "structured")
_WRONG = ("lobe_as_printed", "azimuth_clamped", "transmittance_as_printed", "flipped_theta")
_BLURRED = 0.4  # rings of a larger relative standard error are not drawn
_TOP = 3.0  # ratios beyond this are shown as triangles at the top


def figures(directory: RunDirectory, result: dict[str, Any]) -> Iterator[tuple[str, Figure]]:
    """Two figures for each of the first scenes."""
    cells = [cell for cell in result["cells"] if cell["suite"] == "furnace"][:_MOST]
    for cell in cells:
        arrays = directory.arrays(cell["index"])
        if "proposal_names" in arrays:
            yield f"furnace-{cell['index']:04d}", white_furnace(arrays, cell["label"])
            yield f"rings-{cell['index']:04d}", rings(arrays, cell["label"])


def white_furnace(arrays: dict[str, np.ndarray], label: str) -> Figure:
    """Quadrature and estimates per channel above; all proposals' estimates over quadrature below."""
    numbers = np.unique(arrays["n"])
    figure = new_figure(1.2 + 4.2 * len(numbers), 5.6)
    axes = figure.subplots(2, len(numbers), squeeze=False, height_ratios=(3, 2), sharey="row")
    for (top, bottom), n in zip(axes.T, numbers, strict=True):
        cases = np.flatnonzero(arrays["n"] == n)
        cases = cases[np.argsort(arrays["theta_r_deg"][cases])]
        _values(top, arrays, cases)
        _ratios(bottom, arrays, cases)
        top.set_title(f"n = {n:g}")
        bottom.set_xlabel("θᵣ / °")
    axes[0, 0].set_ylabel("∫ F cos θᵢ dωᵢ")
    axes[1, 0].set_ylabel("estimate / quadrature")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
    figure.suptitle(f"White furnace: {label}", fontsize=10)
    return figure


def _values(axis: Axes, arrays: dict[str, np.ndarray], cases: np.ndarray) -> None:
    """Inclinations side by side, whatever their distance: 89.9 degrees is not 75, and would hide behind it."""
    x, value = np.arange(len(cases)), arrays["value"][cases]
    names = list(arrays["proposal_names"])
    for c in range(value.shape[1]):
        color = COLORS[c % len(COLORS)]
        axis.plot(x, value[:, c], "_", color=color, markersize=22, label=f"quadrature, channel {c + 1}")
        for k, name in enumerate(name for name in ("uniform", "structured") if name in names):
            at = cases, names.index(name), c
            axis.errorbar(
                x + 0.16 * (2 * k - 1), arrays["proposal_estimate"][at], 2 * arrays["proposal_standard_error"][at],
                fmt=MARKERS[k], color=color, markersize=3.5, capsize=2, linewidth=1,
                label=f"{name}, ± 2 standard errors" if c == 0 else None,
            )  # fmt: skip
    _inclinations(axis, arrays, cases)
    axis.set_ylim(bottom=0)


def _inclinations(axis: Axes, arrays: dict[str, np.ndarray], cases: np.ndarray) -> None:
    axis.set_xticks(range(len(cases)), [f"{theta:g}" for theta in arrays["theta_r_deg"][cases]])
    axis.set_xlim(-0.6, len(cases) - 0.4)
    axis.grid(True, axis="y")


def _ratios(axis: Axes, arrays: dict[str, np.ndarray], cases: np.ndarray) -> None:
    """One point per proposal, side by side at each inclination."""
    count = len(arrays["proposal_names"])
    for j in range(count):
        value = arrays["value"][cases, 0]
        ratio = arrays["proposal_estimate"][cases, j, 0] / value
        error = arrays["proposal_standard_error"][cases, j, 0] / value
        x = np.arange(len(cases)) + 0.8 * ((j + 0.5) / count - 0.5)
        axis.errorbar(x, ratio, 2 * error, fmt=".", color="#555555", markersize=3, linewidth=0.8)
    axis.axhline(1.0, color="black", linewidth=0.8)
    _inclinations(axis, arrays, cases)


def rings(arrays: dict[str, np.ndarray], label: str) -> Figure:
    """Sampled over expected in every ring: right samplers above, wrong ones below."""
    right = _chosen(arrays, "proposal", _RIGHT)
    wrong = _chosen(arrays, "control", _WRONG)
    at = _cases(arrays)
    columns = max(len(right), len(wrong), 1)
    figure = new_figure(0.8 + 2.5 * columns, 5.2)
    axes = figure.subplots(2, columns, squeeze=False, sharex=True, sharey="row")
    for row, prefix, names in ((axes[0], "proposal", right), (axes[1], "control", wrong)):
        color = COLORS[0] if prefix == "proposal" else COLORS[1]
        for axis, name in zip(row, names, strict=False):
            _ratio_of_rings(axis, arrays, prefix, name, at[prefix], color)
        for axis in row[len(names) :]:
            axis.set_visible(False)
        row[0].set_ylim(0, _TOP)
    for axis in axes[1]:
        axis.set_xlabel("θᵢ / °")
    axes[0, 0].set_ylabel("right: sampled / expected")
    axes[1, 0].set_ylabel("wrong: sampled / expected")
    where = arrays["labels"][at["proposal"]]
    if wrong and arrays["control_labels"][at["control"]] != where:
        where = f"{where} (wrong: {arrays['control_labels'][at['control']]})"
    figure.suptitle(f"Ring light: {label}, {where}", fontsize=10)
    return figure


def _chosen(arrays: dict[str, np.ndarray], prefix: str, wanted: tuple[str, ...]) -> list[str]:
    """The wanted names that there are, else the first ones."""
    names = [str(name) for name in arrays.get(f"{prefix}_names", ())]
    return [name for name in wanted if name in names] or names[:4]


def _cases(arrays: dict[str, np.ndarray]) -> dict[str, int]:
    """Which case is drawn: one that both proposals and controls were run in, if there is one."""
    labels, controls = list(arrays["labels"]), list(arrays.get("control_labels", ()))
    common = [label for label in controls if label in labels]
    if not common:
        return {"proposal": 0, "control": 0}
    return {"proposal": labels.index(common[0]), "control": controls.index(common[0])}


def _ratio_of_rings(axis: Axes, arrays: dict[str, np.ndarray], prefix: str, name: str, case: int, color: str) -> None:
    at = case, list(arrays[f"{prefix}_names"]).index(name)
    expected, sampled, error = (arrays[f"{prefix}_ring_{key}"][at] for key in ("expected", "sampled", "standard_error"))
    edges = arrays["ring_edges_deg"]
    safe = np.maximum(expected, 1e-300)
    sharp = (expected > 0) & (error < _BLURRED * safe)
    centre = (edges[1:] + edges[:-1]) / 2
    ratio = sampled / safe
    shown = sharp & (ratio <= _TOP)
    axis.errorbar(
        centre[shown], ratio[shown], 2 * (error / safe)[shown], fmt="o", color=color, markersize=3, linewidth=1
    )
    beyond = sharp & (ratio > _TOP)
    axis.plot(centre[beyond], np.full(beyond.sum(), 0.97 * _TOP), "^", color=color, markersize=4)
    axis.axhline(1.0, color="black", linewidth=0.8)
    axis.set_title(short(name, 26))
    axis.set_xlim(-90, 90)
    axis.set_xticks((-90, -45, 0, 45, 90))
    axis.grid(True)
