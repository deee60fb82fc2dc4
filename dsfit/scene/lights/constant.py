"""The same radiance from everywhere: a white furnace when it is 1."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from dsfit.arguments import check_directions, check_uniforms
from dsfit.errors import InputError, as_real, check_range
from dsfit.proposals.base import Proposal
from dsfit.scene.lights.base import Light, LightDistribution, LightProposal


class ConstantLight(Light):
    """L(omega_i) = radiance.

    Args:
        radiance: a number, or one per channel `[C]`; finite and >= 0.

    Raises:
        InputError: radiance is negative, not finite, or has more than one dimension.
    """

    radiance: Tensor

    def __init__(self, radiance: Any = 1.0) -> None:
        super().__init__()
        value = check_range("radiance", torch.atleast_1d(as_real("radiance", radiance)), 0.0)
        if value.dim() != 1 or value.numel() == 0:
            raise InputError("radiance", tuple(value.shape), "a number or a vector [C]")
        self.register_buffer("radiance", value)

    @property
    def channels(self) -> int:  # type: ignore[override]
        return self.radiance.shape[0]

    @property
    def label(self) -> str:
        return "constant"

    def forward(self, omega_i: Tensor) -> Tensor:
        check_directions(omega_i, field="omega_i")
        return self.radiance.to(omega_i).expand(*omega_i.shape[:-1], self.channels)

    def power(self) -> Tensor:
        return 4 * math.pi * self.radiance.mean()

    def covers(self) -> bool:
        return True

    def proposal(self) -> Proposal:
        """Uniform directions, also for a black light."""
        return LightProposal(self, ConstantLightDistribution)


class ConstantLightDistribution(LightDistribution):
    """p = 1 / (4 pi): sin(theta) and phi are uniform."""

    dimension = 2

    def sample(self, u: Tensor) -> Tensor:
        u = check_uniforms(u, self.dimension, self.batch_shape)
        u0, u1 = u[..., 0], u[..., 1]
        # asin(2u - 1) as an arc tangent of square roots, which neither rounds past pi/2 nor loses the poles.
        theta = 2 * torch.atan2(torch.sqrt(u0), torch.sqrt(1 - u0)) - math.pi / 2
        return torch.stack([theta, (2 * u1 - 1) * math.pi], dim=-1)

    def log_prob(self, omega: Tensor) -> Tensor:
        check_directions(omega, self.batch_shape)
        shape = torch.broadcast_shapes(omega.shape[:-1], self.batch_shape)
        return torch.full_like(omega[..., 0], -math.log(4 * math.pi)).expand(shape)
