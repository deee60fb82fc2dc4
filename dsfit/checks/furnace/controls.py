"""Samplers that are wrong in ways a white furnace can miss. Every check here has to reject them."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from dsfit.context import Context
from dsfit.frame import HALF_PI
from dsfit.proposals.base import Distribution, Proposal


class ConstantIntegrand:
    """f = 1 / (4 pi) per steradian in every direction: a lossless surface that scatters evenly; integrates to 1.

    Any sampler whose weights are right in total passes its white furnace, wherever its directions go.
    """

    is_even = True
    channels = 1

    def __call__(self, omega_i: Tensor, context: Context) -> Tensor:
        return torch.full_like(omega_i[..., :1], 1 / (4 * math.pi))


class WrappedDistribution(Distribution):
    """A distribution whose directions are turned into others; what is said about them is the original's."""

    def __init__(self, base: Distribution, control: Control) -> None:
        self.base, self.control = base, control
        self.dimension, self.batch_shape = base.dimension, base.batch_shape

    def log_prob(self, omega: Tensor) -> Tensor:
        return self.base.log_prob(omega)

    def sample_with_log_prob(self, u: Tensor) -> tuple[Tensor, Tensor]:
        omega, log_prob = self.base.sample_with_log_prob(u)
        omega = self.control.change(omega)
        return omega, self.base.log_prob(omega) if self.control.consistent else log_prob


class Control(Proposal):
    """A proposal with a slip put into it.

    Args:
        base: the proposal that is spoiled.
        consistent: whether the density returned with a direction is that of `log_prob` at the returned direction (a
            test that only compares the two sees nothing), or that of the direction before it was changed (the mean
            weight of a constant integrand stays exact).
    """

    def __init__(self, base: Proposal, consistent: bool = False) -> None:
        super().__init__()
        self.base, self.consistent = base, consistent

    def forward(self, context: Context) -> WrappedDistribution:
        return WrappedDistribution(self.base(context), self)

    def change(self, omega: Tensor) -> Tensor:
        """What becomes of the direction."""
        raise NotImplementedError


class FlippedInclination(Control):
    """theta_i with the wrong sign: the tangent points from tip to root in the sampler, from root to tip elsewhere."""

    def change(self, omega: Tensor) -> Tensor:
        return torch.stack([-omega[..., 0], omega[..., 1]], dim=-1)


class Folded(Control):
    """Only the half with theta_i >= 0, at the density of the whole sphere: as printed where asin loses its range."""

    def change(self, omega: Tensor) -> Tensor:
        return torch.stack([omega[..., 0].abs(), omega[..., 1]], dim=-1)


class PermutedRings(Control):
    """Right only in total: directions of every ring are sent into another, twice as many into some as into others.

    The sphere is cut into `2 k` rings of equal solid angle; those of ring j go into ring 2 floor(j / 2).
    """

    def __init__(self, base: Proposal, consistent: bool = False, pairs: int = 4) -> None:
        super().__init__(base, consistent)
        self.pairs = pairs

    def change(self, omega: Tensor) -> Tensor:
        rings = 2 * self.pairs
        place = (torch.sin(omega[..., 0]) + 1) / 2 * rings
        ring = place.floor().clamp(0, rings - 1)
        moved = (2 * torch.floor(ring / 2) + (place - ring)) / rings
        theta = torch.asin((2 * moved - 1).clamp(-1.0, 1.0))
        return torch.stack([theta.clamp(-HALF_PI, HALF_PI), omega[..., 1]], dim=-1)


class ScaledDensity(Control):
    """The right directions with a density that is `factor` times too large, as without a Jacobian."""

    def __init__(self, base: Proposal, factor: float = 2.0) -> None:
        super().__init__(base, True)
        self.factor = factor

    def forward(self, context: Context) -> WrappedDistribution:
        return _Scaled(self.base(context), self)

    def change(self, omega: Tensor) -> Tensor:
        return omega


class _Scaled(WrappedDistribution):
    def log_prob(self, omega: Tensor) -> Tensor:
        return self.base.log_prob(omega) + math.log(self.control.factor)

    def sample_with_log_prob(self, u: Tensor) -> tuple[Tensor, Tensor]:
        omega, log_prob = self.base.sample_with_log_prob(u)
        return omega, log_prob + math.log(self.control.factor)
