"""The chapter's samplers as printed, each with the density it claims: negative controls that every check must reject.

`PRINTED` maps a name to a class; each class names the equations and the slip. They have the interface of any
proposal, so they can be put wherever a proposal can, which is the point: chi-square tests, normalisation by
quadrature and consistency tests of an estimate have to find them. Never use them for anything else.

Directions that leave |theta_i| <= pi/2 are taken as the unit vector they describe, as a renderer would.
"""

from __future__ import annotations

import math
from typing import ClassVar

import torch
from torch import Tensor

from dsfit.context import Context
from dsfit.frame import HALF_PI, TWO_PI, cos_inclination, to_angles, wrap
from dsfit.proposals.base import Distribution, Proposal
from dsfit.proposals.uniform import inclination_of
from dsfit.special import log_gauss


def box_muller(u1: Tensor, u2: Tensor) -> Tensor:
    """Chapter eq (13)."""
    return torch.sqrt(-2 * torch.log(u1)) * torch.cos(TWO_PI * u2)


def cosine_cdf(phi: Tensor) -> Tensor:
    """The CDF printed before (31), of the density (30): it ends at 4."""
    return 2 * (torch.sin(phi / 2) + 1)


def transmittance_cdf(theta_d: Tensor) -> Tensor:
    """Chapter eq (34), the CDF of the density (33): it ends at 2."""
    return 1 + torch.sin(theta_d)


class PrintedDistribution(Distribution):
    """Sampler and claimed density of a control, for one batch of contexts."""

    dimension = 3

    def __init__(self, control: PrintedControl, context: Context) -> None:
        self.control, self.context, self.batch_shape = control, context, context.batch_shape

    def sample(self, u: Tensor) -> Tensor:
        theta, phi = torch.broadcast_tensors(*self.control.draw(u, self.context.theta_r))
        raw = torch.stack(
            [torch.sin(theta), torch.cos(theta) * torch.cos(phi), torch.cos(theta) * torch.sin(phi)], dim=-1
        )
        theta, phi = to_angles(raw).unbind(-1)
        return torch.stack([theta, wrap(self.context.phi_r - phi)], dim=-1)

    def sample_with_log_prob(self, u: Tensor) -> tuple[Tensor, Tensor]:
        omega = self.sample(u)
        return omega, self.log_prob(omega)

    def log_prob(self, omega: Tensor) -> Tensor:
        phi = wrap(self.context.phi_r - omega[..., 1])
        return self.control.claimed(omega[..., 0], phi, self.context.theta_r)


class PrintedControl(Proposal):
    """A sampler with a slip. Widths and shifts are radians; defaults are those of the presets.

    Args:
        alpha, beta: shift and width of the longitudinal lobe (theta_h), where the control has one.
        gamma: width of the azimuthal Gaussian of TT; the chapter prints the longitudinal width beta_TT here.
    """

    equations: ClassVar[str]
    slip: ClassVar[str]

    def __init__(self, alpha: float = math.radians(-7.5), beta: float = math.radians(7.5), gamma: float = 2.0) -> None:
        super().__init__()
        self.alpha, self.beta, self.gamma = float(alpha), float(beta), float(gamma)

    def forward(self, context: Context) -> PrintedDistribution:
        return PrintedDistribution(self, context)

    def draw(self, u: Tensor, theta_r: Tensor) -> tuple[Tensor, Tensor]:
        """theta_i and the relative azimuth phi from three uniforms; here a uniform direction."""
        return inclination_of(u[..., 0]), TWO_PI * (u[..., 1] - 0.5)

    def claimed(self, theta_i: Tensor, phi: Tensor, theta_r: Tensor) -> Tensor:
        """Log of the density that goes with it, per steradian."""
        raise NotImplementedError

    def _clamped(self, u: Tensor, theta_r: Tensor) -> Tensor:
        """theta of eqs (16)-(18): Box-Muller, clamped to `pi/2 - |theta_r/2 - alpha|`."""
        limit = HALF_PI - (theta_r / 2 - self.alpha).abs()
        return (self.beta * box_muller(u[..., 0], u[..., 1])).clamp(-limit, limit)

    def _log_g(self, x: Tensor, std: float) -> Tensor:
        return log_gauss(x, torch.full_like(x, std))


