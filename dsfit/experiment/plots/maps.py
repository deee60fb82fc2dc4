"""The integrand, the proposals, and their ratio over the sphere of incident directions."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from dsfit.experiment.plots.style import new_figure, short

MOST_COLUMNS = 6
DECADES = 4.0
RATIO_DECADES = 2.0


def maps(cell: dict[str, Any], arrays: dict[str, np.ndarray]) -> Figure:
    """Top: |F| / ∫|F| and every proposal's density per steradian, one logarithmic colour scale. Bottom: their ratio,
    the weight of a sample in units of the mean weight; white is 1, a perfect proposal is white everywhere.

    Both scales end at fixed decades (four below the integrand's maximum, two around 1); what lies beyond has the
    end's colour.
    """
    methods = cell["methods"]
    density = arrays["integrand"]
    top = 10 ** np.ceil(np.log10(density.max()))
    norm = LogNorm(top * 10**-DECADES, top)
    ratio_norm = LogNorm(10**-RATIO_DECADES, 10**RATIO_DECADES)
    columns = min(len(methods), MOST_COLUMNS)
    bands = -(-len(methods) // columns)
    figure = new_figure(2.0 + 1.95 * (columns + 1), 0.9 + 3.9 * bands)
    axes = figure.subplots(2 * bands, columns + 1, sharex=True, sharey=True, squeeze=False)
    extent = (
        float(arrays["phi_deg"][0]),
        float(arrays["phi_deg"][-1]),
        float(arrays["theta_deg"][0]),
        float(arrays["theta_deg"][-1]),
    )

    def draw(axis: Any, values: np.ndarray, scale: LogNorm, colours: str) -> Any:
        return axis.imshow(
            np.clip(values, scale.vmin, scale.vmax),
            norm=scale,
            cmap=colours,
            extent=extent,
            origin="lower",
            aspect="auto",
        )

    image = ratio_image = None
    for axis in axes.flat:
        axis.set_visible(False)
    for band in range(bands):
        upper, lower = axes[2 * band], axes[2 * band + 1]
        upper[0].set_visible(True)
        image = draw(upper[0], density, norm, "viridis")
        upper[0].set_title("|F| / ∫|F|")
        upper[0].set_ylabel("θᵢ / °")
        here = list(enumerate(methods))[band * columns : (band + 1) * columns]
        for column, (index, method) in enumerate(here, start=1):
            p = arrays[f"density_{index}"]
            upper[column].set_visible(True)
            lower[column].set_visible(True)
            draw(upper[column], p, norm, "viridis")
            with np.errstate(divide="ignore", invalid="ignore"):
                ratio = np.where(p > 0, density / p, np.where(density > 0, np.inf, 1.0))
            ratio_image = draw(lower[column], ratio, ratio_norm, "RdBu_r")
            upper[column].set_title(short(method["name"], 22))
            lower[column].set_xlabel("φ / °")
        lower[1].set_ylabel("θᵢ / °")
        lower[1].tick_params(labelleft=True)
        for axis in (*upper, *lower):
            axis.set_xticks([-180, -90, 0, 90, 180], ["−180", "", "0", "", "180"])
            axis.set_yticks([-90, -45, 0, 45, 90])
    side = {"location": "right", "aspect": 25, "pad": 0.01, "extend": "both"}
    figure.colorbar(image, ax=axes[0::2, :].ravel().tolist(), label="density / sr⁻¹", **side)
    figure.colorbar(ratio_image, ax=axes[1::2, :].ravel().tolist(), label="|F| / (p ∫|F|)", **side)
    figure.suptitle(f"{cell['label']}: integrand and proposals (top), weight of a sample (bottom)", fontsize=10)
    return figure
