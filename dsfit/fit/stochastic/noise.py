"""Noise as path tracers make it, to fit and test with."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from dsfit.context import Context
from dsfit.errors import as_number, check_choice
from dsfit.fit.stochastic.samples import Radiance

KINDS = ("lognormal", "roulette")


class NoisyRadiance:
    """An integrand times independent noise of mean 1: `f = X F`, E X = 1, std X = `deviation`.

    Args:
        radiance: the integrand without noise.
        deviation: standard deviation of X, >= 0; relative to the radiance.
        kind: "lognormal": `X = exp(s Z - s^2 / 2)`, `s^2 = log(1 + deviation^2)`; "roulette": X = 1 / a with
            probability `a = 1 / (1 + deviation^2)`, else 0, as from a path that is ended early (deviation 3: 10 times
            or nothing).
        seed: of the noise.

    Raises:
        InputError: unknown kind, negative deviation.
    """

    def __init__(self, radiance: Radiance, deviation: float = 1.0, kind: str = "lognormal", *, seed: int = 0) -> None:
        self.radiance = radiance
        self.deviation, self.kind = as_number("deviation", deviation, 0.0), check_choice("kind", kind, KINDS)
        self.generator = torch.Generator().manual_seed(seed)

    def __call__(self, omega: Tensor, context: Context) -> Tensor:
        value = self.radiance(omega, context)
        made: dict[str, Any] = {"generator": self.generator, "dtype": torch.float64}
        if self.kind == "roulette":
            alive = 1 / (1 + self.deviation**2)
            factor = (torch.rand(omega.shape[:-1], **made) < alive) / alive
        else:
            variance = math.log1p(self.deviation**2)
            factor = torch.exp(math.sqrt(variance) * torch.randn(omega.shape[:-1], **made) - variance / 2)
        return value * factor.to(value).unsqueeze(-1)
