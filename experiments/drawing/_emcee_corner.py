"""Joint density of the walkers under contours of |F|, with both marginals."""

from __future__ import annotations

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from dsfit.experiment.plots.style import COLORS
from dsfit.figures import Data
from dsfit.figures.page import Page

SHARES = (0.5, 0.9, 0.99)
"""Shares of |F| that lie inside the contours."""
_STYLES = ("-", "--", ":")


def corner(data: Data, page: Page) -> Figure:
    """Four panels, two in a row, one for each preset at the context that is shown."""
    names = [name for name in data.record["order"] if f"{name}.map.chain" in data.arrays]
    rows = -(-len(names) // 2)
    figure = page.figure(0.12 + 0.45 * rows)
    theta_r, n, v = data.record["cells"][names[0]]["context"]
    figure.suptitle(f"θ_r = {theta_r:g}°, n = {n:g}, v = {v:g}", fontsize=8)
    parts = figure.subfigures(rows, 3, squeeze=False, width_ratios=(1, 1, 0.22))
    densest = max(float(data.arrays[f"{name}.map.chain"].max()) for name in names)
    norm = LogNorm(1e-4 * densest, densest)
    for name, part in zip(names, parts[:, :2].flat, strict=False):
        _one(part, data, name, norm)
    place = parts[0, 2].add_axes((0.05, 0.05, 0.12, 0.8))
    bar = figure.colorbar(ScalarMappable(norm, "Blues"), cax=place)
    bar.set_label("share of places in 5° × 10°", fontsize=7)
    bar.ax.tick_params(labelsize=6)
    handles = [
        *(Line2D([], [], color="black", linestyle=s, linewidth=0.9, label=f"{share:.0%} of |F| inside")
          for share, s in zip(SHARES, _STYLES, strict=True)),
        Line2D([], [], color="black", linewidth=0.9, label="marginal, quadrature"),
        Patch(color=COLORS[0], alpha=0.3, label="marginal, walkers"),
    ]  # fmt: skip
    figure.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False, fontsize=7)
    return figure


def _one(part: Figure, data: Data, name: str, norm: LogNorm) -> None:
    axes = part.subplots(2, 2, width_ratios=(4, 1), height_ratios=(1, 3.2))
    (top, empty), (joint, side) = axes
    empty.set_visible(False)
    chain, exact = data.arrays[f"{name}.map.chain"], data.arrays[f"{name}.map.quadrature"].astype(float)
    joint.pcolormesh(
        np.linspace(-180, 180, chain.shape[1] + 1), np.linspace(-90, 90, chain.shape[0] + 1),
        np.ma.masked_less_equal(chain, 0), norm=norm, cmap="Blues", rasterized=True,
    )  # fmt: skip
    theta, phi = (_middles(reach, count) for reach, count in zip((90, 180), exact.shape, strict=True))
    levels = [_level(exact, share) for share in SHARES]
    order = np.argsort(levels)
    joint.contour(
        phi, theta, exact, levels=[levels[k] for k in order], linestyles=[_STYLES[k] for k in order],
        colors="black", linewidths=0.9,
    )  # fmt: skip
    for panel, axis, reach, direction in ((top, "phi", 180, "vertical"), (side, "theta", 90, "horizontal")):
        edges = np.linspace(-reach, reach, data.record["bins"][axis] + 1)
        panel.stairs(
            data.arrays[f"{name}.{axis}.chain"], edges, orientation=direction, fill=True, color=COLORS[0], alpha=0.3
        )
        panel.stairs(
            data.arrays[f"{name}.{axis}.quadrature"], edges, orientation=direction, color="black", linewidth=0.9
        )
    joint.set(xlim=(-180, 180), ylim=(-90, 90), xticks=(-180, -90, 0, 90, 180), yticks=(-90, -45, 0, 45, 90))
    joint.set_xlabel("φ / °", fontsize=7, labelpad=1)
    joint.set_ylabel("θᵢ / °", fontsize=7, labelpad=1)
    joint.tick_params(labelsize=6)
    top.set(xlim=(-180, 180), xticks=(), yticks=(), ylim=(0, None))
    side.set(ylim=(-90, 90), xticks=(), yticks=(), xlim=(0, None))
    top.set_title(data.record["cells"][name]["preset"], fontsize=8, loc="left", pad=2)


def _middles(reach: float, count: int) -> np.ndarray:
    return (np.arange(count) + 0.5) / count * 2 * reach - reach


def _level(share: np.ndarray, inside: float) -> float:
    """Least share of a cell among the densest cells that together hold `inside`."""
    ordered = np.sort(share.ravel())[::-1]
    return float(ordered[np.searchsorted(np.cumsum(ordered), inside * ordered.sum())])
