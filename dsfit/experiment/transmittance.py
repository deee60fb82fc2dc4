"""One cell of a transmittance experiment: Gaussians fitted to a_f(theta)^n for every n, against the chapter's
cosine."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import numpy as np
import torch

from dsfit.experiment import build
from dsfit.experiment.schema import Config

_DEG = 180 / math.pi
_ANGLES = ("mean", "std", "centre", "width", "width_centred")
STEPS = 361


def transmittance(config: Config, say: Callable[[str], None]) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Fits (angles in degrees) and, for plots, a_f over theta."""
    from dsfit.fit.transmittance import fit_transmittance

    bsdf = build.bsdf(config)
    say("fits")
    fits = []
    for one in fit_transmittance(bsdf, config.transmittance.n):
        row = asdict(one)
        fits.append(
            {**{k: v for k, v in row.items() if k not in _ANGLES}, **{f"{k}_deg": row[k] * _DEG for k in _ANGLES}}
        )
    theta = torch.linspace(-math.pi / 2, math.pi / 2, STEPS, dtype=torch.float64)
    with torch.no_grad():
        a_f = bsdf.averages(theta).a_f.mean(-1)
    return {"fits": fits}, {"theta_deg": theta.numpy() * _DEG, "a_f": a_f.numpy()}
