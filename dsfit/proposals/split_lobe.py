"""A longitudinal lobe with different widths on either side of its mode."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dsfit.context import Context
from dsfit.frame import reachable
from dsfit.proposals.base import BatchFields, Longitudinal, LongitudinalDistribution
from dsfit.proposals.inclination import to_theta_i
from dsfit.proposals.parameters import MEAN_BOUNDS, STD_BOUNDS, Bounded
from dsfit.special import log_normal_mass, truncated_normal_icdf

_LOG_ROOT_2PI = 0.5 * math.log(2 * math.pi)


@dataclass(frozen=True)
class SplitGaussianInclination(BatchFields, LongitudinalDistribution):
    """theta_h from a two-piece normal law on the reachable interval; per radian of theta_i."""

    theta_r: Tensor
    mode: Tensor
    below: Tensor
    above: Tensor
    log_mass: Tensor | None = None
    """Log mass of both pieces together, in units of the density's peak, where it is known already."""

    def _log_mass(self) -> Tensor:
        if self.log_mass is not None:
            return self.log_mass
        _, _, _, left, right = self._masses()
        return torch.logaddexp(left, right)

    def _masses(self) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """L, H, the mode clamped to them, and the log masses of both pieces in units of the density's peak."""
        low, high = reachable(self.theta_r)
        low, high, mode = torch.broadcast_tensors(low, high, self.mode)
        split = torch.minimum(torch.maximum(mode, low), high)
        masses = []
        for start, end, std in ((low, split, self.below), (split, high, self.above)):
            a, b = (start - mode) / std, (end - mode) / std
            empty = end <= start
            mass = log_normal_mass(torch.where(empty, 0.0, a), torch.where(empty, 1.0, b)) + torch.log(std)
            masses.append((mass + _LOG_ROOT_2PI).masked_fill(empty, -math.inf))
        return low, high, split, masses[0], masses[1]

    def log_prob(self, theta_i: Tensor) -> Tensor:
        theta_h = (theta_i + self.theta_r) / 2
        x = theta_h - self.mode
        std = torch.where(x < 0, self.below, self.above)
        return -0.5 * (x / std) ** 2 - self._log_mass() - math.log(2)

    def sample(self, u: Tensor) -> Tensor:
        low, high, split, left, right = self._masses()
        whole = torch.logaddexp(left, right)
        share, rest = torch.exp(left - whole), torch.exp(right - whole)
        on_left = u < share
        tiny = torch.finfo(u.dtype).tiny
        # The upper piece is drawn mirrored, from 1 - u: the tails of both keep all digits of the uniform.
        inner = torch.where(on_left, u / share.clamp_min(tiny), (1 - u) / rest.clamp_min(tiny))
        side = torch.where(on_left, 1.0, -1.0).to(u.dtype)
        std = torch.where(on_left, self.below, self.above)
        start, end = torch.where(on_left, low, -high), torch.where(on_left, split, -split)
        theta_h = side * truncated_normal_icdf(inner.clamp_max(1), side * self.mode, std, start, end)
        return to_theta_i("half", theta_h, self.theta_r)


def with_masses(lobes: Sequence[SplitGaussianInclination]) -> list[SplitGaussianInclination]:
    """The same laws with their masses, found for all of them at once: for few contexts that takes as long as for one.
    """
    names = ("theta_r", "mode", "below", "above")
    flat = torch.broadcast_tensors(*(getattr(lobe, name) for lobe in lobes for name in names))
    columns = (torch.stack(flat[k :: len(names)], dim=-1) for k in range(len(names)))
    masses = SplitGaussianInclination(*columns)._log_mass().unbind(-1)
    return [dataclasses.replace(lobe, log_mass=mass) for lobe, mass in zip(lobes, masses, strict=True)]


class SplitGaussianLobe(Longitudinal):
    """`theta_h` from a two-piece normal law: density ~ exp(-(theta_h - mode)^2 / 2 s^2), s = `below` or `above` the
    mode, on [L, H].

    What multiplies a lobe of the integrand (1/cos^2 theta_diff, Fresnel, a_f^n) tilts it, so that its two flanks
    differ. Truncated, normalised exactly, sampled by inverse CDF; p_theta = p_h / 2.

    Args:
        mode, below, above: radians of theta_h. Bijections: `parameters.Bounded`.

    Raises:
        InputError: a value outside its bounds.
    """

    def __init__(
        self, mode: float | Tensor, below: float | Tensor, above: float | Tensor, *, learnable: bool = True
    ) -> None:
        super().__init__()
        self.mode = Bounded("mode", mode, *MEAN_BOUNDS, learnable=learnable)
        self.below = Bounded("below", below, *STD_BOUNDS, log=True, learnable=learnable)
        self.above = Bounded("above", above, *STD_BOUNDS, log=True, learnable=learnable)

    def forward(self, context: Context) -> SplitGaussianInclination:
        return SplitGaussianInclination(context.theta_r, self.mode(context), self.below(context), self.above(context))


__all__ = ["SplitGaussianInclination", "SplitGaussianLobe", "with_masses"]
