"""Draws every law in both forms, the library's mixtures with their components, and maps of all proposals."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from dsfit.experiment.plots.style import COLORS
from dsfit.figures import Data, Table
from dsfit.figures.page import Page
from experiments.drawing import _proposals_captions
from experiments.drawing._proposals_maps import all_maps
from experiments.drawing._proposals_tables import forms_table, maps_table, own_table

PRINTED, CORRECTED, WANTED = COLORS[1], COLORS[0], "black"
ENDS = {"theta": (-90, 90, 45), "phi": (-180, 180, 180), "forward": (0, 360, 180)}
LABELS = {"theta": "θᵢ / °", "phi": "φ / °", "forward": "φ / °"}
OWN = {
    "structured": "structured, not fitted",
    "fitted": "structured, fitted",
    "amortised": "amortised, not trained",
}
HEADS = ("printed, per radian", "corrected, per radian", "distribution function", "inverse, degrees")
_SMALL = 7


def figures(data: Data, page: Page) -> dict[str, Figure]:
    """A page for each group of laws, one for the library's own mixtures, one of maps."""
    pages = list(dict.fromkeys(law["page"] for law in data.record["laws"]))
    found = {name: _laws(data, page, [law for law in data.record["laws"] if law["page"] == name]) for name in pages}
    return found | {"own": _own(data, page), "maps": all_maps(data, page)}


def captions(data: Data) -> dict[str, str]:
    """What the figures show."""
    return _proposals_captions.captions(data)


def tables(data: Data) -> list[Table]:
    """Masses and p-values of both forms, of the library's mixtures, and of the maps."""
    return [forms_table(data), own_table(data), maps_table(data)]


def _laws(data: Data, page: Page, laws: list[dict]) -> Figure:
    figure, rows = _rows(page, len(laws), 0.28)
    points = {law["name"]: point[0] for law, point in zip(data.record["laws"], data.arrays["points"], strict=True)}
    for k, (axes, law) in enumerate(zip(rows, laws, strict=True)):
        _entitle(axes, f"{law['title']}, eq. {law['equations']}: {law['slip']}", None if k else HEADS)
        _law(data, law, points[law["name"]], axes)
    handles = [
        Line2D([], [], color=PRINTED, label="printed"),
        Line2D([], [], color=CORRECTED, label="corrected"),
        Patch(color="#bbbbbb", label="histogram of samples, ± 2 standard errors"),
    ]
    if any(f"{law['name']}.target" in data.arrays for law in laws):
        handles.append(Line2D([], [], color=WANTED, linestyle="--", label="what the law is for"))
    size = _SMALL if len(handles) > 3 else None
    figure.legend(handles=handles, loc="lower center", ncols=4, frameon=False, fontsize=size)
    return figure


def _rows(page: Page, count: int, legend: float) -> tuple[Figure, np.ndarray]:
    """Rows of four panels with room for a line above each row, and for a legend of so many inches below all; by hand,
    so that panels of all rows are as wide."""
    row, head = 0.215 * page.width, 0.42
    height = head + count * row + legend
    figure = page.figure(height / page.width)
    figure.set_layout_engine(None)
    figure.subplots_adjust(
        left=0.065, right=0.985, top=1 - head / height, bottom=(legend + 0.36) / height, wspace=0.42, hspace=0.85
    )
    return figure, figure.subplots(count, 4, squeeze=False)


def _entitle(axes: np.ndarray, title: str, heads: Sequence[str] | None) -> None:
    axes[0].annotate(
        title, (0, 1), (-22, 16 if heads else 8), xycoords="axes fraction", textcoords="offset points", fontsize=8
    )
    for axis, head in zip(axes, heads or (), strict=False):
        axis.set_title(head, fontsize=_SMALL, pad=4, color="#555555")


