"""What passes n fibres, and the laws that stand for it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from dsfit.experiment.plots.style import COLORS, MARKERS, new_figure, spread
from dsfit.experiment.rundir import RunDirectory

COSINE_STD_DEG = 39.17  # of cos(theta) / 2 on [-90, 90]: sqrt(pi^2 / 4 - 2) radians
SHAPES = 4


def transmittance(directory: RunDirectory, result: dict[str, Any]) -> Iterator[tuple[str, Figure]]:
    """Two figures: parameters and excess against n, and the laws themselves for a few n."""
    yield "transmittance", _parameters(result)
    for cell in result["cells"][:4]:
        yield f"shapes-{cell['index']:04d}", _shapes(cell, directory.arrays(cell["index"]))


def _parameters(result: dict[str, Any]) -> Figure:
    figure = new_figure(10.0, 3.9)
    width_axis, centre_axis, excess_axis = figure.subplots(1, 3)
    for k, cell in enumerate(result["cells"]):
        fits = cell["fits"]
        n = [fit["n"] for fit in fits]
        color, marker = COLORS[k % len(COLORS)], MARKERS[k % len(MARKERS)]
        every = max(1, len(n) // 10)

        look = {"color": color, "marker": marker, "markevery": every, "markersize": 4, "linewidth": 1.2}

        def line(axis: Any, key: str, style: str, label: str | None = None, n=n, fits=fits, look=look) -> None:
            axis.plot(n, [fit[key] for fit in fits], style, label=label, **look)

        line(width_axis, "width_deg", "-", cell["label"])
        line(centre_axis, "centre_deg", "-")
        line(excess_axis, "excess_cosine", ":")
        line(excess_axis, "excess_centred", "--")
        line(excess_axis, "excess", "-")
    width_axis.axhline(COSINE_STD_DEG, color="#555555", linestyle=":", linewidth=1.2)
    width_axis.text(0.98, COSINE_STD_DEG + 0.6, "cosine law, any n", ha="right", va="bottom", color="#555555",
    fontsize=8,
                    transform=width_axis.get_yaxis_transform())  # fmt: skip
    centre_axis.axhline(0, color="#555555", linestyle=":", linewidth=1.2)
    width_axis.set(title="width of the fitted Gaussian", ylabel="degrees", ylim=(0, None))
    centre_axis.set(title="centre of the fitted Gaussian", ylabel="degrees")
    excess_axis.set(title="excess over n", yscale="log", ylabel="excess")
    styles = (("-", "Gaussian, width and centre"), ("--", "Gaussian, width only"), (":", "chapter's cosine"))
    laws = [Line2D([], [], linestyle=style, color="black", label=label) for style, label in styles]
    for axis in (width_axis, centre_axis, excess_axis):
        axis.set_xlabel("fibres passed, n")
        axis.grid(True)
    handles = [*width_axis.get_legend_handles_labels()[0], *laws]
    figure.legend(handles=handles, loc="outside lower center", ncols=min(len(handles), 7), frameon=False)
    figure.suptitle(result["title"] or result["name"], fontsize=10)
    return figure


def _shapes(cell: dict[str, Any], arrays: dict[str, np.ndarray]) -> Figure:
    theta, a_f = arrays["theta_deg"], arrays["a_f"]
    fits = [cell["fits"][i] for i in spread(len(cell["fits"]), SHAPES)]
    figure = new_figure(1.0 + 2.4 * len(fits), 3.2)
    axes = figure.subplots(1, len(fits), sharey=True, squeeze=False)[0]
    for axis, fit in zip(axes, fits, strict=True):
        log = fit["n"] * np.log(np.maximum(a_f, 1e-300))
        law = np.exp(log - log.max())
        gauss = np.exp(-0.5 * ((theta - fit["centre_deg"]) / fit["width_deg"]) ** 2)
        cosine = np.cos(np.radians(theta))
        for values, style, label in (
            (law, {"color": "black", "linewidth": 1.6}, "a_f(θ)ⁿ"),
            (gauss, {"color": COLORS[0], "linestyle": "--"}, "fitted Gaussian"),
            (cosine, {"color": COLORS[1], "linestyle": ":"}, "chapter's cosine"),
        ):
            axis.plot(theta, values / (values.sum() * (theta[1] - theta[0])), label=label, **style)
        axis.set(title=f"n = {fit['n']:g}", xlabel="θᵢ / °", xticks=[-90, -45, 0, 45, 90])
        axis.grid(True)
    axes[0].set_ylabel("density / degree⁻¹")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
    figure.suptitle(f"Transmittance: {cell['label']}", fontsize=10)
    return figure
