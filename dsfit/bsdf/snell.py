"""Exit azimuths of a circular section by exact Snell refraction, and their inverse.

Everything is written with `kappa = 1 / eta' = cos(theta_diff) / sqrt(eta^2 - sin^2 theta_diff)` in (0, 1 / eta], which
stays finite at grazing, and with the incidence angle gamma on the section (h = sin gamma), sin gamma_t = kappa sin
gamma. For offsets h >= 0:

    R    phi = -2 gamma
    TT   phi = pi - 2 gamma + 2 gamma_t
    TRT  phi = f(gamma) = 4 gamma_t - 2 gamma      (mod 2 pi)

and odd in h. f is concave on [0, pi/2]: f'' = -4 kappa (1 - kappa^2) sin(gamma) / cos^3(gamma_t). For kappa > 1/2 it
rises from 0 to the caustic phi_c at gamma_c and falls to the edge 4 asin(kappa) - pi; for kappa <= 1/2 it falls all
the way.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from dsfit.frame import HALF_PI
from dsfit.special import any_of

_NEWTON_STEPS = 12


@dataclass(frozen=True)
class Refraction:
    """Refraction at an inclination: kappa = 1 / eta', cos(theta_diff), and cos(theta_t) of the refracted inclination.
    """

    eta: Tensor
    cos_diff: Tensor
    kappa: Tensor
    cos_t: Tensor

    @staticmethod
    def at(eta: Tensor, theta_diff: Tensor) -> Refraction:
        """Bravais refraction for light of difference angle theta_diff in a fibre of index eta."""
        cos_diff = torch.cos(theta_diff).clamp_min(torch.finfo(theta_diff.dtype).eps ** 2)
        s = torch.sqrt((eta - 1) * (eta + 1) + cos_diff * cos_diff)
        return Refraction(eta, cos_diff, cos_diff / s, s / eta)

    def map(self, function) -> Refraction:  # noqa: ANN001
        """Apply `function` to every field (a reshape, say)."""
        return Refraction(*(function(x) for x in (self.eta, self.cos_diff, self.kappa, self.cos_t)))


def cos_refracted(kappa: Tensor, sin_gamma: Tensor) -> Tensor:
    """cos(gamma_t) = sqrt(1 - kappa^2 sin^2 gamma) > 0."""
    x = kappa * sin_gamma
    return torch.sqrt((1 - x) * (1 + x))


def exit_trt(kappa: Tensor, gamma: Tensor) -> Tensor:
    """f(gamma) = 4 gamma_t - 2 gamma, the azimuth at which TRT leaves (mod 2 pi)."""
    return 4 * torch.asin(kappa * torch.sin(gamma)) - 2 * gamma


def exit_trt_slope(kappa: Tensor, gamma: Tensor) -> Tensor:
    """f'(gamma) = 4 kappa cos(gamma) / cos(gamma_t) - 2 = 2 ((4 kappa^2 - 1) - 3 kappa^2 sin^2 gamma) / (cos gamma_t (2
    kappa cos gamma + cos gamma_t)), the second form being exact where kappa is near 1/2 and gamma near 0.
    """
    sin_gamma = torch.sin(gamma)
    cos_t = cos_refracted(kappa, sin_gamma)
    top = (2 * kappa - 1) * (2 * kappa + 1) - 3 * (kappa * sin_gamma) ** 2
    return 2 * top / (cos_t * (2 * kappa * torch.cos(gamma) + cos_t))


def gamma_tt(kappa: Tensor, phi: Tensor) -> tuple[Tensor, Tensor]:
    """(sin gamma, cos gamma) of the one TT ray that leaves at |phi| in [2 asin(kappa), pi].

    Closed form sin gamma = cos(phi/2) / r, cos gamma = (sin(phi/2) - kappa) / r, r^2 = 1 + kappa^2 - 2 kappa
    sin(phi/2) (the triangle of the two radii; no root finding). Callers clamp phi into its range first.
    """
    sin_half, cos_half = torch.sin(phi / 2), torch.cos(phi / 2)
    r = torch.sqrt((sin_half - kappa) ** 2 + cos_half * cos_half)
    return cos_half / r, (sin_half - kappa) / r


@dataclass(frozen=True)
class Caustic:
    """Where TRT folds: gamma_c, phi_c (both 0 for kappa <= 1/2), the edge 4 asin(kappa) - pi, and whether there is a
    fold.
    """

    folded: Tensor
    gamma: Tensor
    phi: Tensor
    edge: Tensor

    @staticmethod
    def at(kappa: Tensor) -> Caustic:
        """tan^2 gamma_c = (4 kappa^2 - 1) / (1 - kappa^2), i.e. h_c^2 = (4 - eta'^2)/3."""
        folded = kappa > 0.5
        safe = torch.where(folded, kappa, 0.6)
        opposite = (2 * safe - 1) * (2 * safe + 1)
        adjacent = ((1 - safe) * (1 + safe)).clamp_min(torch.finfo(kappa.dtype).tiny)
        gamma = torch.where(folded, torch.atan2(torch.sqrt(opposite), torch.sqrt(adjacent)), 0.0)
        phi = torch.where(folded, exit_trt(kappa, gamma), 0.0)
        return Caustic(folded, gamma, phi, 4 * torch.asin(kappa) - math.pi)

    def detach(self) -> Caustic:
        """The same values without derivatives."""
        return Caustic(self.folded, self.gamma.detach(), self.phi.detach(), self.edge.detach())


def root_falling(kappa: Tensor, caustic: Caustic, phi: Tensor) -> Tensor:
    """gamma in [gamma_c, pi/2] with f(gamma) = phi, for phi in [edge, phi_c]; out-of-range phi goes to the nearer end.

    Newton from the right of the root of a concave falling function converges monotonically; the start is the least of
    three upper bounds on the root (linear, quadratic at the fold, cubic at kappa = 1/2), so it is good at the fold as
    well.
    """
    whole, limits = kappa, caustic
    with torch.no_grad():
        kappa, caustic = kappa.detach(), caustic.detach()  # forward mode looks through no_grad
        y = torch.minimum(torch.maximum(phi.detach(), caustic.edge), caustic.phi)
        drop = caustic.phi - y
        bend = 4 * kappa * (1 - kappa * kappa)
        tiny = torch.finfo(kappa.dtype).tiny
        fold = bend * torch.sin(caustic.gamma) / cos_refracted(kappa, torch.sin(caustic.gamma)) ** 3
        start = torch.minimum(
            torch.sqrt(2 * drop / fold.clamp_min(tiny)), (3 * math.pi * drop / bend.clamp_min(tiny)) ** (1 / 3)
        )
        start = torch.minimum(start, torch.where(caustic.folded, HALF_PI, drop / (2 - 4 * kappa).clamp_min(tiny)))
        gamma = torch.minimum(caustic.gamma + start, torch.full_like(start, HALF_PI))
        for _ in range(_NEWTON_STEPS):
            slope = exit_trt_slope(kappa, gamma).clamp_max(-torch.finfo(kappa.dtype).eps)
            step = (exit_trt(kappa, gamma) - y) / slope
            gamma = torch.minimum(torch.maximum(gamma - step, caustic.gamma), gamma)
    return _attach(whole, gamma, torch.minimum(torch.maximum(phi, limits.edge), limits.phi))


def root_rising(kappa: Tensor, caustic: Caustic, phi: Tensor) -> Tensor:
    """gamma in [0, gamma_c] with f(gamma) = phi, for phi in [0, phi_c]; meaningful only where the fibre has a
    caustic.
    """
    whole, limits = kappa, caustic
    with torch.no_grad():
        kappa, caustic = kappa.detach(), caustic.detach()  # forward mode looks through no_grad
        y = torch.minimum(phi.detach().clamp_min(0.0), caustic.phi)
        tiny = torch.finfo(kappa.dtype).tiny
        fold = 4 * kappa * (1 - kappa * kappa) * torch.sin(caustic.gamma)
        fold = fold / cos_refracted(kappa, torch.sin(caustic.gamma)) ** 3
        gamma = (caustic.gamma - torch.sqrt(2 * (caustic.phi - y) / fold.clamp_min(tiny))).clamp_min(0.0)
        for _ in range(_NEWTON_STEPS):
            slope = exit_trt_slope(kappa, gamma).clamp_min(torch.finfo(kappa.dtype).eps)
            gamma = torch.minimum((gamma - (exit_trt(kappa, gamma) - y) / slope).clamp_min(0.0), caustic.gamma)
    return _attach(whole, gamma, torch.minimum(phi.clamp_min(0.0), limits.phi))


def _attach(kappa: Tensor, gamma: Tensor, phi: Tensor) -> Tensor:
    """Give a converged root its derivatives by the implicit function theorem: one Newton step with the slope held
    fixed. First derivatives only: second derivatives of what is made of it are not to be used.
    """
    slope = exit_trt_slope(kappa, gamma).detach()
    limit = torch.finfo(kappa.dtype).eps ** 0.5
    slope = torch.where(slope < 0, slope.clamp_max(-limit), slope.clamp_min(limit))
    step = (phi - exit_trt(kappa, gamma)) / slope
    return gamma + (step - step.detach())


@dataclass(frozen=True)
class Rays:
    """The rays of one branch that leave at given azimuths: where there is one, its offset h = sin gamma, and
    |dh/dphi|.
    """

    lit: Tensor
    sin_gamma: Tensor
    cos_gamma: Tensor
    spread: Tensor


def rays_tt(kappa: Tensor, phi: Tensor) -> Rays:
    """TT at |phi|: one ray for |phi| > 2 asin(kappa); |dh/dphi| = cos g cos g_t (kappa cos g + cos g_t)/(2 (1 -
    kappa^2)).
    """
    lit = phi > 2 * torch.asin(kappa)
    sin_gamma, cos_gamma = gamma_tt(kappa, torch.where(lit, phi, math.pi))
    cos_t = cos_refracted(kappa, sin_gamma)
    spread = cos_gamma * cos_t * (kappa * cos_gamma + cos_t) / (2 * (1 - kappa) * (1 + kappa))
    return Rays(lit, sin_gamma, cos_gamma, spread)


def rays_trt(kappa: Tensor, caustic: Caustic, phi: Tensor) -> Iterator[Rays]:
    """TRT at |phi|: up to three rays; two meet at the caustic, where |dh/dphi| is infinite. Unlit branches are left
    out.
    """
    below = phi < caustic.phi
    limit = 4 * torch.finfo(phi.dtype).eps ** 0.5
    for lit, root, azimuth in (
        (caustic.folded & below, root_rising, phi),
        ((phi > caustic.edge) & below, root_falling, phi),
        (-phi > caustic.edge, root_falling, -phi),
    ):
        if not any_of(lit):
            continue
        gamma = root(kappa, caustic, torch.where(lit, azimuth, (caustic.phi + caustic.edge).detach() / 2))
        cos_gamma = torch.cos(gamma).clamp_min(0.0)
        slope = exit_trt_slope(kappa, gamma).abs().clamp_min(limit)
        yield Rays(lit, torch.sin(gamma), cos_gamma, cos_gamma / slope)
