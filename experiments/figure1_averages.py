"""The chapter's figure 1: average forward and backward transmittance a_f, a_b over inclination, for the presets.

    python experiments/figure1_averages.py [FOLDER]

computes `averages.npz` in FOLDER (default runs/figure1) and draws `averages.png` and `averages.pdf` from it.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import torch

from dsfit import DualScattering, Fiber
from dsfit.experiment.files import read_arrays, write_arrays
from dsfit.experiment.plots.style import COLORS, new_figure, save, styled


def compute(folder: Path) -> None:
    """a_f, a_b (means over channels) and their sum, every half degree."""
    theta = torch.linspace(-90, 90, 361, dtype=torch.float64)
    arrays = {"theta_deg": theta.numpy()}
    for name in Fiber.presets():
        averages = DualScattering(Fiber.preset(name)).averages(torch.deg2rad(theta))
        arrays[f"{name}.a_f"] = averages.a_f.mean(-1).numpy()
        arrays[f"{name}.a_b"] = averages.a_b.mean(-1).numpy()
    write_arrays(folder / "averages.npz", arrays)


def plot(folder: Path) -> list[Path]:
    """Draw what `compute` stored."""
    arrays = read_arrays(folder / "averages.npz")
    theta = arrays["theta_deg"]
    with styled():
        figure = new_figure(7.5, 3.4)
        forward, backward = figure.subplots(1, 2, sharey=True)
        for color, name in zip(COLORS, Fiber.presets(), strict=False):
            forward.plot(theta, arrays[f"{name}.a_f"], color=color, label=name)
            backward.plot(theta, arrays[f"{name}.a_b"], color=color)
        forward.set(title="forward, a_f", ylabel="share of the light")
        backward.set(title="backward, a_b", ylim=(0, None))
        for axis in (forward, backward):
            axis.set(xlabel="θ / °", xticks=np.arange(-90, 91, 45))
            axis.grid(True)
        figure.legend(loc="outside lower center", ncols=4, frameon=False)
        return save(figure, folder, "averages")


def main() -> None:
    """Compute, then plot."""
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "runs/figure1")
    compute(folder)
    for path in plot(folder):
        print(path)


if __name__ == "__main__":
    main()