class LobeAsPrinted(PrintedControl):
    """M_X literally: `theta_i = 2 theta_h - theta` and pdf g(theta), nothing else."""

    equations = "(16)-(20)"
    slip = "theta_i = 2 theta_h - theta does not depend on theta_r, and g(theta) is no density per steradian"

    def draw(self, u: Tensor, theta_r: Tensor) -> tuple[Tensor, Tensor]:
        theta = self._clamped(u, theta_r)
        return 2 * (theta + self.alpha) - theta, TWO_PI * (u[..., 2] - 0.5)

    def claimed(self, theta_i: Tensor, phi: Tensor, theta_r: Tensor) -> Tensor:
        return self._log_g(theta_i - 2 * self.alpha, self.beta)


class LobeWithoutJacobian(PrintedControl):
    """M_X with the text's `theta_i = 2 theta_h - theta_r` and the right azimuth, but pdf g(theta) in theta_i."""

    equations = "(16)-(18), (20)"
    slip = "d theta_i = 2 d theta_h is missing from the density, and so is its truncation"

    def draw(self, u: Tensor, theta_r: Tensor) -> tuple[Tensor, Tensor]:
        return 2 * (self._clamped(u, theta_r) + self.alpha) - theta_r, TWO_PI * (u[..., 2] - 0.5)

    def claimed(self, theta_i: Tensor, phi: Tensor, theta_r: Tensor) -> Tensor:
        log_h = self._log_g((theta_i + theta_r) / 2 - self.alpha, self.beta)
        return log_h - math.log(TWO_PI) - torch.log(cos_inclination(theta_i))


class LobeClamped(LobeWithoutJacobian):
    """The same with the Jacobian: what is left is the clamp to the wrong interval and the missing normalisation."""

    equations = "(16), (18)"
    slip = "clamped to pi/2 - |theta_r/2 - alpha|, beyond what can be reached: invalid directions, point masses"

    def claimed(self, theta_i: Tensor, phi: Tensor, theta_r: Tensor) -> Tensor:
        return super().claimed(theta_i, phi, theta_r) - math.log(2)


class TransmissionAsPrinted(PrintedControl):
    """TT literally: eqs (16)-(18) with (22)-(23), and the product of (20) and (24) as density of directions."""

    equations = "(16)-(24)"
    slip = "the product of two angular densities is used per steradian: no Jacobian, no cos(theta_i)"

    def draw(self, u: Tensor, theta_r: Tensor) -> tuple[Tensor, Tensor]:
        phi = self.beta * math.sqrt(2) * torch.special.erfinv(2 * u[..., 2] - 1)
        return 2 * (self._clamped(u, theta_r) + self.alpha) - theta_r, math.pi - phi.clamp(-math.pi, math.pi)

    def claimed(self, theta_i: Tensor, phi: Tensor, theta_r: Tensor) -> Tensor:
        log_h = self._log_g((theta_i + theta_r) / 2 - self.alpha, self.beta)
        return log_h + self._log_g(wrap(math.pi - phi), self.beta)


class AzimuthClamped(PrintedControl):
    """Eqs (22)-(24) alone, on a uniform inclination: clamped to [-pi, pi], density of the untruncated Gaussian."""

    equations = "(22)-(24)"
    slip = "clamping puts a point mass at phi = 0, and the density has lost what it took from the tails"

    def draw(self, u: Tensor, theta_r: Tensor) -> tuple[Tensor, Tensor]:
        phi = (self.gamma * box_muller(u[..., 1], u[..., 2])).clamp(-math.pi, math.pi)
        return inclination_of(u[..., 0]), math.pi - phi

    def claimed(self, theta_i: Tensor, phi: Tensor, theta_r: Tensor) -> Tensor:
        return self._log_g(wrap(math.pi - phi), self.gamma) - math.log(2)


