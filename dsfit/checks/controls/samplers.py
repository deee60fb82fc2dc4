"""Single slips of the printed samplers, everything else corrected; `dsfit.proposals.printed` has them as they stand."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from dsfit.checks.chi_square import ChiSquare, chi_square
from dsfit.checks.controls.base import generator_of
from dsfit.context import Context
from dsfit.frame import TWO_PI, cos_inclination, reachable, wrap
from dsfit.proposals.base import Proposal
from dsfit.proposals.inclination import TruncatedGaussianInclination
from dsfit.proposals.printed import PrintedControl
from dsfit.proposals.uniform import inclination_of
from dsfit.special import truncated_normal_icdf, truncated_normal_log_prob

SAMPLES = 50_000


class CorrectedLobe(PrintedControl):
    """theta_h from the Gaussian truncated to what theta_r can reach, theta_i = 2 theta_h - theta_r, phi uniform."""

    def half(self, u: Tensor, theta_r: Tensor) -> Tensor:
        """theta_h by inverse CDF."""
        mean, std = torch.full_like(theta_r, self.alpha), torch.full_like(theta_r, self.beta)
        return truncated_normal_icdf(u, mean, std, *reachable(theta_r))

    def draw(self, u: Tensor, theta_r: Tensor) -> tuple[Tensor, Tensor]:
        return 2 * self.half(u[..., 0], theta_r) - theta_r, TWO_PI * (u[..., 2] - 0.5)

    def claimed(self, theta_i: Tensor, phi: Tensor, theta_r: Tensor) -> Tensor:
        mean, std = torch.full_like(theta_r, self.alpha), torch.full_like(theta_r, self.beta)
        log_theta = TruncatedGaussianInclination(theta_r, mean, std).log_prob(theta_i)
        return log_theta - math.log(TWO_PI) - torch.log(cos_inclination(theta_i))


class MirrorSlip(CorrectedLobe):
    """Eq (19) alone: theta_i = 2 theta_h - theta with theta = theta_h - alpha."""

    equations = "(19)"
    slip = "theta for theta_r"

    def draw(self, u: Tensor, theta_r: Tensor) -> tuple[Tensor, Tensor]:
        half = self.half(u[..., 0], theta_r)
        return 2 * half - (half - self.alpha), TWO_PI * (u[..., 2] - 0.5)


class AngularSlip(CorrectedLobe):
    """Eq (20) alone: g(theta), a density of theta_h, claimed per steradian."""

    equations = "(20)"
    slip = "no Jacobian, no azimuth, no cosine, no truncation"

    def claimed(self, theta_i: Tensor, phi: Tensor, theta_r: Tensor) -> Tensor:
        return self._log_g((theta_i + theta_r) / 2 - self.alpha, self.beta) + 0 * phi


class ClampSlip(CorrectedLobe):
    """The clamp of eq (18) alone, to the right interval; the density keeps its Jacobian but not its truncation."""

    equations = "(18)"
    slip = "clamped where it should be redrawn"

    def half(self, u: Tensor, theta_r: Tensor) -> Tensor:
        low, high = reachable(theta_r)
        return (self.alpha + self.beta * torch.special.ndtri(u)).clamp(low, high)

    def claimed(self, theta_i: Tensor, phi: Tensor, theta_r: Tensor) -> Tensor:
        log_half = self._log_g((theta_i + theta_r) / 2 - self.alpha, self.beta)
        return log_half - math.log(2 * TWO_PI) - torch.log(cos_inclination(theta_i))


class AzimuthSlip(PrintedControl):
    """Uniform inclination, and the azimuth of TT; corrected: Gaussian about pi, truncated to one turn."""

    def draw(self, u: Tensor, theta_r: Tensor) -> tuple[Tensor, Tensor]:
        zero, std = torch.zeros_like(theta_r), torch.full_like(theta_r, self.gamma)
        x = truncated_normal_icdf(u[..., 1], zero, std, zero - math.pi, zero + math.pi)
        return inclination_of(u[..., 0]), wrap(math.pi - x)

    def claimed(self, theta_i: Tensor, phi: Tensor, theta_r: Tensor) -> Tensor:
        zero, std = torch.zeros_like(theta_r), torch.full_like(theta_r, self.gamma)
        x = wrap(math.pi - phi).clamp(-math.pi, math.pi)
        return truncated_normal_log_prob(x, zero, std, zero - math.pi, zero + math.pi) - math.log(2)


class UnwrappedSlip(AzimuthSlip):
    """Eq (21) alone: g(pi - phi) without wrapping the difference."""

    equations = "(21)"
    slip = "pi - phi reaches 2 pi for phi < 0"

    def claimed(self, theta_i: Tensor, phi: Tensor, theta_r: Tensor) -> Tensor:
        return self._log_g(math.pi - phi, self.gamma) - math.log(2)


class MassSlip(AzimuthSlip):
    """Eq (24) alone: the density of the Gaussian on the whole line."""

    equations = "(24)"
    slip = "not normalised over one turn"

    def claimed(self, theta_i: Tensor, phi: Tensor, theta_r: Tensor) -> Tensor:
        return self._log_g(wrap(math.pi - phi), self.gamma) - math.log(2)


class TransmittanceMassSlip(PrintedControl):
    """Eq (33) alone, of the difference angle: cos(theta_diff) / 2, with Jacobian, azimuth and cosine granted."""

    equations = "(33)"
    slip = "normalised over [-pi/2, pi/2], of which theta_r reaches half"

    def draw(self, u: Tensor, theta_r: Tensor) -> tuple[Tensor, Tensor]:
        return theta_r - 2 * torch.asin(2 * u[..., 0] - 1), TWO_PI * (u[..., 1] - 0.5)

    def claimed(self, theta_i: Tensor, phi: Tensor, theta_r: Tensor) -> Tensor:
        cosine = torch.cos((theta_r - theta_i) / 2)
        return torch.log(cosine.clamp_min(1e-30)) - math.log(4 * TWO_PI) - torch.log(cos_inclination(theta_i))


def sampler_test(proposal: Proposal, theta_r: float, seed: int, stream: int = 0) -> ChiSquare:
    """The chi-square test, and the mass, of a sampler at one viewing inclination (phi_r = 0.7)."""
    context = Context(theta_r, 0.7, dtype=torch.float64)
    return chi_square(proposal, context, SAMPLES, generator=generator_of(seed, stream))


def mass_gap(test: ChiSquare) -> float:
    """|mass - 1|, no less than the error of its integration."""
    return max(abs(test.mass - 1), test.mass_error)
