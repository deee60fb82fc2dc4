"""The scene in which effects are measured, and the BSDF's terms at quadrature nodes, to be put together wrongly."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from dsfit.bsdf.conventions import Convention
from dsfit.bsdf.dual_scattering import DualScattering
from dsfit.bsdf.fiber import Fiber
from dsfit.context import Context
from dsfit.frame import cos_inclination, theta_diff, wrap
from dsfit.quality import quadrature_nodes
from dsfit.scene.integrand import Integrand

DEG = math.pi / 180
THETA_R, N, V = 45 * DEG, 3.0, 0.5
SCENE = "blond hair (σ_a = 0.07), θ_r = 45°, n = 3 scattering fibres, half directly lit (v = 1/2)"
"""For tables."""


@dataclass(frozen=True)
class Terms:
    """F = v (f_s + d_b f_back) + (1 - v) T_f (f_s^G + d_b f_back^G) by its terms, at nodes of quadrature.

    Attributes:
        theta_i, phi: the nodes `[Q]`, radians.
        weight: solid-angle weights times cos(theta_i) `[Q]`.
        single, back, single_scattered, back_scattered, transmittance: `[Q]`.
        d_b, v: numbers.
    """

    theta_i: Tensor
    phi: Tensor
    weight: Tensor
    single: Tensor
    back: Tensor
    single_scattered: Tensor
    back_scattered: Tensor
    transmittance: Tensor
    d_b: float
    v: float

    @property
    def direct(self) -> Tensor:
        """f_s + d_b f_back."""
        return self.single + self.d_b * self.back

    @property
    def scatter(self) -> Tensor:
        """T_f (f_s^G + d_b f_back^G)."""
        return self.transmittance * (self.single_scattered + self.d_b * self.back_scattered)

    @property
    def total(self) -> Tensor:
        """F."""
        return self.v * self.direct + (1 - self.v) * self.scatter

    def integral(self) -> float:
        """int F cos(theta_i) domega_i."""
        return float((self.weight * self.total).sum())


def blond() -> Fiber:
    """The scene's fibre: one channel of the blond preset."""
    return Fiber(sigma_a=(0.07,))


def non_absorbing() -> Fiber:
    """The same fibre without absorption."""
    return Fiber(sigma_a=(0.0,))


@functools.cache
def bsdf() -> DualScattering:
    """The scene's BSDF."""
    return DualScattering(blond(), precision="table")


def integrand() -> Integrand:
    """The scene's integrand, in a furnace."""
    return Integrand(bsdf())


def context(theta_r: float = THETA_R, n: float = N, v: float = V) -> Context:
    """The scene's context, or a variation of it."""
    return Context(theta_r, 0.0, n, v, dtype=torch.float64)


@functools.cache
def nodes(theta_r: float = THETA_R) -> tuple[Tensor, Tensor, Tensor]:
    """theta_i, phi and solid-angle weights, phi >= 0 with doubled weights: the scene is even in azimuth."""
    found = quadrature_nodes(integrand(), context(theta_r), 1e-5, even=True, count=10)
    return found.omega[:, 0], wrap(-found.omega[:, 1]), found.weight


@functools.cache
def terms(theta_r: float = THETA_R, n: float = N, **switches: Any) -> Terms:
    """The scene's terms, with switches of the convention changed."""
    model = bsdf()
    if switches:
        model = model.replace(convention=Convention(**switches), precision="exact")
    theta_i, phi, weight = nodes(theta_r)
    viewer = torch.full_like(theta_i, theta_r)
    angle = theta_i if model.convention.average_angle == "theta_in" else theta_diff(theta_i, viewer)
    variance = n * model.averages(angle).beta_f ** 2
    return Terms(
        theta_i=theta_i,
        phi=phi,
        weight=weight * cos_inclination(theta_i),
        single=model.single(theta_i, viewer, phi)[:, 0],
        back=model.back_scattering(theta_i, viewer, phi)[:, 0],
        single_scattered=model.single_scattered(theta_i, viewer, phi, variance)[:, 0],
        back_scattered=model.back_scattering(theta_i, viewer, phi, variance)[:, 0],
        transmittance=model.transmittance(angle, torch.full_like(theta_i, n))[:, 0],
        d_b=float(model.d_b),
        v=V,
    )


def number(value: float, digits: int = 1, plus: str = "") -> str:
    """A number for tables, with a minus sign for a minus."""
    return f"{value:{plus}.{digits}f}".replace("-", "−")


def ratio(printed: Terms, corrected: Terms | None = None) -> float:
    """Integral of the scene with a printed term over the right one."""
    return printed.integral() / (corrected or terms()).integral()
