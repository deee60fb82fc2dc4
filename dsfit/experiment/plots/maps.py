"""The integrand, the proposals, and their ratio over the sphere of incident directions."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from dsfit.experiment.plots.style import new_figure, short, spread

MOST_COLUMNS = 7
DECADES = 4.0
RATIO_DECADES = 2.0


def maps(cell: dict[str, Any], arrays: dict[str, np.ndarray]) -> Figure:
    """Top: |F| / ∫|F| and every proposal's density per steradian, one logarithmic colour scale. Bottom: their ratio,
    the weight of a sample in units of the mean weight; white is 1, a perfect proposal is white everywhere.

    Both scales end at fixed decades (four below the integrand's maximum, two around 1); what lies beyond has the end's
    colour. Of methods with the same density the first is shown, and at most seven in all, the first and the last among
    them.
    """
    density = arrays["integrand"]
    shown = _different(arrays, len(cell["methods"]))
    shown = [shown[i] for i in spread(len(shown), MOST_COLUMNS)]
    top = 10 ** np.ceil(np.log10(density.max()))
    scale = LogNorm(top * 10**-DECADES, top)
    ratio_scale = LogNorm(10**-RATIO_DECADES, 10**RATIO_DECADES)
    figure = new_figure(1.9 + 1.9 * (len(shown) + 1), 4.6)
    axes = figure.subplots(2, len(shown) + 1, sharex=True, sharey=True, squeeze=False)
    extent = tuple(float(arrays[name][end]) for name in ("phi_deg", "theta_deg") for end in (0, -1))

    def draw(axis: Any, values: np.ndarray, norm: LogNorm, colours: str) -> Any:
        clipped = np.clip(values, norm.vmin, norm.vmax)
        return axis.imshow(clipped, norm=norm, cmap=colours, extent=extent, origin="lower", aspect="auto")

    axes[0, 0].set_title("|F| / ∫|F|")
    image = draw(axes[0, 0], density, scale, "viridis")
    axes[1, 0].set_visible(False)
    for column, index in enumerate(shown, start=1):
        p = arrays[f"density_{index}"]
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.where(p > 0, density / p, np.where(density > 0, np.inf, 1.0))
        draw(axes[0, column], p, scale, "viridis")
        ratio_image = draw(axes[1, column], ratio, ratio_scale, "RdBu_r")
        axes[0, column].set_title(short(cell["methods"][index]["name"], 24))
        axes[1, column].set_xlabel("φ / °")
    axes[0, 0].set_ylabel("θᵢ / °")
    axes[1, 1].set_ylabel("θᵢ / °")
    axes[1, 1].tick_params(labelleft=True)
    axes[0, 0].set_xticks([-180, -90, 0, 90, 180], ["−180", "", "0", "", "180"])
    axes[0, 0].set_yticks([-90, -45, 0, 45, 90])
    side = {"location": "right", "aspect": 18, "pad": 0.01, "extend": "both"}
    figure.colorbar(image, ax=axes[0].tolist(), label="density / sr⁻¹", **side)
    figure.colorbar(ratio_image, ax=axes[1].tolist(), label="|F| / (p ∫|F|)", **side)
    figure.suptitle(f"{cell['label']}: integrand and proposals (top), weight of a sample (bottom)", fontsize=10)
    return figure


def _different(arrays: dict[str, np.ndarray], count: int) -> list[int]:
    """Indices of the methods whose density is not that of an earlier one."""
    found: list[int] = []
    for index in range(count):
        if not any(np.array_equal(arrays[f"density_{index}"], arrays[f"density_{k}"]) for k in found):
            found.append(index)
    return found
