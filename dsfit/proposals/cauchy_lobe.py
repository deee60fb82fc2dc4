"""A longitudinal lobe with heavy tails."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from dsfit.context import Context
from dsfit.frame import reachable
from dsfit.proposals.base import BatchFields, Longitudinal, LongitudinalDistribution
from dsfit.proposals.inclination import on_support, to_theta_i
from dsfit.proposals.parameters import MEAN_BOUNDS, STD_BOUNDS, Bounded


@dataclass(frozen=True)
class CauchyInclination(BatchFields, LongitudinalDistribution):
    """theta_h from a Cauchy law truncated to [L, H]; see `CauchyLobe`. Fields `[*batch]`, radians."""

    theta_r: Tensor
    mean: Tensor
    scale: Tensor

    def _window(self) -> tuple[Tensor, Tensor, Tensor]:
        """Ends of the window from the centre, and the angle atan(high / scale) - atan(low / scale) in (0, pi)."""
        low, high = (end - self.mean for end in reachable(self.theta_r))
        return low, high, torch.atan2((math.pi / 2) * self.scale, self.scale**2 + low * high)

    def sample(self, u: Tensor) -> Tensor:
        low, high, angle = self._window()
        upper = u > 0.5  # start from the nearer end, where the tangent's addition formula does not cancel
        start, psi = torch.where(upper, -high, low), torch.where(upper, 1 - u, u) * angle
        sin, cos = torch.sin(psi), torch.cos(psi)
        t = self.scale * (start * cos + self.scale * sin) / (self.scale * cos - start * sin)
        t = torch.where(upper, -t, t)
        return to_theta_i("half", t + self.mean, self.theta_r)

    def log_prob(self, theta_i: Tensor) -> Tensor:
        _, _, angle = self._window()

        def inside(theta: Tensor) -> Tensor:
            t = (theta + self.theta_r) / 2 - self.mean
            return torch.log(self.scale) - torch.log(t * t + self.scale**2) - torch.log(2 * angle)

        return on_support(theta_i, inside)


class CauchyLobe(Longitudinal):
    """`theta_h - mean ~ Cauchy(scale)` truncated to [L, H] = theta_r / 2 -+ pi / 4 (Ou et al. 2012).

    Per radian of theta_i: `scale / (2 (A - B) (t^2 + scale^2))`, t = theta_h - mean, A, B = atan of the ends over
        scale. Its tails dominate every Gaussian, which keeps weights bounded in multiple importance sampling; it
        needs no error function.

    Args:
        mean: centre in theta_h, radians. scale: half width at half maximum in theta_h, radians. Both learnable or not.

    Raises:
        InputError: mean or scale outside its bounds.
    """

    def __init__(self, mean: float | Tensor, scale: float | Tensor, *, learnable: bool = True) -> None:
        super().__init__()
        self.mean = Bounded("mean", mean, *MEAN_BOUNDS, learnable=learnable)
        self.scale = Bounded("scale", scale, *STD_BOUNDS, log=True, learnable=learnable)

    def forward(self, context: Context) -> CauchyInclination:
        return CauchyInclination(context.theta_r, self.mean(context), self.scale(context))
