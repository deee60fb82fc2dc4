"""Draws the excess of amortised proposals over contexts and its distribution; tabulates it."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from dsfit.experiment.plots.style import COLORS
from dsfit.figures import Data, Table
from dsfit.figures.page import Page

_LOW, _HIGH = 1e-4, 1e-1
_RULES: tuple[tuple[str, Callable[[np.ndarray], np.ndarray]], ...] = (
    ("v = 0", np.zeros_like),
    ("v = exp(−n)", lambda n: np.exp(-n)),
)


def figures(data: Data, page: Page) -> dict[str, Figure]:
    """Maps over inclination and depth, and sorted excess."""
    return {"maps": _maps(data, page), "sorted": _sorted(data, page)}


def captions(data: Data) -> dict[str, str]:
    """What the two figures show."""
    count = len(data.arrays["n"])
    return {
        "maps": "Excess of the trained proposal at views and depths that it was not trained on (n = 0: direct light "
        "alone); upper row: nothing else directly lit, lower row: the share e^−n.",
        "sorted": f"Share of the {count} unseen contexts whose excess is below the value; dotted: the closed form that "
        "training starts from.",
    }


def _maps(data: Data, page: Page) -> Figure:
    fibres = data.record["fibres"]
    figure = page.figure(0.66)
    axes = figure.subplots(len(_RULES), len(fibres), sharex=True, sharey=True, squeeze=False)
    image = None
    for column, fibre in enumerate(fibres):
        for row, (rule, share) in enumerate(_RULES):
            image = _map(axes[row][column], data, fibre, share)
            if column == 0:
                axes[row][column].set_ylabel(f"fibres passed, n\n({rule})")
        axes[0][column].set_title(fibre)
        axes[-1][column].set_xlabel("θr / °")
    bar = figure.colorbar(image, ax=axes, location="right", aspect=30, pad=0.01, extend="both")
    bar.set_label("excess")
    bar.ax.yaxis.set_major_formatter(FuncFormatter(_power))
    return figure


def _power(value: float, _: Any = None) -> str:
    return f"1e{round(math.log10(value))}" if value > 0 else ""


def _map(axis: Axes, data: Data, fibre: str, share: Callable[[np.ndarray], np.ndarray]) -> Any:
    """Cells of one rule of v; the first row, n = 0, is direct light."""
    theta, n, v = (data.arrays[name] for name in ("theta_r_deg", "n", "v"))
    excess = data.arrays[f"{fibre}.trained"]
    angles, depths = np.unique(theta), np.unique(n)
    values = np.full((len(depths), len(angles)), np.nan)
    mine = (n == 0) | np.isclose(v, share(n), rtol=1e-9, atol=0)
    values[np.searchsorted(depths, n[mine]), np.searchsorted(angles, theta[mine])] = excess[mine]
    image = axis.pcolormesh(values, norm=LogNorm(_LOW, _HIGH), cmap="viridis", rasterized=True)
    every = [0, len(angles) // 4, len(angles) // 2, 3 * len(angles) // 4, len(angles) - 1]
    axis.set_xticks([k + 0.5 for k in every], [f"{angles[k]:.0f}" for k in every])
    axis.set_yticks(np.arange(len(depths))[::2] + 0.5, [f"{x:g}" for x in depths[::2]])
    axis.tick_params(labelsize=6.5)
    return image


def _sorted(data: Data, page: Page) -> Figure:
    figure = page.figure(0.55)
    axis = figure.subplots()
    for k, fibre in enumerate(data.record["fibres"]):
        color = COLORS[k % len(COLORS)]
        for key, line in (("start", ":"), ("trained", "-")):
            excess = np.sort(data.arrays[f"{fibre}.{key}"])
            share = (np.arange(len(excess)) + 0.5) / len(excess)
            axis.plot(excess, share, color=color, linestyle=line, label=fibre if line == "-" else None)
    axis.plot([], [], color="#555555", linestyle=":", label="untrained")
    for level in (0.5, 0.99):
        axis.axhline(level, color="#999999", linewidth=0.7)
        axis.annotate(
            "median" if level == 0.5 else "99 %", (1, level), xycoords=("axes fraction", "data"), fontsize=7,
            ha="right", va="bottom", color="#666666",
        )  # fmt: skip
    axis.set(xscale="log", xlabel="excess", ylabel="share of the unseen contexts below", ylim=(0, 1.04))
    axis.xaxis.set_major_formatter(FuncFormatter(_power))
    axis.grid(True)
    axis.legend(frameon=False, loc="lower right")
    return figure


def tables(data: Data) -> list[Table]:
    """Quantiles and what training took; and what happens beyond the contexts of the training."""
    return [_quantiles(data), _beyond(data)]


def _quantiles(data: Data) -> Table:
    head = [
        "fibre", "untrained: median", "99 %", "trained: median", "95 %", "99 %", "worst", "at (θr, n, v)",
        "largest weight", "s: tables", "targets", "training",
    ]  # fmt: skip
    rows = []
    for fibre in data.record["fibres"]:
        start, trained = (data.arrays[f"{fibre}.{key}.summary"] for key in ("start", "trained"))
        at = data.record["worst_at"][fibre]
        rows.append(
            [
                fibre,
                *(_short(float(start[k])) for k in (0, 2)),
                *(_short(float(value)) for value in trained),
                f"{at['theta_r_deg']:.0f}°, {at['n']:g}, {at['v']:.2g}",
                _short(float(data.arrays[f"{fibre}.weight"])),
                *(f"{value:.0f}" for value in data.arrays[f"{fibre}.seconds"]),
            ]
        )
    caption = (
        f"Excess at {len(data.arrays['n'])} contexts that were not trained on, by quadrature: 0 is the limit of any "
        f"density. Trained on {data.record['trained_on']} contexts for {data.record['steps']} steps "
        f"({data.record['parameters']} parameters); seconds of one thread."
    )
    return Table("quantiles", caption, head, rows)


def _beyond(data: Data) -> Table:
    head = ["θr", "n", *data.record["fibres"]]
    rows = [
        [f"{theta:.4g}°", f"{n:g}", *(_short(float(data.arrays[f"{fibre}.beyond"][k])) for fibre in head[2:])]
        for k, (theta, n) in enumerate(data.record["beyond"])
    ]
    return Table(
        "beyond",
        "Excess outside the training's ranges; -: no light is left in float64.",
        head,
        rows,
        "rr" + "r" * (len(head) - 2),
    )


def _short(value: float) -> str:
    if math.isnan(value):
        return "-"
    return f"{value:.1e}" if 0 < abs(value) < 1e-3 else f"{value:.3g}"
