"""The adapted map of VEGAS as a density: piecewise constant in theta_i and in phi, independent of each other."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from dsfit.arguments import check_directions, check_uniforms
from dsfit.context import Context
from dsfit.frame import cos_inclination, wrap
from dsfit.proposals.base import Distribution


class MapDistribution(Distribution):
    """Every increment of the map has the same probability 1 / K on each axis.

    Args:
        context: `[B]`.
        theta, phi: ends of the increments, increasing, `[B, K + 1]`, radians; phi from 0 for maps of |phi|, whose sign
            is drawn with it, else from -pi.
        even: whether phi is |phi|.
    """

    dimension = 2

    def __init__(self, context: Context, theta: Tensor, phi: Tensor, even: bool) -> None:
        self.context, self.theta, self.phi, self.even = context, theta, phi, even
        self.batch_shape = context.batch_shape

    def select(self, take: Callable[[Tensor], Tensor]) -> MapDistribution | None:
        return None

    def sample_with_log_prob(self, u: Tensor) -> tuple[Tensor, Tensor]:
        u = check_uniforms(u, self.dimension, self.batch_shape)
        v = (2 * u[..., 1] - 1).abs() if self.even else u[..., 1]
        theta_i, theta_log = _forward(self.theta, u[..., 0])
        phi, phi_log = _forward(self.phi, v)
        if self.even:
            phi, phi_log = torch.where(u[..., 1] < 0.5, -phi, phi), phi_log - math.log(2)
        omega = torch.stack([theta_i, wrap(self.context.phi_r - phi)], dim=-1)
        return omega, theta_log + phi_log - torch.log(cos_inclination(theta_i))

    def log_prob(self, omega: Tensor) -> Tensor:
        check_directions(omega, self.batch_shape)
        theta_i, phi = omega[..., 0], wrap(self.context.phi_r - omega[..., 1])
        azimuth = _log_density(self.phi, phi.abs()) - math.log(2) if self.even else _log_density(self.phi, phi)
        return _log_density(self.theta, theta_i) + azimuth - torch.log(cos_inclination(theta_i))


def _forward(ends: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    """x `[..., B]` from u, and its log density."""
    count = ends.shape[-1] - 1
    at = u * count
    k = at.long().clamp(0, count - 1)
    rows = torch.arange(len(ends)).expand(k.shape) * (count + 1)
    flat = ends.reshape(-1)
    low, high = flat[rows + k], flat[rows + k + 1]
    return low + (at - k) * (high - low), -torch.log(count * (high - low))


def _log_density(ends: Tensor, x: Tensor) -> Tensor:
    count = ends.shape[-1] - 1
    across = x.reshape(-1, len(ends)).transpose(0, 1).contiguous()
    k = (torch.searchsorted(ends.contiguous(), across, right=True) - 1).clamp(0, count - 1)
    width = ends.gather(1, k + 1) - ends.gather(1, k)
    return -torch.log(count * width).transpose(0, 1).reshape(x.shape)
