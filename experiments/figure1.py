"""The chapter's figure 1: average forward and backward attenuation a_f, a_b over inclination, for the presets."""

from __future__ import annotations

import torch

from dsfit import DualScattering, Fiber
from dsfit.figures import Close, Data, Experiment, Settings, Work


class Figure1(Settings):
    """`step_deg` is the distance of inclinations."""

    step_deg: float = 0.5


def compute(settings: Figure1, work: Work) -> Data:
    """a_f and a_b, means over channels."""
    theta = torch.linspace(-90, 90, round(180 / settings.step_deg) + 1, dtype=torch.float64)
    arrays = {"theta_deg": theta.numpy()}
    for name in Fiber.presets():
        averages = DualScattering(Fiber.preset(name)).averages(torch.deg2rad(theta))
        arrays[f"{name}.a_f"] = averages.a_f.mean(-1).numpy()
        arrays[f"{name}.a_b"] = averages.a_b.mean(-1).numpy()
    return Data(arrays, {"presets": list(Fiber.presets())})


EXPERIMENT = Experiment(
    title="Average forward and backward attenuation (the chapter's figure 1)",
    shows="a_f and a_b over inclination for every preset.",
    settings=Figure1,
    compute=compute,
    minutes=0.5,
    reproduces={"*.a_?": Close(1e-10)},
    small=("step_deg=15",),
)
