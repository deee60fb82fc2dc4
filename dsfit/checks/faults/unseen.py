"""Slips that no check sees, because nothing that a check could measure is wrong: kept here so that nobody believes them
to be covered."""

from __future__ import annotations

from typing import Any

import torch

from dsfit.checks.faults import looks
from dsfit.checks.faults.in_samplers import _chapter
from dsfit.checks.faults.planting import Fault, Patch, changed


def _other_centre(forward: Any) -> Any:
    """Lobes tilted the other way, in the sampler and in the density alike."""

    def wrong(self: Any, context: Any) -> Any:
        law = forward(self, context)
        return type(law)(law.theta_r, -law.mean, law.std, law.variable)

    return wrong


UNSEEN_FAULTS = (
    Fault(
        "unseen-tilt", "dsfit.proposals.gaussian_lobe", "a lobe tilted the wrong way in sampler and density alike: "
        "unbiased, with a larger variance (`dsfit run` shows it as excess)",
        (Patch("dsfit.proposals.gaussian_lobe:GaussianLobe.forward", _other_centre),), "chi_square",
        looks.sampling(_chapter("TT")), caught=False,
    ),
    Fault(
        "unseen-parameter", "dsfit.bsdf.fiber", "a wrong number in a preset: any hair is consistent",
        (Patch("dsfit.bsdf.fiber:Fiber.preset",
               changed(lambda fiber, *_: fiber.replace(sigma_a=1.1 * fiber.sigma_a))),),
        "furnace", looks.energy(), caught=False,
    ),
    Fault(
        "unseen-light", "dsfit.scene.integrand", "a light that is dimmer at grazing: integrand, samples and reference "
        "all see the same",
        (Patch("dsfit.scene.integrand:Integrand.__call__",
               lambda original: lambda self, omega, context: original(self, omega, context)
               * torch.cos(omega[..., :1])),),
        "unbiased", looks.estimating(lambda: {"TT": _chapter("TT")(None)}), caught=False,
    ),
)  # fmt: skip