def _law(data: Data, law: dict, point: float, axes: np.ndarray) -> None:
    name, axis = law["name"], law["axis"]
    arrays, samples = data.arrays, data.record["samples"]
    for panel, form, color in zip(axes[:2], ("printed", "corrected"), (PRINTED, CORRECTED), strict=True):
        density, counts = arrays[f"{name}.{form}.density"], arrays[f"{name}.{form}.counts"]
        # forms whose scales differ much would hide each other
        own = 1.2 * _highest(density, counts, samples, axis, cut=point > 0)
        _histogram(panel, counts, arrays[f"{name}.{form}.counts_error"], samples, axis, color)
        panel.plot(_x(axis, density), density, color=color, linewidth=1.2)
        if f"{name}.target" in arrays:
            target = arrays[f"{name}.target"]
            panel.plot(_x(axis, target), target, color=WANTED, linestyle="--", linewidth=0.9)
            own = max(own, 1.1 * float(target.max()))
        panel.set_ylim(0, own)
        _abscissa(panel, axis)
    if point > 0:
        axes[0].text(0.5, 0.93, f"{point:.1%} in one point", transform=axes[0].transAxes, fontsize=_SMALL, ha="center")
    for form, color in (("printed", PRINTED), ("corrected", CORRECTED)):
        style = "-" if form == "printed" else (0, (4, 1.5))
        cdf, shown = arrays[f"{name}.{form}.cdf"], arrays[f"{name}.{form}.quantiles"]
        axes[2].plot(_x(axis, cdf), cdf, color=color, linestyle=style, linewidth=1.2)
        axes[3].plot(np.linspace(0, 1, len(shown)), np.degrees(shown), color=color, linestyle=style, linewidth=1.2)
    axes[2].axhline(1, color="#555555", linewidth=0.7, linestyle=":")
    axes[2].set_ylim(0, None)
    _abscissa(axes[2], axis)
    _inverse(axes[3], axis)


def _inverse(panel: Axes, axis: str) -> None:
    low, high, step = ENDS[axis]
    panel.set(xlim=(0, 1), ylim=(low, high), xticks=(0, 0.5, 1), yticks=np.arange(low, high + 1, step))
    panel.set_xlabel("u", fontsize=_SMALL, labelpad=1)
    panel.tick_params(labelsize=_SMALL)
    panel.grid(True)


def _abscissa(panel: Axes, axis: str) -> None:
    low, high, step = ENDS[axis]
    panel.set(xlim=(low, high), xticks=np.arange(low, high + 1, step))
    panel.set_xlabel(LABELS[axis], fontsize=_SMALL, labelpad=1)
    panel.tick_params(labelsize=_SMALL)
    panel.grid(True)


def _x(axis: str, values: np.ndarray) -> np.ndarray:
    return np.linspace(*ENDS[axis][:2], len(values))


def _per_radian(counts: np.ndarray, samples: int, axis: str) -> np.ndarray:
    width = np.radians(ENDS[axis][1] - ENDS[axis][0]) / len(counts)
    return counts / (samples * width)


def _highest(density: np.ndarray, counts: np.ndarray, samples: int, axis: str, cut: bool) -> float:
    """The highest line or bar; bars of points that hold a share of all samples may be cut."""
    top, bar = float(density.max()), float(_per_radian(counts, samples, axis).max())
    return max(top, min(2.2 * top, bar) if cut else bar)


def _histogram(panel: Axes, counts: np.ndarray, error: np.ndarray, samples: int, axis: str, color: str) -> None:
    height, error = (_per_radian(x, samples, axis) for x in (counts, error.astype(float)))
    edges = np.linspace(*ENDS[axis][:2], len(counts) + 1)
    middle = (edges[1:] + edges[:-1]) / 2
    panel.stairs(height, edges, fill=True, color=color, alpha=0.25)
    seen = counts > 0
    panel.errorbar(
        middle[seen], height[seen], 2 * error[seen], fmt="none", ecolor=color, elinewidth=0.6, alpha=0.8
    )  # fmt: skip


