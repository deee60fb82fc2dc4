"""Random walks on |F| against the fitted proposal and quadrature: marginals, integrals, and what each costs."""

from __future__ import annotations

import math

import numpy as np
import torch
from pydantic import Field

from dsfit.bsdf.dual_scattering import DualScattering
from dsfit.bsdf.fiber import Fiber
from dsfit.context import Context
from dsfit.figures import Close, Data, Estimate, Experiment, Measured, Settings, Work


class EmceeAgreement(Settings):
    """Fibres, contexts (theta_r in degrees, n, v) and sample sizes; see `configs/figures/emcee_agreement.toml`."""

    presets: list[str] = Field(["nonabsorbing", "blond", "brown", "black"], min_length=1)
    contexts: list[list[float]] = Field([[15.0, 0.0, 1.0], [45.0, 3.0, 0.5], [70.0, 10.0, 0.1]], min_length=1)
    shown: int = Field(1, ge=0)
    ensembles: int = Field(16, ge=4, multiple_of=2)
    walkers: int = Field(32, ge=8, multiple_of=2)
    steps: int = Field(400, ge=8)
    burn_in: int = Field(130, ge=1)
    samples: int = Field(32_768, ge=1000)
    fit_steps: int = Field(60, ge=1)
    seed: int = 1


def compute(settings: EmceeAgreement, work: Work) -> Data:
    """Every preset at every context."""
    from experiments._emcee_cell import Sizes, compare, walk
    from experiments._emcee_marginals import BINS

    sizes = Sizes(**{name: getattr(settings, name) for name in Sizes.__annotations__})
    arrays: dict[str, np.ndarray] = {}
    cells = {}
    for preset in settings.presets:
        bsdf = DualScattering(Fiber.preset(preset), precision="table")
        for k, (theta_r, n, v) in enumerate(settings.contexts):
            name = f"{preset}{k}"
            work.say(f"{preset} hair, theta_r {theta_r:g} degrees, n {n:g}, v {v:g}")
            context = Context(math.radians(theta_r), 0.0, n, v, dtype=torch.float64)
            seed = 1_000_003 * settings.seed + 7919 * len(cells)
            walked = walk(bsdf, context, sizes, seed)
            found = compare(walked, walked.fitted, sizes.samples, seed + 1, maps=k == settings.shown)
            arrays |= {f"{name}.{key}": value for key, value in found.arrays.items()}
            cells[name] = {"preset": preset, "context": [theta_r, n, v], **found.numbers}
    order = [f"{preset}{k}" for preset in settings.presets for k in range(len(settings.contexts))]
    record = {
        "order": order,
        "contexts": len(settings.contexts),
        "shown": settings.shown,
        "bins": dict(BINS),
        "sizes": [settings.ensembles, settings.walkers, settings.steps, settings.burn_in],
        "cells": cells,
    }
    return Data(arrays, record)


_ANY = math.inf  # bins far out hold nothing, or little
_NUMBERS = ("bridge", "importance", "acceptance", "tau", "between_ess")

EXPERIMENT = Experiment(
    title="Random walks on |F| against the fitted proposal and quadrature",
    shows="Marginals of θ_i, φ and log |F| by emcee's walkers, by the fitted proposal reweighted and by quadrature, "
    "the joint density of the walkers under contours of |F|, the integral by bridge sampling, and what each costs.",
    settings=EmceeAgreement,
    compute=compute,
    minutes=2.5,
    needs=("emcee", "arviz_stats"),
    reproduces={
        "cells.*.p.*": Measured(),  # new with every seed
        "cells.*.seconds.*": Measured(),
        "*.map.chain": Close(0.0, 2e-3),
        "*.chain": Estimate("*.chain_error", most=_ANY),
        "*.proposal": Estimate("*.proposal_error", most=_ANY),
        **{f"cells.*.{name}": Estimate(f"cells.*.{name}_error", most=1.0) for name in _NUMBERS},
        "*.map.quadrature": Close(1e-5, 1e-9),
        "*.quadrature": Close(1e-5, 1e-7),
        "*.quadrature_bound": Measured(),
        "*.size.edges": Close(1e-6),
        "cells.*.excess": Close(0.3, 1e-5),  # where the fit stops depends on rounding
        "cells.*.proposal_ess": Close(0.02),
        "cells.*.region": Close(0.01),
        # new with every seed, of the order that they have
        "cells.*.autocorrelation": Close(0.5),
        "cells.*.bulk_ess": Close(0.5),
        "cells.*.grid_gap": Measured(),
        "cells.*.r_hat": Measured(),
        "cells.*.nested_r_hat": Measured(),
        "cells.*.tail_index": Measured(),
    },
    small=(
        'presets=["blond"]',
        "contexts=[[45.0, 3.0, 0.5]]",
        "shown=0",
        "steps=60",
        "burn_in=20",
        "samples=4096",
        "fit_steps=2",
    ),
)
