"""Uniform laws: the sphere, the front hemisphere (chapter eq (38)), and their factors."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from dsfit.arguments import check_directions, check_uniforms
from dsfit.context import Context
from dsfit.errors import check_choice
from dsfit.frame import HALF_PI, cos_inclination, wrap
from dsfit.proposals.base import (
    Azimuthal,
    AzimuthalDistribution,
    BatchFields,
    Distribution,
    Longitudinal,
    LongitudinalDistribution,
    Product,
    Proposal,
)
from dsfit.proposals.inclination import on_support


def inclination_of(u: Tensor) -> Tensor:
    """theta with density cos(theta) / 2, `asin(2 u - 1)`, by atan2: near the poles asin loses half its digits."""
    return torch.atan2(2 * u - 1, 2 * torch.sqrt(u * (1 - u)))


@dataclass(frozen=True)
class UniformInclinationLaw(BatchFields, LongitudinalDistribution):
    """theta_i of a uniform direction; see `UniformInclination`."""

    def sample(self, u: Tensor) -> Tensor:
        return inclination_of(u)

    def log_prob(self, theta_i: Tensor) -> Tensor:
        return on_support(theta_i, lambda theta: torch.log(cos_inclination(theta)) - math.log(2))


class UniformInclination(Longitudinal):
    """theta_i with density `cos(theta_i) / 2`: uniform per steradian, `theta_i = asin(2 u - 1)`."""

    def forward(self, context: Context) -> UniformInclinationLaw:
        return UniformInclinationLaw()


@dataclass(frozen=True)
class UniformArcLaw(BatchFields, AzimuthalDistribution):
    """phi uniform over the circle ("all"), |phi| > pi/2 ("front") or |phi| < pi/2 ("back")."""

    half: str = "all"

    def sample(self, u: Tensor, theta_i: Tensor) -> Tensor:
        x = u[..., 0] - 0.5
        if self.half == "all":
            return 2 * math.pi * x
        return wrap(math.pi * (x + 1)) if self.half == "front" else math.pi * x

    def log_prob(self, phi: Tensor, theta_i: Tensor) -> Tensor:
        if self.half == "all":
            return torch.full_like(phi, -math.log(2 * math.pi))
        slack = 4 * torch.finfo(phi.dtype).eps  # a sample on the edge must not fall out of its support by rounding
        distance = phi.abs() if self.half == "back" else math.pi - phi.abs()
        return torch.full_like(phi, -math.log(math.pi)).masked_fill(distance > HALF_PI + slack * math.pi, -math.inf)

    def scattered_log_prob(self, phi: Tensor, theta_i: Tensor) -> Tensor:
        """Log density after a uniform turn by up to +-pi/2: uniform, or the triangle of a half circle."""
        if self.half == "all":
            return torch.full_like(phi, -math.log(2 * math.pi))
        overlap = phi.abs() if self.half == "front" else math.pi - phi.abs()
        zero = overlap <= 0
        return torch.where(zero, -math.inf, torch.log(torch.where(zero, 1.0, overlap)) - 2 * math.log(math.pi))


class UniformAzimuth(Azimuthal):
    """phi uniform on the circle, 1 / (2 pi)."""

    def __init__(self, half: str = "all") -> None:
        super().__init__()
        self.half = check_choice("half", half, ("all", "front", "back"))

    def forward(self, context: Context) -> UniformArcLaw:
        return UniformArcLaw(self.half)


class FrontHalf(UniformAzimuth):
    """phi uniform on the forward half |phi| > pi/2, 1 / pi: chapter eq (38)."""

    def __init__(self) -> None:
        super().__init__("front")


class BackHalf(UniformAzimuth):
    """phi uniform on the backward half |phi| < pi/2, 1 / pi."""

    def __init__(self) -> None:
        super().__init__("back")


class UniformSphereDistribution(Distribution):
    """1 / (4 pi) per steradian."""

    dimension = 2

    def __init__(self, context: Context) -> None:
        self.context, self.batch_shape = context, context.batch_shape

    def select(self, take: Callable[[Tensor], Tensor]) -> UniformSphereDistribution:
        return UniformSphereDistribution(self.context._map(take))

    def log_prob(self, omega: Tensor) -> Tensor:
        check_directions(omega, self.batch_shape)
        shape = torch.broadcast_shapes(omega.shape[:-1], self.batch_shape)
        return torch.full_like(omega[..., 0], -math.log(4 * math.pi)).expand(shape)

    def sample_with_log_prob(self, u: Tensor) -> tuple[Tensor, Tensor]:
        u = check_uniforms(u, self.dimension, self.batch_shape)
        omega = torch.stack([inclination_of(u[..., 0]), 2 * math.pi * (u[..., 1] - 0.5)], dim=-1)
        return omega, self.log_prob(omega)


class UniformSphere(Proposal):
    """Uniform over all directions, 1 / (4 pi) per steradian."""

    def forward(self, context: Context) -> UniformSphereDistribution:
        return UniformSphereDistribution(context)


class FrontHemisphere(Product):
    """Uniform over the forward half |phi| > pi/2, 1 / (2 pi) per steradian: chapter eq (38) as a density of directions.

    N^G is positive on the whole circle, so this is biased on its own and needs a partner that covers the back.
    """

    def __init__(self) -> None:
        super().__init__(UniformInclination(), FrontHalf())