def _own(data: Data, page: Page) -> Figure:
    """Mixtures: their parts on a logarithmic scale, and the sum with samples beside |F|."""
    names = [own["name"] for own in data.record["own"]]
    parts = {own["name"]: own["parts"] for own in data.record["own"]}
    figure, axes = _rows(page, 2 * len(names), 0.7)
    theta_r, n, v = data.record["context"]
    heads = ("components, per radian", "all, per radian", *HEADS[2:])
    rows = [(name, axis) for name in names for axis in ("theta", "forward")]
    where = f"{data.record['preset']} hair, θ_r = {theta_r:g}°, n = {n:g}, v = {v:g}"
    for k, (row, (name, axis)) in enumerate(zip(axes, rows, strict=True)):
        _entitle(row, f"{OWN[name]}, {LABELS[axis][:2].strip()}" + ("" if k else f" ({where})"), None if k else heads)
        _mixture(data, f"own.{name}.{axis}", axis, parts[name], row)
    every = list(dict.fromkeys(part for name in names for part in parts[name]))
    handles = [
        Line2D([], [], color=CORRECTED, label="mixture and its samples"),
        Line2D([], [], color=WANTED, linestyle="--", label="|F|"),
        *(Line2D([], [], linewidth=1, label=part.replace("_", " "), **_look(part)) for part in every),
    ]
    figure.legend(handles=handles, loc="lower center", ncols=4, frameon=False, fontsize=_SMALL)
    return figure


def _look(part: str) -> dict:
    """A colour for a lobe, a dash for its scattered forms."""
    base, _, kind = part.partition("_")
    order = ("R", "TT", "TRT", "back", "broad", "uniform")
    colors = (COLORS[1], COLORS[2], COLORS[3], COLORS[5], COLORS[4], COLORS[7])
    styles = {"": "-", "scattered": (0, (4, 1.5)), "deep": ":"}
    return {"color": colors[order.index(base)], "linestyle": styles.get(kind, "-.")}


def _mixture(data: Data, key: str, axis: str, parts: list[str], axes: np.ndarray) -> None:
    arrays = data.arrays
    density, target = arrays[f"{key}.density"], arrays[f"own.target.{axis}"]
    for row, part in zip(arrays[f"{key}.parts"], parts, strict=True):
        if row.max() > 0:
            axes[0].plot(_x(axis, row), row, linewidth=0.9, **_look(part))
    axes[0].plot(_x(axis, target), target, color=WANTED, linestyle="--", linewidth=0.9)
    axes[0].plot(_x(axis, density), density, color=CORRECTED, linewidth=1.2)
    axes[0].set_yscale("log")
    axes[0].set_ylim(1e-5, 3 * float(density.max()))
    top = 1.2 * float(max(density.max(), target.max()))
    counts, error = arrays[f"{key}.counts"], arrays[f"{key}.counts_error"]
    _histogram(axes[1], counts, error, data.record["samples"], axis, CORRECTED)
    axes[1].plot(_x(axis, density), density, color=CORRECTED, linewidth=1.2)
    axes[1].plot(_x(axis, target), target, color=WANTED, linestyle="--", linewidth=0.9)
    axes[1].set_ylim(0, top)
    cdf, shown = arrays[f"{key}.cdf"], arrays[f"{key}.quantiles"]
    axes[2].plot(_x(axis, cdf), cdf, color=CORRECTED, linewidth=1.2)
    wanted = arrays[f"own.target_cdf.{axis}"]
    axes[2].plot(_x(axis, wanted), wanted, color=WANTED, linestyle="--", linewidth=0.9)
    axes[2].set_ylim(0, 1.05)
    axes[3].plot(np.linspace(0, 1, len(shown)), np.degrees(shown), color=CORRECTED, linewidth=1.2)
    for panel in axes[:3]:
        _abscissa(panel, axis)
    _inverse(axes[3], axis)