class CosineAsPrinted(PrintedControl):
    """Eqs (30), (31) on a uniform inclination."""

    equations = "(30), (31) and the CDF before it"
    slip = "phi = 2 asin(xi/2 - 1) covers [-pi, -pi/3] only: the CDF has lost its factor 1/4"

    def draw(self, u: Tensor, theta_r: Tensor) -> tuple[Tensor, Tensor]:
        return inclination_of(u[..., 0]), 2 * torch.asin(u[..., 1] / 2 - 1)

    def claimed(self, theta_i: Tensor, phi: Tensor, theta_r: Tensor) -> Tensor:
        return torch.log(torch.cos(phi / 2).clamp_min(1e-30)) - math.log(4) - math.log(2)


class TransmittanceAsPrinted(PrintedControl):
    """Eqs (33)-(35) with theta_diff the difference angle; the Jacobian 2, the azimuth and cos(theta_i) are granted."""

    equations = "(33)-(35)"
    slip = (
        "theta_diff = asin(xi - 1) covers [-pi/2, 0] only, and the density is not normalised over what can be reached"
    )

    def draw(self, u: Tensor, theta_r: Tensor) -> tuple[Tensor, Tensor]:
        return theta_r - 2 * torch.asin(u[..., 0] - 1), TWO_PI * (u[..., 1] - 0.5)

    def claimed(self, theta_i: Tensor, phi: Tensor, theta_r: Tensor) -> Tensor:
        cosine = torch.cos((theta_r - theta_i) / 2).clamp_min(1e-30)
        return torch.log(cosine) - math.log(4) - math.log(TWO_PI) - torch.log(cos_inclination(theta_i))


class TransmittanceInclinationAsPrinted(PrintedControl):
    """Eqs (33)-(35) with theta_d read as theta_i, so that the density is that of the uniform sphere."""

    equations = "(33)-(35), theta_d as theta_i"
    slip = "asin(xi - 1) never draws theta_i > 0 and claims half the density it has below"

    def draw(self, u: Tensor, theta_r: Tensor) -> tuple[Tensor, Tensor]:
        return torch.asin(u[..., 0] - 1), TWO_PI * (u[..., 1] - 0.5)

    def claimed(self, theta_i: Tensor, phi: Tensor, theta_r: Tensor) -> Tensor:
        return torch.full_like(theta_i, -math.log(4 * math.pi))


class FrontAsPrinted(PrintedControl):
    """Eq (38) as a density of directions: uniform front hemisphere, pdf 1 / pi."""

    equations = "(38)"
    slip = "1 / pi is a density of phi; per steradian the front hemisphere has 1 / (2 pi)"

    def draw(self, u: Tensor, theta_r: Tensor) -> tuple[Tensor, Tensor]:
        return inclination_of(u[..., 0]), math.pi * (u[..., 1] + 0.5)

    def claimed(self, theta_i: Tensor, phi: Tensor, theta_r: Tensor) -> Tensor:
        return torch.full_like(phi, -math.log(math.pi)).masked_fill(phi.abs() < HALF_PI, -math.inf)


PRINTED: dict[str, type[PrintedControl]] = {
    "lobe_as_printed": LobeAsPrinted,
    "lobe_without_jacobian": LobeWithoutJacobian,
    "lobe_clamped": LobeClamped,
    "transmission_as_printed": TransmissionAsPrinted,
    "azimuth_clamped": AzimuthClamped,
    "cosine_as_printed": CosineAsPrinted,
    "transmittance_as_printed": TransmittanceAsPrinted,
    "transmittance_inclination_as_printed": TransmittanceInclinationAsPrinted,
    "front_as_printed": FrontAsPrinted,
}
"""Name to class; `equations` and `slip` of each say what is printed and what is wrong with it."""
