"""Your own proposal: a longitudinal law of your own, checked against its density, then fitted to blond hair.

python experiments/examples/own_proposal.py
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

import dsfit
from dsfit.checks.chi_square import chi_square
from dsfit.proposals import Mixture, Product, UniformAzimuth, UniformSphere
from dsfit.proposals.base import BatchFields, Longitudinal, LongitudinalDistribution
from dsfit.proposals.parameters import Bounded

ENDS = math.pi / 2


@dataclass(frozen=True)
class LogisticLaw(BatchFields, LongitudinalDistribution):
    """theta_i from a logistic law, centred at the mirror direction plus `shift`, cut off at +-pi/2."""

    centre: Tensor
    scale: Tensor

    def _ends(self) -> tuple[Tensor, Tensor]:
        """Values of the whole law's CDF at -pi/2 and pi/2."""
        return torch.sigmoid((-ENDS - self.centre) / self.scale), torch.sigmoid((ENDS - self.centre) / self.scale)

    def sample(self, u: Tensor) -> Tensor:
        low, high = self._ends()
        return (self.centre + self.scale * torch.logit(low + u * (high - low))).clamp(-ENDS, ENDS)

    def log_prob(self, theta_i: Tensor) -> Tensor:
        low, high = self._ends()
        z = (theta_i - self.centre) / self.scale
        logsigmoid = torch.nn.functional.logsigmoid
        return logsigmoid(z) + logsigmoid(-z) - torch.log(self.scale * (high - low))


class LogisticLobe(Longitudinal):
    """A module that, given the context, returns the law; `shift` and `scale`, radians, are learnable."""

    def __init__(self, shift: float, scale: float) -> None:
        super().__init__()
        self.shift = Bounded("shift", shift, -0.5, 0.5)
        self.scale = Bounded("scale", scale, 0.005, 1.0, log=True)

    def forward(self, context: dsfit.Context) -> LogisticLaw:
        return LogisticLaw(self.shift(context) - context.theta_r, self.scale(context))


def main() -> dict[str, float]:
    """Check, fit, and judge by quadrature."""
    integrand = dsfit.Integrand(dsfit.DualScattering(dsfit.Fiber.preset("blond")))
    context = dsfit.Context(theta_r=0.5)
    shifts = (-0.15, 0.07, 0.22)  # of R, TT and TRT
    start = Mixture([Product(LogisticLobe(shift, 0.1), UniformAzimuth()) for shift in shifts], defensive=0.05)
    generator = torch.Generator().manual_seed(1)
    check = chi_square(start, context, generator=generator)
    fit = dsfit.fit(start, integrand, context)
    return {
        "chi-square p": check.p_value,
        "uniform": float(dsfit.excess(integrand, UniformSphere(), context).value),
        "start": float(dsfit.excess(integrand, start, context).value),
        "fitted": float(dsfit.excess(integrand, fit.proposal, context).value),
    }


if __name__ == "__main__":
    for name, value in main().items():
        print(f"{name:<14}{value:.6g}")
