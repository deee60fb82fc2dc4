"""Longitudinal laws for the transmittance a_f^n of light that passed n fibres (chapter eqs (32)-(36))."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from dsfit.context import Context
from dsfit.errors import check_choice
from dsfit.frame import reachable
from dsfit.proposals.base import BatchFields, Longitudinal, LongitudinalDistribution
from dsfit.proposals.inclination import TruncatedGaussianInclination, on_support, to_theta_i
from dsfit.proposals.parameters import MEAN_BOUNDS, STD_BOUNDS, Bounded


@dataclass(frozen=True)
class TransmittanceCosineInclination(BatchFields, LongitudinalDistribution):
    """Density proportional to cos(theta_diff) over the reachable interval; see `TransmittanceCosine`."""

    theta_r: Tensor

    def sample(self, u: Tensor) -> Tensor:
        low, high = reachable(self.theta_r)
        # 1 - sin and 1 + sin of theta_diff as sums of positive terms; 1 - sin x = 2 sin^2(pi/4 - x/2) at both ends
        minus = 2 * ((1 - u) * torch.sin(math.pi / 4 - low / 2) ** 2 + u * torch.sin(math.pi / 4 - high / 2) ** 2)
        plus = 2 * ((1 - u) * torch.sin(math.pi / 4 + low / 2) ** 2 + u * torch.sin(math.pi / 4 + high / 2) ** 2)
        t = torch.atan2((plus - minus) / 2, torch.sqrt(minus * plus))
        return to_theta_i("diff", t, self.theta_r)

    def log_prob(self, theta_i: Tensor) -> Tensor:
        log_norm = torch.log(2 * math.sqrt(2) * torch.cos(self.theta_r / 2))

        def inside(theta: Tensor) -> Tensor:
            cosine = torch.cos((self.theta_r - theta) / 2)
            return torch.log(cosine.clamp_min(torch.finfo(cosine.dtype).eps ** 2)) - log_norm

        return on_support(theta_i, inside)


class TransmittanceCosine(Longitudinal):
    """theta_diff of density `cos(theta_diff) / (sqrt 2 cos(theta_r/2))` on [L, H], so theta_i = theta_r - 2 theta_diff.

    Chapter eqs (33)-(35) corrected: the normalisation is that of the reachable interval and the inverse CDF is
    `asin(sin L + u (sin H - sin L))`. No parameters.
    """

    def forward(self, context: Context) -> TransmittanceCosineInclination:
        return TransmittanceCosineInclination(context.theta_r)


class TransmittanceGaussian(Longitudinal):
    """Truncated Gaussian in theta_diff, or in theta_i: the transmittance law with a width to tune.

    Args:
        width: standard deviation, radians; the classic parameter to tune against a_f^n, which narrows as n grows.
        centre: mean, radians; the peak of a_f^n is shifted from 0 by the tilt of the cuticle.
        variable: "diff" (theta_diff on [L, H]) or "in" (theta_i on [-pi/2, pi/2], the argument that a_f has).
        learnable: whether `parameters()` lists width and centre.

    Raises:
        InputError: a value outside its bounds, or another variable.
    """

    def __init__(
        self,
        width: float | Tensor,
        centre: float | Tensor = 0.0,
        *,
        variable: str = "diff",
        learnable: bool = True,
    ) -> None:
        super().__init__()
        self.variable = check_choice("variable", variable, ("diff", "in"))
        self.centre = Bounded("centre", centre, *MEAN_BOUNDS, learnable=learnable)
        self.width = Bounded("width", width, *STD_BOUNDS, log=True, learnable=learnable)

    def forward(self, context: Context) -> TruncatedGaussianInclination:
        return TruncatedGaussianInclination(context.theta_r, self.centre(context), self.width(context), self.variable)
