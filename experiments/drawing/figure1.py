"""Draws the averages over inclination."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from dsfit.experiment.plots.style import COLORS
from dsfit.figures import Data, Table
from dsfit.figures.page import Page


def figures(data: Data, page: Page) -> dict[str, Figure]:
    """a_f beside a_b."""
    figure = page.figure(0.48)
    forward, backward = figure.subplots(1, 2, sharey=True)
    theta = data.arrays["theta_deg"]
    for color, name in zip(COLORS, data.record["presets"], strict=False):
        forward.plot(theta, data.arrays[f"{name}.a_f"], color=color, label=name)
        backward.plot(theta, data.arrays[f"{name}.a_b"], color=color)
    forward.set(title="forward, a_f", ylabel="share of the light")
    backward.set(title="backward, a_b", ylim=(0, None))
    for axis in (forward, backward):
        axis.set(xlabel="θ / °", xticks=np.arange(-90, 91, 45))
        axis.grid(True)
    figure.legend(loc="outside lower center", ncols=4, frameon=False)
    return {"averages": figure}


def tables(data: Data) -> list[Table]:
    """a_f and a_b at normal incidence."""
    middle = len(data.arrays["theta_deg"]) // 2
    rows = [
        [name, *(f"{data.arrays[f'{name}.{key}'][middle]:.4f}" for key in ("a_f", "a_b"))]
        for name in data.record["presets"]
    ]
    caption = "Average attenuation at θ = 0, mean of the channels."
    return [Table("normal_incidence", caption, ["fibre", "a_f", "a_b"], rows)]
