"""Rectangles as they are seen from points: their solid angle, uniform directions in it, the test for a direction.

Sampling: Urena, Fajardo, King, "An area-preserving parametrization for spherical rectangles", Computer Graphics Forum
32(4), 2013. Their solid angle, a sum of four angles less 2 pi, keeps no digits of a small one; here it is that of two
triangles (Van Oosterom and Strackee, IEEE Trans. Biomed. Eng. 30(2), 1983), which keeps all of them, and where their
inverse has lost its digits it is found by Newton's method on that form.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import torch
from torch import Tensor

from dsfit.frame import to_angles, to_vector
from dsfit.scene.lights.cones import SLACK

_SMALL = 1e-7
"""Solid angle below which the closed inverse has fewer than nine digits left in float64."""
_STEPS = 12


@dataclass(frozen=True)
class SphericalRectangle:
    """A rectangle `[x0, x0 + width] x [y0, y0 + height]` in the plane at a distance from the point, `[*batch]` each.

    Args:
        axes: unit vectors of x, y and z (from the point to the plane), each `[*batch, 3]`, in the fibre frame.
        x0, y0: least coordinates, seen from the foot of the perpendicular; float64.
        width, height: sides, `[]`; float64.
        distance: of the plane, >= 0; float64.
    """

    axes: tuple[Tensor, Tensor, Tensor]
    x0: Tensor
    y0: Tensor
    width: Tensor
    height: Tensor
    distance: Tensor

    @functools.cached_property
    def solid_angle(self) -> Tensor:
        """Solid angle `[*batch]` with full relative accuracy; 0 in the plane."""
        value = self._mass(self.width)
        # nearby, the triangles lose digits along their common side and the four corners do not
        return torch.where(self.visible, torch.where(value > 0.5, self._corner_sum(), value), 0.0)

    @functools.cached_property
    def visible(self) -> Tensor:
        """Whether the point is far enough off the plane to see the rectangle at all, `[*batch]`."""
        reach = self.x0.abs() + self.y0.abs() + self.width + self.height
        return (self.distance > 1e-13 * reach).detach() & (self._mass(self.width) > 1e-35).detach()

    def _corner_sum(self) -> Tensor:
        z = torch.where(self.visible, self.distance, 1.0)

        def term(x: Tensor, y: Tensor) -> Tensor:
            return torch.atan2(x * y, z * torch.sqrt(x * x + y * y + z * z))

        x0, x1, y0, y1 = self.x0, self.x0 + self.width, self.y0, self.y0 + self.height
        return term(x1, y1) - term(x0, y1) - term(x1, y0) + term(x0, y0)

    def _mass(self, width: Tensor) -> Tensor:
        """Solid angle of the part up to `x0 + width`."""
        x0, x1, y0, y1, z = self.x0, self.x0 + width, self.y0, self.y0 + self.height, self.distance
        z2 = z * z
        volume = z * width * self.height
        a, b = torch.sqrt(x0 * x0 + y0 * y0 + z2), torch.sqrt(x1 * x1 + y0 * y0 + z2)
        c, d = torch.sqrt(x1 * x1 + y1 * y1 + z2), torch.sqrt(x0 * x0 + y1 * y1 + z2)
        ab, bc, ac = x0 * x1 + y0 * y0 + z2, x1 * x1 + y0 * y1 + z2, x0 * x1 + y0 * y1 + z2
        cd, ad = x0 * x1 + y1 * y1 + z2, x0 * x0 + y0 * y1 + z2
        first = torch.atan2(volume, a * b * c + ab * c + bc * a + ac * b)
        second = torch.atan2(volume, a * c * d + ac * d + cd * a + ad * c)
        return 2 * (first + second)

    def _slope(self, x: Tensor) -> Tensor:
        """Derivative of the solid angle in its end x."""
        y0, y1 = self.y0, self.y0 + self.height
        square = x * x + self.distance**2
        r0, r1 = torch.sqrt(square + y0 * y0), torch.sqrt(square + y1 * y1)
        same = y0 * y1 > 0
        # y1/r1 - y0/r0 over x^2 + z^2; without cancellation where both have one sign
        both = self.height * (y0 + y1) / (r0 * r1 * torch.where(same, y1 * r0 + y0 * r1, 1.0))
        return self.distance * torch.where(same, both, (y1 / r1 - y0 / r0) / square)

    @functools.cached_property
    def _inverse(self) -> tuple[Tensor, Tensor, Tensor]:
        """b0, b1 and k of the closed inverse."""
        x0, y0, y1, z = self.x0, self.y0, self.y0 + self.height, self.distance
        n0, n2 = -y0 / torch.hypot(y0, z), y1 / torch.hypot(y1, z)
        n3 = -x0 / torch.hypot(x0, z)
        bound = 1 - 1e-16
        angles = torch.acos((-n2 * n3).clamp(-bound, bound)) + torch.acos((-n3 * n0).clamp(-bound, bound))
        return n0, n2, 2 * torch.pi - angles

    def sample(self, u: Tensor) -> Tensor:
        """Uniform directions `[..., 2]` from uniforms `[..., 2]`; where nothing is visible, some direction."""
        x = self._x(u[..., 0].to(torch.float64))
        lower, distance = self.y0.to(u), self.distance.to(u)
        upper = (self.y0 + self.height).to(u)
        x = x.to(u)
        square = x * x + distance * distance
        s0 = lower / torch.sqrt(square + lower * lower)
        s1 = upper / torch.sqrt(square + upper * upper)
        s = s0 + u[..., 1] * (s1 - s0)
        y = s * torch.sqrt(square / ((1 - s) * (1 + s)).clamp_min(torch.finfo(u.dtype).tiny))
        y = torch.minimum(torch.maximum(y, lower), upper)
        parts = zip((x, y, distance), self.axes, strict=True)
        return to_angles(sum(a[..., None] * axis.to(u) for a, axis in parts))

    def _x(self, u: Tensor) -> Tensor:
        """x with the share u of the solid angle below it; float64."""
        low, high = self.x0, self.x0 + self.width
        b0, b1, k = self._inverse
        angle = k + u * self.solid_angle
        # x/z = c / sqrt(1 - c^2) for c = sign(f) / sqrt(f^2 + b0^2), f = (b0 cos(angle) - b1) / sin(angle)
        part, sine = torch.cos(angle) * b0 - b1, torch.sin(angle)
        rest = part * part - (1 - b0 * b0) * sine * sine
        safe = rest > 1e-30
        x = self.distance * sine * torch.sign(part) / torch.sqrt(torch.where(safe, rest, 1.0))
        x = torch.where(safe, x, torch.where(u < 0.5, low, high))
        x = torch.minimum(torch.maximum(x, low), high)
        small = (self.solid_angle < _SMALL) & self.visible
        return self._refined(x, u, small) if bool(small.any()) else x

    def _refined(self, x: Tensor, u: Tensor, where: Tensor) -> Tensor:
        """x where asked, by Newton's method within a bracket, from the share of the width."""
        index = where.expand(x.shape).nonzero(as_tuple=True)

        def take(value: Tensor) -> Tensor:
            return value.expand(x.shape)[index]

        one = SphericalRectangle(
            self.axes, *map(take, (self.x0, self.y0, self.width, self.height, self.distance))
        )  # fmt: skip
        target, whole = u[index] * take(self.solid_angle), one.width
        with torch.no_grad():
            low, high, t = torch.zeros_like(whole), whole, u[index] * whole
            for _ in range(_STEPS):
                gap = one._mass(t) - target
                low, high = torch.where(gap < 0, t, low), torch.where(gap < 0, high, t)
                step = t - gap / one._slope(one.x0 + t).clamp_min(1e-300)
                t = torch.where((step > low) & (step < high), step, (low + high) / 2)
            slope = one._slope(one.x0 + t).clamp_min(1e-300)
        t = t - (one._mass(t) - target) / slope  # a last step, that derivatives see
        found = torch.minimum(torch.maximum(one.x0 + t, one.x0), one.x0 + whole)
        return x.index_put(index, found)

    def contains(self, omega: Tensor) -> Tensor:
        """Whether directions `[..., 2]` meet the rectangle, to the rounding of their angles; never in the plane."""
        w = to_vector(omega).detach()
        eps = SLACK * torch.finfo(omega.dtype).eps
        x, y, z = ((w * axis.detach().to(w)).sum(-1) for axis in self.axes)
        inside = (z >= -eps) & self.visible
        for along, low, side in ((x, self.x0, self.width), (y, self.y0, self.height)):
            for sign, end in ((1.0, low), (-1.0, low + side)):
                # signed distance from the plane through the point and one side
                length = torch.hypot(end, self.distance).clamp_min(1e-300).detach()
                across, down = (self.distance / length).to(w), (end / length).to(w)
                inside = inside & (sign * (along * across - z * down) >= -eps)
        return inside
