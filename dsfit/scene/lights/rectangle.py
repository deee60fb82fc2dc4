"""A glowing rectangle at a finite distance."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from dsfit.arguments import check_directions, check_uniforms
from dsfit.context import Context
from dsfit.errors import InputError
from dsfit.proposals.base import Proposal
from dsfit.scene.lights.base import LightDistribution, LightProposal
from dsfit.scene.lights.nearby import NearbyLight, check_length, check_radiance, check_vector
from dsfit.scene.lights.outlines import Outline, segment
from dsfit.scene.lights.spherical_rectangle import SphericalRectangle

_SPHERE = -math.log(4 * math.pi)


class RectangleLight(NearbyLight):
    """Radiance L from every point of a rectangle, to the side of `edge_u x edge_v` or to both.

    Its solid angle is sampled uniformly, however small, far away or edge-on it is. Points in its plane see nothing of
    it, and one-sided rectangles are black from behind; there the proposal is the uniform sphere, or the rectangle.

    Args:
        corner: `[3]`, in world coordinates.
        edge_u, edge_v: sides from the corner, `[3]`, at right angles to 1e-6 of their lengths.
        radiance: L, a number or `[C]`, finite and >= 0.
        two_sided: whether it also shines to the side of `edge_v x edge_u`.
        rotation, position: see `NearbyLight`.

    Raises:
        InputError: an argument is out of range, or the sides are not at right angles.
    """

    corner: Tensor
    axes: Tensor
    sides: Tensor
    radiance: Tensor

    def __init__(
        self, corner: Any, edge_u: Any, edge_v: Any, radiance: Any = 1.0, two_sided: bool = False, *,
        rotation: Any = None, position: Any = None,
    ) -> None:  # fmt: skip
        super().__init__(rotation, position)
        u, v = check_vector("edge_u", edge_u), check_vector("edge_v", edge_v)
        sides = torch.stack([check_length(f"length of {n}", e.norm()) for n, e in (("edge_u", u), ("edge_v", v))])
        x = u / sides[0]
        slant = (v * x).sum()
        if abs(float(slant.detach())) > 1e-6 * float(sides[1].detach()):
            raise InputError("edge_v", v.tolist(), "a vector at right angles to edge_u")
        y = v - slant * x
        y = y / y.norm()
        if not isinstance(two_sided, bool):
            raise InputError("two_sided", two_sided, "true or false")
        self.two_sided = two_sided
        self.register_buffer("corner", check_vector("corner", corner))
        self.register_buffer("axes", torch.stack([x, y, torch.linalg.cross(x, y)]))
        self.register_buffer("sides", sides)
        self.register_buffer("radiance", check_radiance(radiance))

    @property
    def channels(self) -> int:  # type: ignore[override]
        return self.radiance.shape[0]

    @property
    def label(self) -> str:
        return "rectangle light"

    def seen_rectangle(self) -> tuple[SphericalRectangle, Tensor]:
        """The rectangle as it is seen, and from where it is bright, `[*batch]`."""
        towards = (self.corner if self.position is None else self.corner - self.position).to(torch.float64)
        axes = self.axes.to(torch.float64)
        x0, y0, z0 = ((towards * axis).sum(-1) for axis in axes)
        side = torch.where(z0 < 0, -1.0, 1.0).to(z0)
        x, y, z = (self.to_fibre(axis.expand_as(towards)) for axis in axes)
        sides = self.sides.to(torch.float64)
        found = SphericalRectangle((x, y, z * side[..., None]), x0, y0, sides[0], sides[1], z0.abs())
        return found, found.visible & ((z0 < 0) | self.two_sided)

    def forward(self, omega_i: Tensor) -> Tensor:
        check_directions(omega_i, field="omega_i")
        rectangle, bright = self.seen_rectangle()
        lit = rectangle.contains(omega_i) & bright
        return torch.where(lit.unsqueeze(-1), self.radiance.to(omega_i), 0.0)

    def _outline(self) -> Outline:
        """Its four sides, from the only point."""
        self.single_frame()
        rectangle, bright = self.seen_rectangle()
        if not bool(bright):
            return Outline([])
        x, y, z = (axis.detach().cpu() for axis in rectangle.axes)
        low = rectangle.x0.detach().cpu(), rectangle.y0.detach().cpu()
        high = low[0] + rectangle.width.detach().cpu(), low[1] + rectangle.height.detach().cpu()
        ends = ((low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1]))
        corners = [a * x + b * y + rectangle.distance.detach().cpu() * z for a, b in ends]
        return Outline([[segment(corners[k], corners[(k + 1) % 4]) for k in range(4)]])

    def breakpoints(self) -> tuple[list[float], list[float]]:
        """Inclinations where the edge turns or has a corner; azimuths between which the light lies."""
        return self._outline().breakpoints()

    def azimuth_edges(self, theta_i: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The rectangle's edge."""
        return self._outline().azimuth_edges(theta_i)

    def power(self) -> Tensor:
        rectangle, bright = self.seen_rectangle()
        return torch.where(bright, rectangle.solid_angle * self.radiance.mean(), 0.0)

    def proposal(self) -> Proposal:
        """Uniform in the rectangle's solid angle; two uniforms."""
        return LightProposal(self, RectangleDistribution)


class RectangleDistribution(LightDistribution):
    """p = 1 / solid angle on the rectangle, 0 beside it; 1 / (4 pi) everywhere for points in its plane.

    Uniforms: along edge_u, along edge_v.
    """

    dimension = 2

    def __init__(self, light: RectangleLight, context: Context) -> None:
        super().__init__(light, context)
        self.rectangle, _ = light.seen_rectangle()
        visible = self.rectangle.visible
        solid = torch.where(visible, self.rectangle.solid_angle, 1.0)
        self._log_density = torch.where(visible, -torch.log(solid), _SPHERE)
        self._visible, self._all = visible, bool(visible.all())

    def sample(self, u: Tensor) -> Tensor:
        u = check_uniforms(u, self.dimension, self.batch_shape)
        omega = self.rectangle.sample(u)
        return omega if self._all else torch.where(self._visible[..., None], omega, sphere(u))

    def sample_with_log_prob(self, u: Tensor) -> tuple[Tensor, Tensor]:
        omega = self.sample(u)  # every one of them is inside
        return omega, self._log_density.to(u).expand(omega.shape[:-1])

    def log_prob(self, omega: Tensor) -> Tensor:
        check_directions(omega, self.batch_shape)
        inside = self.rectangle.contains(omega)
        inside = inside if self._all else inside | ~self._visible
        return torch.where(inside, self._log_density.to(omega), -math.inf)


def sphere(u: Tensor) -> Tensor:
    """Uniform directions `[..., 2]` from uniforms `[..., 2]`."""
    u0, u1 = u[..., 0], u[..., 1]
    theta = 2 * torch.atan2(torch.sqrt(u0), torch.sqrt(1 - u0)) - math.pi / 2
    return torch.stack([theta, (2 * u1 - 1) * math.pi], dim=-1)
