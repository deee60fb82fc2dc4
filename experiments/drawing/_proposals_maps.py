"""Maps over (theta_i, phi): probability of cells, counts of samples, and the difference in standard errors."""

from __future__ import annotations

import matplotlib
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure

from dsfit.figures import Data
from dsfit.figures.page import Page

_DECADES, _SPAN, _BLOCKS = 1e-4, 4.0, 2


def all_maps(data: Data, page: Page) -> Figure:
    """Three small maps for every proposal."""
    names = data.record["maps"]
    rows = -(-len(names) // _BLOCKS)
    figure = page.figure(0.16 + 0.135 * rows)
    theta_r, n, v = data.record["context"]
    figure.suptitle(
        f"{data.record['preset']} hair, θ_r = {theta_r:g}°, n = {n:g}, v = {v:g}: probability of 7.5° × 10° cells,\n"
        f"counts of {data.record['map_samples']:,} samples, and their residual",
        fontsize=8,
    )
    axes = figure.subplots(rows, 3 * _BLOCKS, sharex=True, sharey=True, squeeze=False)
    shades = matplotlib.colormaps["viridis"].with_extremes(bad="#ffffff", under="#ffffff")
    sky, gap = LogNorm(_DECADES, 1), Normalize(-_SPAN, _SPAN)
    for k in range(rows * _BLOCKS):
        block, row = divmod(k, rows)
        panels = axes[row, 3 * block : 3 * block + 3]
        if k >= len(names):
            for panel in panels:
                panel.set_visible(False)
            continue
        expected, observed = (data.arrays[f"map.{names[k]}.{key}"].astype(float) for key in ("expected", "observed"))
        top = expected.max()
        # what a cell of counts scatters by; below 5 expected, counts are not Gaussian and their residual is kept small
        residual = (observed - expected) / np.sqrt(np.maximum(expected, 5.0))
        for panel, values, norm, colors in (
            (panels[0], np.ma.masked_less_equal(expected / top, 0), sky, shades),
            (panels[1], np.ma.masked_less_equal(observed / top, 0), sky, shades),
            (panels[2], residual, gap, matplotlib.colormaps["RdBu_r"]),
        ):
            panel.imshow(values, origin="lower", extent=(-180, 180, -90, 90), norm=norm, cmap=colors, aspect="auto")
            panel.set(xticks=(-180, 0, 180), yticks=(-90, 0, 90))
            panel.tick_params(labelsize=6, length=2)
        panels[0].set_title(
            names[k] if names[k].startswith("M") else names[k].replace("_", " "), fontsize=7, loc="left", pad=2
        )
    for panel in axes[-1] if len(names) == rows * _BLOCKS else [*axes[-1, :3], *axes[-2, 3:]]:
        panel.tick_params(labelbottom=True)
        panel.set_xlabel("φ / °", fontsize=6, labelpad=1)
        panel.set_xticks((-180, 0, 180), ("−180", "0", "180"))
    for panel in axes[:, 0]:
        panel.set_ylabel("θᵢ / °", fontsize=6, labelpad=0)
    bars = ((sky, shades, "over the largest probability"), (gap, "RdBu_r", "residual / standard errors"))
    for norm, colors, label in bars:
        bar = figure.colorbar(
            ScalarMappable(norm, colors), ax=axes, location="bottom", shrink=0.42, aspect=40, pad=0.01
        )  # fmt: skip
        bar.set_label(label, fontsize=7)
        bar.ax.tick_params(labelsize=6)
    return figure
