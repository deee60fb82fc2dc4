"""A glowing flat ring at a finite distance: a photographer's ring light, or a disc."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from dsfit.arguments import check_directions, check_uniforms
from dsfit.context import Context
from dsfit.errors import InputError, as_real, check_range
from dsfit.proposals.base import Proposal
from dsfit.scene.lights.base import LightDistribution, LightProposal
from dsfit.scene.lights.lobes import orthonormal
from dsfit.scene.lights.nearby import NearbyLight, check_length, check_radiance, check_vector
from dsfit.scene.lights.outlines import Outline, circle
from dsfit.scene.lights.rectangle import sphere
from dsfit.scene.lights.spherical_ring import SphericalRing


class RingLight(NearbyLight):
    """Radiance L from every point of a flat ring, to the side of its normal or to both.

    On the axis, at the height h, its solid angle is `2 pi (h / sqrt(h^2 + inner^2) - h / sqrt(h^2 + outer^2))`. Points
    in its plane see nothing of it, and one-sided rings are black from behind.

    Args:
        center: `[3]`, in world coordinates.
        normal: `[3]`, of any length > 0.
        inner: radius of the hole, in [0, outer); 0 makes a disc.
        outer: radius, in [1e-12, 1e12].
        radiance: L, a number or `[C]`, finite and >= 0.
        two_sided: whether it also shines to the other side.
        rotation, position: see `NearbyLight`.

    Raises:
        InputError: an argument is out of range.
    """

    center: Tensor
    normal: Tensor
    inner: Tensor
    outer: Tensor
    radiance: Tensor

    def __init__(
        self, center: Any, normal: Any, inner: Any, outer: Any, radiance: Any = 1.0, two_sided: bool = False, *,
        rotation: Any = None, position: Any = None,
    ) -> None:  # fmt: skip
        super().__init__(rotation, position)
        axis = check_vector("normal", normal)
        if not bool((axis != 0).any()):
            raise InputError("normal", axis.tolist(), "a vector of length > 0")
        radius = check_length("outer", outer)
        hole = check_range("inner", as_real("inner", inner), 0.0, float(radius.detach()), open_high=True)
        if hole.dim():
            raise InputError("inner", tuple(hole.shape), "a single number")
        if not isinstance(two_sided, bool):
            raise InputError("two_sided", two_sided, "true or false")
        self.two_sided = two_sided
        axis = axis / axis.detach().abs().amax()
        self.register_buffer("center", check_vector("center", center))
        self.register_buffer("normal", axis / axis.norm())
        self.register_buffer("inner", hole)
        self.register_buffer("outer", radius)
        self.register_buffer("radiance", check_radiance(radiance))

    @property
    def channels(self) -> int:  # type: ignore[override]
        return self.radiance.shape[0]

    @property
    def label(self) -> str:
        return "ring light" if float(self.inner) > 0 else "disc light"

    def seen_ring(self) -> tuple[SphericalRing, Tensor]:
        """The ring as it is seen, and from where it is bright, `[*batch]`."""
        towards = (self.center if self.position is None else self.center - self.position).to(torch.float64)
        normal = self.normal.to(torch.float64).expand_as(towards)
        square = towards.square().sum(-1)
        there = square > 0
        distance = torch.sqrt(torch.where(there, square, 1.0))
        axis = torch.where(there[..., None], towards / distance[..., None], normal)
        height = (axis * normal).sum(-1)
        facing = normal * torch.where(height < 0, -1.0, 1.0)[..., None]
        flat = height.abs().clamp(max=1.0)
        inner, outer = self.inner.to(torch.float64), self.outer.to(torch.float64)
        visible = (there & (flat * distance > 1e-13 * (outer + distance))).detach()
        flat = torch.where(visible, flat, 1.0)
        first, second = _frame(axis, facing)
        found = SphericalRing(
            self.to_fibre(axis), self.to_fibre(first), self.to_fibre(second),
            inner / distance, outer / distance, flat, visible,
        )  # fmt: skip
        return found, visible & ((height < 0) | self.two_sided)

    def forward(self, omega_i: Tensor) -> Tensor:
        check_directions(omega_i, field="omega_i")
        ring, bright = self.seen_ring()
        return torch.where((ring.contains(omega_i) & bright).unsqueeze(-1), self.radiance.to(omega_i), 0.0)

    def _outline(self) -> Outline:
        """Its two circles, from the only point."""
        self.single_frame()
        ring, bright = self.seen_ring()
        if not bool(bright):
            return Outline([])
        center = self.seen(self.center.detach()).to(torch.float64).cpu()
        first, second = (self.to_fibre(axis).cpu() for axis in orthonormal(self.normal.detach().to(torch.float64)))
        radii = [float(r) for r in (self.inner, self.outer) if float(r) > 0]
        return Outline([[circle(center.detach(), r * first.detach(), r * second.detach())] for r in radii])

    def breakpoints(self) -> tuple[list[float], list[float]]:
        """Inclinations where the edge turns; azimuths between which the light lies."""
        return self._outline().breakpoints()

    def azimuth_edges(self, theta_i: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The ring's edges."""
        return self._outline().azimuth_edges(theta_i)

    def power(self) -> Tensor:
        """By the solid angle from 17 values, see `SphericalRing`: to a few percent next to the ring, else exact."""
        ring, bright = self.seen_ring()
        return torch.where(bright, ring.rough_angle * self.radiance.mean(), 0.0)

    def proposal(self) -> Proposal:
        """Nearly uniform in the ring's solid angle, with exact density; two uniforms."""
        return LightProposal(self, RingDistribution)


def _frame(axis: Tensor, normal: Tensor) -> tuple[Tensor, Tensor]:
    """Unit vectors across the axis: the first towards the far side of the plane with this normal."""
    second = torch.linalg.cross(normal, axis, dim=-1)
    square = second.square().sum(-1, keepdim=True)
    tilted = square > 1e-30
    other, _ = orthonormal(axis.detach())
    second = torch.where(tilted, second, other) / torch.sqrt(torch.where(tilted, square, 1.0))
    return torch.linalg.cross(second, axis, dim=-1), second


class RingDistribution(LightDistribution):
    """p = p(alpha) / M(alpha) on the ring (see `SphericalRing`); 1 / (4 pi) everywhere for points in its plane.

    Uniforms: around its centre, from it.
    """

    dimension = 2

    def __init__(self, light: RingLight, context: Context) -> None:
        super().__init__(light, context)
        self.ring, _ = light.seen_ring()
        self._visible, self._all = self.ring.visible, bool(self.ring.visible.all())

    def sample(self, u: Tensor) -> Tensor:
        return self.sample_with_log_prob(u)[0]

    def sample_with_log_prob(self, u: Tensor) -> tuple[Tensor, Tensor]:
        u = check_uniforms(u, self.dimension, self.batch_shape)
        omega, log_prob = self.ring.sample(u)  # every one of them is inside
        if self._all:
            return omega, log_prob
        omega = torch.where(self._visible[..., None], omega, sphere(u))
        return omega, torch.where(self._visible, log_prob, -math.log(4 * math.pi))

    def log_prob(self, omega: Tensor) -> Tensor:
        check_directions(omega, self.batch_shape)
        log_prob = self.ring.log_prob(omega)
        return log_prob if self._all else torch.where(self._visible, log_prob, -math.log(4 * math.pi))
