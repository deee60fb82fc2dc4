"""Shared pieces of the longitudinal laws: the variable a law is in, and the truncated Gaussian in it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from dsfit.frame import HALF_PI, reachable
from dsfit.proposals.base import BatchFields, LongitudinalDistribution
from dsfit.special import any_of, is_tracked, truncated_normal_icdf, truncated_normal_log_density

VARIABLES = ("half", "diff", "in")
_LOG_JACOBIAN = {"half": -math.log(2), "diff": -math.log(2), "in": 0.0}  # log |dt / dtheta_i|


def bounds(variable: str, theta_r: Tensor) -> tuple[Tensor, Tensor]:
    """Interval of theta_half, theta_diff ("half", "diff") or theta_i ("in") that can be reached from theta_r."""
    if variable == "in":
        return torch.full_like(theta_r, -HALF_PI), torch.full_like(theta_r, HALF_PI)
    return reachable(theta_r)


def from_theta_i(variable: str, theta_i: Tensor, theta_r: Tensor) -> Tensor:
    """theta_i to the variable."""
    if variable == "in":
        return theta_i
    return (theta_r + theta_i if variable == "half" else theta_r - theta_i) / 2


def to_theta_i(variable: str, t: Tensor, theta_r: Tensor) -> Tensor:
    """The variable to theta_i, kept in [-pi/2, pi/2] against rounding without cutting the gradient."""
    theta_i = t if variable == "in" else (2 * t - theta_r if variable == "half" else theta_r - 2 * t)
    inside = theta_i.clamp(-HALF_PI, HALF_PI)
    return theta_i + (inside - theta_i).detach() if is_tracked(theta_i) else inside


def on_support(theta_i: Tensor, log_density: Callable[[Tensor], Tensor]) -> Tensor:
    """`log_density(theta_i)` for |theta_i| <= pi/2 (to a few ulp), -inf with zero gradient beyond."""
    value = log_density(theta_i.clamp(-HALF_PI, HALF_PI))
    outside = theta_i.abs() > HALF_PI * (1 + 4 * torch.finfo(theta_i.dtype).eps)
    return value.masked_fill(outside, -math.inf) if any_of(outside) else value


@dataclass(frozen=True)
class TruncatedGaussianInclination(BatchFields, LongitudinalDistribution):
    """`t ~ N(mean, std)` truncated to what theta_r can reach, t = theta_half, theta_diff or theta_i.

        p(theta_i) = |dt / dtheta_i| g(t - mean; std) / (Phi((H - mean) / std) - Phi((L - mean) / std))

    Args:
        theta_r, mean, std: `[*batch]`, radians; anything that broadcasts, from a parameter or from a network.
        variable: "half", "diff" (both with [L, H] = theta_r / 2 -+ pi / 4 and Jacobian 1/2) or "in" ([-pi/2, pi/2], 1).

    `sample` is the inverse CDF, reparametrised: differentiable in mean, std, theta_r and u.
    """

    theta_r: Tensor
    mean: Tensor
    std: Tensor
    variable: str = "half"

    def sample(self, u: Tensor) -> Tensor:
        low, high = bounds(self.variable, self.theta_r)
        return to_theta_i(self.variable, truncated_normal_icdf(u, self.mean, self.std, low, high), self.theta_r)

    def log_prob(self, theta_i: Tensor) -> Tensor:
        low, high = bounds(self.variable, self.theta_r)

        def inside(theta: Tensor) -> Tensor:
            t = from_theta_i(self.variable, theta, self.theta_r)
            t = torch.minimum(torch.maximum(t, low), high)  # rounding only
            return truncated_normal_log_density(t, self.mean, self.std, low, high) + _LOG_JACOBIAN[self.variable]

        return on_support(theta_i, inside)
