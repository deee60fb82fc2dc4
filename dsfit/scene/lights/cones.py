"""Cones of directions: what a sun and a sphere look like. Sampled uniformly, stable from a point to the whole sphere.

A cone holds the directions w within an angle a of an axis m. It is kept as its rise, `h = 1 - cos a = |w - m|^2 / 2` at
its edge: solid angle `2 pi h` and the test for a direction then have no cancellation however narrow it is.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from dsfit.arguments import check_directions, check_uniforms
from dsfit.context import Context
from dsfit.frame import HALF_PI, cos_inclination, to_angles, to_vector
from dsfit.proposals.base import Proposal
from dsfit.scene.lights.base import Light, LightDistribution, LightProposal, tidy
from dsfit.scene.lights.lobes import orthonormal

SLACK = 12
"""A direction's angles lose up to this many units of rounding (eps, in radians) on their way to a vector and back."""


@dataclass(frozen=True)
class Cone:
    """Directions within an angle of an axis.

    Args:
        axis: unit vectors `[*batch, 3]` in the fibre frame.
        rise: 1 - cos(angle), `[*batch]`, in (0, 1], or 2 for the whole sphere.
    """

    axis: Tensor
    rise: Tensor

    def to(self, like: Tensor) -> Cone:
        """The cone in the dtype of a tensor; the rise stays above zero."""
        return Cone(self.axis.to(like), self.rise.to(like).clamp_min(torch.finfo(like.dtype).tiny))

    def contains(self, omega: Tensor) -> Tensor:
        """Whether directions `[..., 2]` lie in the cone. A cone narrower than what the dtype resolves is widened."""
        apart = (to_vector(omega) - self.axis.to(omega)).detach().square().sum(-1)
        return apart <= self._limit(omega)

    def _limit(self, like: Tensor) -> Tensor:
        """Largest |w - m|^2."""
        rise = self.rise.detach().to(like)
        least = (2 * SLACK * torch.finfo(like.dtype).eps) ** 2
        return torch.where(rise > 1.5, 5.0, (2 * rise).clamp_min(least))

    def log_density(self) -> Tensor:
        """log of the uniform density, `-log(2 pi h)`, `[*batch]`."""
        return -torch.log(2 * math.pi * self.rise)

    def sample(self, u: Tensor) -> Tensor:
        """Uniform directions `[..., 2]` from uniforms `[..., 2]`; all of them are in the cone after rounding too."""
        cone = self.to(u)
        # The outermost layer is as thin as rounding: what is drawn there moves inwards by as much.
        inner = torch.sqrt(cone._limit(u)) - SLACK * torch.finfo(u.dtype).eps
        drop = torch.minimum(u[..., 0] * cone.rise, inner.square() / 2)
        sine = torch.sqrt((drop * (2 - drop)).clamp_min(torch.finfo(u.dtype).tiny))
        psi = 2 * math.pi * u[..., 1]
        first, second = self._frame
        a, b, c = 1 - drop, sine * torch.cos(psi), sine * torch.sin(psi)
        axis, first, second = cone.axis, first.to(u), second.to(u)
        vector = a[..., None] * axis + b[..., None] * first + c[..., None] * second
        return to_angles(vector)

    @functools.cached_property
    def _frame(self) -> tuple[Tensor, Tensor]:
        return orthonormal(self.axis)


class ConeLight(Light):
    """A light of one radiance from a cone of directions; subclasses say which cone."""

    radiance: Tensor

    def cone(self) -> Cone:
        """Where the light comes from, in the fibre frame."""
        raise NotImplementedError

    @property
    def channels(self) -> int:  # type: ignore[override]
        return self.radiance.shape[0]

    def forward(self, omega_i: Tensor) -> Tensor:
        check_directions(omega_i, field="omega_i")
        inside = self.cone().contains(omega_i).unsqueeze(-1)
        return torch.where(inside, self.radiance.to(omega_i), 0.0)

    def power(self) -> Tensor:
        return 2 * math.pi * self.cone().rise * self.radiance.mean()

    def covers(self) -> bool:
        return bool((self.cone().rise > 1.5).all())

    def proposal(self) -> Proposal:
        """Uniform in the cone; two uniforms."""
        return LightProposal(self, ConeDistribution)

    def _single(self) -> tuple[float, float, float]:
        """Inclination and azimuth of the axis and the angle of the only cone."""
        self.single_frame()
        cone = self.cone()
        theta, phi = to_angles(cone.axis.detach().to(torch.float64)).tolist()
        return theta, phi, 2 * math.asin(math.sqrt(min(float(cone.rise.detach()) / 2, 1.0)))

    def breakpoints(self) -> tuple[list[float], list[float]]:
        """The axis, and inclinations and azimuths between which the cone lies."""
        theta, phi, angle = self._single()
        if angle > 3:
            return [], []
        # past the pole the cone's edge comes down on the other side
        thetas = [theta, theta - angle, theta + angle, math.pi - theta - angle, angle - math.pi - theta]
        phis = [phi]
        if math.sin(angle) < math.cos(theta):
            spread = math.asin(math.sin(angle) / math.cos(theta))
            phis += [phi - spread, phi + spread]
        return tidy(thetas, phis)

    def azimuth_edges(self, theta_i: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The cone's edge at each inclination: phi_0 +- acos((cos a - sin t sin t_0) / (cos t cos t_0))."""
        theta, phi, angle = self._single()
        if angle > 3 or abs(theta) > HALF_PI - 1e-12:  # the whole sphere, or a cone that turns about the tangent
            return theta_i.new_zeros(0), theta_i.new_zeros(*theta_i.shape, 0), theta_i.new_zeros(0)
        # half-angle form: sin^2(offset / 2) = (sin^2(a / 2) - sin^2((t - t_0) / 2)) / (cos t cos t_0)
        part = math.sin(angle / 2) ** 2 - torch.sin((theta_i - theta) / 2) ** 2
        ratio = part / (cos_inclination(theta_i) * max(math.cos(theta), 1e-300))
        offset = 2 * torch.asin(torch.sqrt(ratio.clamp(0.0, 1.0)))
        sine = math.sin(angle) / math.cos(theta)
        reach = math.asin(sine) if sine < 1 and angle < HALF_PI else math.pi
        return theta_i.new_tensor([phi, phi]), torch.stack([-offset, offset], dim=-1), theta_i.new_tensor([reach] * 2)


class ConeDistribution(LightDistribution):
    """p = 1 / (2 pi h) inside the cone, 0 outside."""

    dimension = 2

    def __init__(self, light: ConeLight, context: Context) -> None:
        super().__init__(light, context)
        self.cone = light.cone()
        self._log_density = self.cone.log_density()

    def sample(self, u: Tensor) -> Tensor:
        return self.cone.sample(check_uniforms(u, self.dimension, self.batch_shape))

    def sample_with_log_prob(self, u: Tensor) -> tuple[Tensor, Tensor]:
        omega = self.sample(u)  # every one of them is inside
        return omega, self._log_density.to(u).expand(omega.shape[:-1])

    def log_prob(self, omega: Tensor) -> Tensor:
        check_directions(omega, self.batch_shape)
        inside = self.cone.contains(omega)
        return torch.where(inside, self._log_density.to(omega), -math.inf)
