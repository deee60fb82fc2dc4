"""Azimuths from offsets over the fibre: the whole family of direct lobes at once, and lobes turned by scattering."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from dsfit.arguments import check_directions, check_uniforms
from dsfit.bsdf.attenuation import Absorption, attenuation
from dsfit.bsdf.snell import Caustic, Rays, Refraction, exit_trt, gamma_tt, rays_trt, rays_tt, root_falling, root_rising
from dsfit.context import Context
from dsfit.frame import HALF_PI, cos_inclination, wrap
from dsfit.proposals.base import Azimuthal, Distribution, LongitudinalDistribution
from dsfit.proposals.offset_azimuth import OffsetAzimuth, OffsetDistribution


def log_or_empty(density: Tensor) -> Tensor:
    """log, -inf where the density is 0."""
    empty = density <= 0
    return torch.log(torch.where(empty, 1.0, density)).masked_fill(empty, -math.inf)


class OffsetFamily(Distribution):
    """R, TT and TRT at once, as d'Eon et al. (2013) choose them: an offset h uniform over the fibre, the lobe in
    proportion to what it lets pass at that offset, theta_i from the lobe, phi from Snell's law at (h, theta_diff).

        p = sum_p p_p(theta_i) sum_{h: phi_p(h) = phi} w_p(h) |dh/dphi| / 2 / cos(theta_i),  w_p = A_p / sum_q A_q

    with A at the specular guess of theta_diff, norms over channels. Exact: w depends on theta_r and h alone.

    Args:
        context: `[*batch]`.
        laws: of theta_i, of R, TT, TRT.
        guess: theta_diff of the attenuations of R, TT, TRT, each `[*batch]`.
        eta, sigma_a: of the fibre, in the dtype of the context. absorption: as the BSDF's.
    """

    dimension = 3

    def __init__(
        self,
        context: Context,
        laws: tuple[LongitudinalDistribution, ...],
        guess: tuple[Tensor, ...],
        eta: Tensor,
        sigma_a: Tensor,
        absorption: Absorption,
    ) -> None:
        self.context, self.laws, self.guess = context, laws, guess
        self.eta, self.sigma_a, self.absorption = eta, sigma_a, absorption
        self.batch_shape = context.batch_shape
        self._bent = tuple(Refraction.at(eta, x) for x in guess)

    def select(self, take: Callable[[Tensor], Tensor]) -> OffsetFamily:
        laws = tuple(law.select(take) for law in self.laws)
        guess = tuple(take(x) for x in self.guess)
        return OffsetFamily(self.context._map(take), laws, guess, self.eta, self.sigma_a, self.absorption)

    def weights(self, sin_gamma: Tensor, cos_gamma: Tensor) -> list[Tensor]:
        """w_p(h) of R, TT, TRT, each `[...]`; they sum to 1."""
        passed = []
        for p, bent in enumerate(self._bent):
            value = attenuation(p, bent, self.sigma_a, sin_gamma, cos_gamma, self.absorption)
            passed.append(torch.linalg.vector_norm(value, dim=-1))
        total = passed[0] + passed[1] + passed[2]
        return [x / total for x in passed]

    def _kappa(self, theta_i: Tensor) -> Tensor:
        return Refraction.at(self.eta, 0.5 * (self.context.theta_r - theta_i)).kappa

    def _density(self, theta_i: Tensor, phi: Tensor) -> Tensor:
        """Per radian of theta_i and of phi."""
        kappa, size = torch.broadcast_tensors(self._kappa(theta_i), phi.abs())
        half = size / 2
        once = Rays(size >= 0, torch.sin(half), torch.cos(half).clamp_min(0.0), torch.cos(half).clamp_min(0.0) / 2)
        total: Tensor | float = 0.0
        branches = ((once,), (rays_tt(kappa, size),), rays_trt(kappa, Caustic.at(kappa), size))
        for p, rays_of_lobe in enumerate(branches):
            azimuth: Tensor | float = 0.0
            for rays in rays_of_lobe:
                share = self.weights(rays.sin_gamma.abs(), rays.cos_gamma)[p]
                azimuth = azimuth + torch.where(rays.lit, share * rays.spread / 2, 0.0)
            total = total + torch.exp(self.laws[p].log_prob(theta_i)) * azimuth
        return torch.as_tensor(total)

    def log_prob(self, omega: Tensor) -> Tensor:
        check_directions(omega, self.batch_shape)
        density = self._density(omega[..., 0], wrap(self.context.phi_r - omega[..., 1]))
        return log_or_empty(density) - torch.log(cos_inclination(omega[..., 0]))

    def sample(self, u: Tensor) -> Tensor:
        u = check_uniforms(u, self.dimension, self.batch_shape)
        eps = torch.finfo(u.dtype).eps
        sin_gamma = (2 * u[..., 1] - 1).clamp(-1 + eps, 1 - eps)
        gamma = torch.asin(sin_gamma)
        reflected, transmitted, _ = self.weights(sin_gamma.abs(), torch.cos(gamma))
        lobe = (u[..., 0] >= reflected).long() + (u[..., 0] >= reflected + transmitted).long()
        drawn = torch.stack(torch.broadcast_tensors(*(law.sample(u[..., 2]) for law in self.laws)), dim=-1)
        theta_i = drawn.gather(-1, lobe.unsqueeze(-1)).squeeze(-1)
        kappa, gamma = torch.broadcast_tensors(self._kappa(theta_i), gamma)
        through = math.pi - 2 * gamma + 2 * torch.asin(kappa * torch.sin(gamma))
        phi = torch.where(lobe == 0, -2 * gamma, torch.where(lobe == 1, through, exit_trt(kappa, gamma)))
        return torch.stack([theta_i, wrap(self.context.phi_r - wrap(phi))], dim=-1)

    def sample_with_log_prob(self, u: Tensor) -> tuple[Tensor, Tensor]:
        omega = self.sample(u)
        return omega, self.log_prob(omega)


@dataclass(frozen=True)
class TurnedOffsetDistribution(OffsetDistribution):
    """phi of a ray at a uniform offset, turned by a uniform angle in [-pi/2, pi/2]: the share of offsets that leave
    within pi/2 of phi, over pi."""

    dimension: int = 2

    def select(self, take: Callable[[Tensor], Tensor]) -> TurnedOffsetDistribution:
        return TurnedOffsetDistribution(take(self.theta_r), self.eta, self.lobe)

    def sample(self, u: Tensor, theta_i: Tensor) -> Tensor:
        return wrap(super().sample(u[..., :1], theta_i) + math.pi * (u[..., 1] - 0.5))

    def log_prob(self, phi: Tensor, theta_i: Tensor) -> Tensor:
        kappa, size = torch.broadcast_tensors(self._kappa(theta_i), phi.abs())
        near = size <= HALF_PI
        total: Tensor | float = 0.0
        # the half circle about phi as two one-sided windows between 0 and psi, or between psi and pi
        for psi in ((HALF_PI - size).abs(), torch.where(near, size + HALF_PI, 3 * HALF_PI - size)):
            inner = {"R": self._inner_r, "TT": self._inner_tt, "TRT": self._inner_trt}[self.lobe](kappa, psi)
            total = total + torch.where(near, inner, 1 - inner)
        return log_or_empty(torch.as_tensor(total) / (2 * math.pi))

    def _inner_r(self, kappa: Tensor, psi: Tensor) -> Tensor:
        """Share of |h| whose |phi| is below psi."""
        return torch.sin(psi / 2)

    def _inner_tt(self, kappa: Tensor, psi: Tensor) -> Tensor:
        lit = psi > 2 * torch.asin(kappa)
        return torch.where(lit, 1 - gamma_tt(kappa, torch.where(lit, psi, math.pi))[0], 0.0)

    def _inner_trt(self, kappa: Tensor, psi: Tensor) -> Tensor:
        caustic = Caustic.at(kappa)
        rising = torch.where(caustic.folded, root_rising(kappa, caustic, psi), 0.0)
        falling, beyond = root_falling(kappa, caustic, psi), root_falling(kappa, caustic, -psi)
        return torch.sin(rising) + torch.sin(beyond) - torch.sin(falling)


class TurnedOffset(Azimuthal):
    """N^G of a lobe from offsets: `OffsetAzimuth`, then a uniform turn in [-pi/2, pi/2]; the density is the measure of
    the offsets that could have led there, in closed form but for the roots of TRT.

    Args:
        lobe: "R", "TT" or "TRT".
        eta: refractive index, > 1.

    Raises:
        InputError: another lobe, or eta <= 1.
    """

    dimension = 2

    def __init__(self, lobe: str, eta: float | Tensor) -> None:
        super().__init__()
        self.plain = OffsetAzimuth(lobe, eta)

    def forward(self, context: Context) -> TurnedOffsetDistribution:
        law = self.plain(context)
        return TurnedOffsetDistribution(law.theta_r, law.eta, law.lobe)
