"""Any distribution as a proposal: `torch.distributions`, zuko flows, or a pair of functions."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import logsigmoid

from dsfit.arguments import check_directions, check_uniforms
from dsfit.context import Context
from dsfit.errors import InputError, check_choice
from dsfit.frame import HALF_PI, cos_inclination, to_angles, to_vector, wrap
from dsfit.proposals.base import Distribution, Proposal
from dsfit.proposals.uniform import inclination_of

SPACES = ("angles", "vector", "square", "plane")


def to_omega(space: str, x: Tensor, phi_r: Tensor) -> Tensor:
    """A point of the space to omega_i; see `FromDensity`."""
    if space == "vector":
        return _turn(to_angles(x), phi_r)
    if space == "square":
        return _turn(torch.stack([inclination_of(x[..., 0]), 2 * math.pi * (x[..., 1] - 0.5)], dim=-1), phi_r)
    if space == "plane":
        return to_omega("square", torch.sigmoid(x), phi_r)
    return _turn(x, phi_r)


def from_omega(space: str, omega: Tensor, phi_r: Tensor) -> tuple[Tensor, Tensor]:
    """omega_i to a point of the space, and log |d point / d solid angle|."""
    angles = _turn(omega, phi_r)
    theta, phi = angles.unbind(-1)
    if space == "vector":
        return to_vector(angles), torch.zeros_like(theta)
    if space == "angles":
        return angles, -torch.log(cos_inclination(theta))
    # Kept off the edges by half an ulp, so that logarithms stay finite.
    eps = torch.finfo(theta.dtype).eps / 2
    square = torch.stack([(torch.sin(theta) + 1) / 2, phi / (2 * math.pi) + 0.5], dim=-1).clamp(eps, 1 - eps)
    log_area = torch.full_like(theta, -math.log(4 * math.pi))
    if space == "square":
        return square, log_area
    x = torch.logit(square)
    return x, log_area - (logsigmoid(x) + logsigmoid(-x)).sum(dim=-1)


def _turn(angles: Tensor, phi_r: Tensor) -> Tensor:
    """(theta, phi_i) to (theta, phi = wrap(phi_r - phi_i)) and back: the map is its own inverse."""
    theta, phi = torch.broadcast_tensors(angles[..., 0], wrap(phi_r - angles[..., 1]))
    return torch.stack([theta, phi], dim=-1)


class DensityDistribution(Distribution):
    """Distribution over omega_i from functions over a space; see `FromDensity`."""

    def __init__(
        self,
        context: Context,
        space: str,
        dimension: int,
        log_prob: Callable[[Tensor], Tensor],
        sample: Callable[[Tensor], Tensor],
    ) -> None:
        self.context, self.space, self.dimension = context, space, dimension
        self.batch_shape = context.batch_shape
        self._log_prob, self._sample = log_prob, sample

    def sample_with_log_prob(self, u: Tensor) -> tuple[Tensor, Tensor]:
        omega = self.sample(u)
        return omega, self.log_prob(omega)

    def sample(self, u: Tensor) -> Tensor:
        u = check_uniforms(u, self.dimension, self.batch_shape)
        return to_omega(self.space, self._sample(u).to(self.context.dtype), self.context.phi_r)

    def log_prob(self, omega: Tensor) -> Tensor:
        check_directions(omega, self.batch_shape)
        point, log_scale = from_omega(self.space, omega, self.context.phi_r)
        inside = omega[..., 0].abs() <= HALF_PI * (1 + 4 * torch.finfo(omega.dtype).eps)
        return torch.where(inside, self._log_prob(point).to(self.context.dtype) + log_scale, -math.inf)


class FromDensity(Proposal):
    """A proposal from two functions of the context: a density over some space, and a map from uniforms to that space.

    | space | a point is | its density is per |
    |---|---|---|
    | `angles` | (theta_i, phi), phi the relative azimuth in [-pi, pi] | radian squared |
    | `vector` | unit vector (tangent, normal, binormal) whose azimuth is phi | steradian |
    | `square` | (s, t) in the unit square: sin theta_i = 2 s - 1, phi = 2 pi (t - 1/2) | unit of area |
    | `plane` | the logits of such an (s, t): all of R^2, for flows | unit of area |

    Args:
        log_prob: `(context, point [..., d]) -> [...]`, normalised over the space. Mass outside the ranges above is
            lost.
        sample: `(context, u [..., dimension]) -> point [..., d]`, distributed with that density.
        dimension: how many uniforms `sample` takes.
        space: see the table.

    Raises:
        InputError: another space, or dimension < 1.
    """

    def __init__(
        self,
        log_prob: Callable[[Context, Tensor], Tensor],
        sample: Callable[[Context, Tensor], Tensor],
        dimension: int = 2,
        space: str = "angles",
    ) -> None:
        super().__init__()
        self.space = check_choice("space", space, SPACES)
        if dimension < 1:
            raise InputError("dimension", dimension, "integers >= 1")
        self.log_prob, self.sample, self.dimension = log_prob, sample, dimension

    def forward(self, context: Context) -> DensityDistribution:
        return DensityDistribution(
            context,
            self.space,
            self.dimension,
            lambda point: self.log_prob(context, point),
            lambda u: self.sample(context, u),
        )


def uniforms_to_points(distribution: Any, u: Tensor) -> Tensor:
    """Samples of a `torch.distributions` object (or a zuko flow) by inverse CDF, instead of from the global generator.

    Works where the distribution has `icdf`, for `Independent` of such, for transformed distributions over such, and
    for flows with `base` and `transform`.

    Raises:
        InputError: the distribution has no inverse CDF.
    """
    if isinstance(distribution, torch.distributions.Independent):
        return uniforms_to_points(distribution.base_dist, u)
    if isinstance(distribution, torch.distributions.TransformedDistribution):
        x = uniforms_to_points(distribution.base_dist, u)
        for transform in distribution.transforms:
            x = transform(x)
        return x
    if hasattr(distribution, "base") and hasattr(distribution, "transform"):
        return distribution.transform.inv(uniforms_to_points(distribution.base, u))
    nested = getattr(distribution, "base", None)  # zuko's DiagNormal keeps its factors there
    try:
        return (distribution if nested is None else nested).icdf(u)
    except (NotImplementedError, AttributeError) as error:
        allowed = "distributions with icdf, transforms of such, or an explicit `sample` function"
        raise InputError("distribution", type(distribution).__name__, allowed) from error


class TorchDistribution(Proposal):
    """A `torch.distributions`-like object as a proposal.

    Args:
        distribution: the object (event shape `[2]`, or `[3]` for unit vectors), or a callable or `nn.Module` that
            returns one for a `Context`. Parameters of a module are learned.
        space: where it lives, see `FromDensity`.
        sample: `(distribution, u) -> point`; left out, by inverse CDF (`uniforms_to_points`).
        dimension: how many uniforms a sample takes.

    Raises:
        InputError: another space, or (on sampling) a distribution without an inverse CDF.
    """

    def __init__(
        self,
        distribution: Any,
        space: str = "angles",
        sample: Callable[[Any, Tensor], Tensor] | None = None,
        dimension: int = 2,
    ) -> None:
        super().__init__()
        self.space = check_choice("space", space, SPACES)
        self.distribution, self.dimension = distribution, dimension
        self._sampler = sample or uniforms_to_points

    def forward(self, context: Context) -> DensityDistribution:
        distribution = self.distribution
        if not hasattr(distribution, "log_prob"):
            distribution = distribution(context)
        return DensityDistribution(
            context, self.space, self.dimension, distribution.log_prob, lambda u: self._sampler(distribution, u)
        )
