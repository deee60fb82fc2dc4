"""Azimuthal laws with Cauchy tails: about the forward direction (TT), and about the glints of TRT."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from dsfit.bsdf.snell import Caustic, Refraction
from dsfit.context import Context
from dsfit.errors import as_number, as_real, check_range
from dsfit.frame import wrap
from dsfit.proposals.azimuth import CosineHalfLaw
from dsfit.proposals.base import Azimuthal, AzimuthalDistribution

SCALE = math.sqrt(0.5)
"""Scale of the Cauchy law that samples a Gaussian of standard deviation 1 with the least variance: int g^2 / c is
least, 1.2533, at 1/sqrt 2."""


def wrapped_cauchy(u: Tensor, scale: Tensor) -> Tensor:
    """x in (-pi, pi) with density `sinh(s) / (2 pi (cosh(s) - cos x))`: x = 2 atan(tanh(s / 2) tan(pi (u - 1/2)))."""
    angle = math.pi * (u - 0.5)
    return 2 * torch.atan2(torch.tanh(scale / 2) * torch.sin(angle), torch.cos(angle))


def wrapped_cauchy_log_prob(x: Tensor, scale: Tensor) -> Tensor:
    """Its log density; cosh(s) - cos(x) = 2 (sinh^2(s / 2) + sin^2(x / 2)), which does not cancel."""
    spread = torch.sinh(scale / 2) ** 2 + torch.sin(x / 2) ** 2
    return torch.log(torch.sinh(scale)) - torch.log(spread) - math.log(4 * math.pi)


def wrapped_cauchy_window(distance: Tensor, scale: Tensor) -> Tensor:
    """log density after a uniform turn in [-pi/2, pi/2]: the mass within pi/2 of `distance`, over pi, in closed form
    `atan2(sinh s, -cos d) / pi^2`."""
    cosine = torch.cos(distance)
    return torch.log(torch.atan2(torch.sinh(scale).expand_as(cosine), -cosine)) - 2 * math.log(math.pi)


@dataclass(frozen=True)
class WrappedCauchyLaw(AzimuthalDistribution):
    """phi = pi + x wrapped; see `WrappedCauchy`."""

    scale: Tensor

    def select(self, take: Callable[[Tensor], Tensor]) -> WrappedCauchyLaw:
        return self

    def sample(self, u: Tensor, theta_i: Tensor) -> Tensor:
        return wrap(math.pi + wrapped_cauchy(u[..., 0], self.scale))

    def log_prob(self, phi: Tensor, theta_i: Tensor) -> Tensor:
        return wrapped_cauchy_log_prob(math.pi - phi.abs(), self.scale)

    def scattered_log_prob(self, phi: Tensor, theta_i: Tensor) -> Tensor:
        """Log density after a uniform turn by up to +-pi/2."""
        return wrapped_cauchy_window(math.pi - phi.abs(), self.scale)


class WrappedCauchy(Azimuthal):
    """N_TT as a Cauchy law about phi = pi, wrapped on the circle: the analytic TT azimuth of Ou et al. (2012), who
    truncate it instead.

    Args:
        scale: radians, in [1e-4, 10]. `SCALE` times gamma_TT samples a Gaussian of that width best.

    Raises:
        InputError: scale out of range.
    """

    scale: Tensor

    def __init__(self, scale: float) -> None:
        super().__init__()
        self.register_buffer("scale", torch.tensor(as_number("scale", scale, 1e-4, 10.0), dtype=torch.float64))

    def forward(self, context: Context) -> WrappedCauchyLaw:
        return WrappedCauchyLaw(self.scale.to(context.dtype))


@dataclass(frozen=True)
class GlintCosineLaw(AzimuthalDistribution):
    """cos(phi/2) and two glints at +-phi_c(theta_diff); see `GlintCosine`. `theta_r` `[*batch]`."""

    theta_r: Tensor
    eta: Tensor
    scale: Tensor
    share: float

    def select(self, take: Callable[[Tensor], Tensor]) -> GlintCosineLaw:
        return GlintCosineLaw(take(self.theta_r), self.eta, self.scale, self.share)

    def _center(self, theta_i: Tensor) -> Tensor:
        return Caustic.at(Refraction.at(self.eta, 0.5 * (self.theta_r - theta_i)).kappa).phi

    def sample(self, u: Tensor, theta_i: Tensor) -> Tensor:
        signed = 2 * u[..., 0] - 1  # phi is odd in it: the glints from the outer share, cos(phi/2) from the inner
        size, inner = signed.abs(), 1 - self.share
        glint = size >= inner
        rest = torch.where(glint, (size - inner) / self.share, 0.5).clamp(1e-7, 1 - 1e-7)
        at_glint = self._center(theta_i) + wrapped_cauchy(rest, self.scale)
        broad = 2 * torch.asin(torch.where(glint, 0.5, size / inner).clamp_max(1 - 1e-7))
        return wrap(torch.where(signed < 0, -1.0, 1.0).to(u.dtype) * torch.where(glint, at_glint, broad))

    def _blend(self, broad: Tensor, left: Tensor, right: Tensor) -> Tensor:
        glints = torch.logaddexp(left, right) + math.log(0.5 * self.share)
        return torch.logaddexp(broad + math.log1p(-self.share), glints)

    def log_prob(self, phi: Tensor, theta_i: Tensor) -> Tensor:
        center = self._center(theta_i)
        left, right = (wrapped_cauchy_log_prob(phi + side * center, self.scale) for side in (-1, 1))
        return self._blend(CosineHalfLaw().log_prob(phi, theta_i), left, right)

    def scattered_log_prob(self, phi: Tensor, theta_i: Tensor) -> Tensor:
        """Log density after a uniform turn by up to +-pi/2."""
        center = self._center(theta_i)
        left, right = (wrapped_cauchy_window(phi + side * center, self.scale) for side in (-1, 1))
        return self._blend(CosineHalfLaw().scattered_log_prob(phi, theta_i), left, right)


class GlintCosine(Azimuthal):
    """N_TRT as cos(phi/2) with Cauchy glints about the caustic's azimuths +-phi_c(theta_diff) (0 where there is no
    caustic).

    Args:
        eta: refractive index, > 1.
        scale: of the glints, radians, in [1e-4, 10].
        share: of the glints, in (0, 1).

    Raises:
        InputError: an argument out of range.
    """

    eta: Tensor
    scale: Tensor

    def __init__(self, eta: float | Tensor, scale: float, share: float = 0.6) -> None:
        super().__init__()
        self.share = as_number("share", share, 0.0, 1.0, open_low=True, open_high=True)
        value = as_real("eta", eta, torch.float64).detach().clone()
        self.register_buffer("eta", check_range("eta", value, 1.0, open_low=True))
        self.register_buffer("scale", torch.tensor(as_number("scale", scale, 1e-4, 10.0), dtype=torch.float64))

    def forward(self, context: Context) -> GlintCosineLaw:
        return GlintCosineLaw(context.theta_r, self.eta.to(context.dtype), self.scale.to(context.dtype), self.share)
