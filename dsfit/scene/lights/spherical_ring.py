"""Flat rings as they are seen from points: nearly uniform directions with an exact density, the test for a direction.

In polar coordinates on the sphere about the direction to the ring's centre, alpha around it and chi from it, the circle
of radius r at the distance 1, seen at the foreshortening k = |cos(angle to the normal)|, is the curve

    tan chi = r k / (w + r s cos alpha),   w^2 = cos^2 alpha + k^2 sin^2 alpha,   s^2 = 1 - k^2,

and a ring holds `cos chi_inner - cos chi_outer` of solid angle per radian of alpha. The angle psi in the ring's own
plane has `tan alpha = tan psi / k`; seen from afar the ring is even in psi, from nearby it is not, and

    pi - psi = 2 atan(kappa tan(pi x / 2)),   x in [-1, 1],

with the ratio kappa of the distances to its nearest and farthest points makes it nearly so: `M(x) = (cos chi_inner -
cos chi_outer) dalpha/dx` varies little. A direction is x by a table of M, then cos chi uniformly between the circles:
density `p(x) / M(x)` per steradian, which is constant but for what a piecewise linear p differs from M.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from dsfit.frame import to_angles, to_vector
from dsfit.scene.lights.cones import SLACK

_KNOTS = 16
"""Intervals of the table of M over x in [0, 1]; M is even."""
_FLOOR = 0.02
"""Share of its mean that is added to the table, so that M / p is bounded."""
_NODES = 64
"""Intervals of the trapezoidal rule for the solid angle."""
HALF_PI = math.pi / 2


@dataclass(frozen=True)
class SphericalRing:
    """A ring in a plane, `[*batch]` each.

    Args:
        axis: unit vector to the centre, `[*batch, 3]`, in the fibre frame.
        first, second: unit vectors that complete the frame; `first` lies in the plane of axis and normal, and points
            to where the ring is farther away.
        inner, outer: radii over the distance of the centre; float64.
        flat: k, in (0, 1]; float64.
        visible: whether the point is off the ring's plane.
    """

    axis: Tensor
    first: Tensor
    second: Tensor
    inner: Tensor
    outer: Tensor
    flat: Tensor
    visible: Tensor

    @functools.cached_property
    def _shape(self) -> _Shape:
        """All that M depends on."""
        slant = torch.sqrt(((1 - self.flat) * (1 + self.flat)).clamp_min(1e-300))
        nearest = torch.minimum(torch.maximum(slant, self.inner), self.outer)
        near, far = torch.hypot(self.flat, slant - nearest), torch.hypot(self.flat, slant + nearest)
        return _Shape(
            self.inner, self.outer, 1 - self.inner * slant, 1 - self.outer * slant, self.flat, slant, near / far
        )

    @functools.cached_property
    def _cones(self) -> tuple[Tensor, ...]:
        """Height, distance and coefficients of the circles' cones; see `_between`."""
        _, _, _, _, h, d, kappa = self._shape
        close = kappa < 0.05
        e = torch.where(close, d, 0.0)
        c = [torch.where(close, (d - r) * (d + r), -r * r) for r in (self.inner, self.outer)]
        # close to the ring, coordinates that are rounded at the scale of its distance blur what is seen
        blur = 4 * torch.finfo(torch.float64).eps / kappa
        return tuple(x.detach() for x in (h, d, torch.where(close, 0.0, d), e, *c, self.inner, self.outer, blur))

    @functools.cached_property
    def _knots(self) -> Tensor:
        """M at the knots of the table, `[*batch, K + 1]`."""
        return self._masses(torch.linspace(0.0, 1.0, _KNOTS + 1, dtype=torch.float64, device=self.flat.device))

    @functools.cached_property
    def rough_angle(self) -> Tensor:
        """The solid angle from the knots of the table alone: good enough to share out samples by."""
        return torch.where(self.visible, _trapezoid(self._knots), 0.0)

    @functools.cached_property
    def table(self) -> tuple[Tensor, Tensor]:
        """Values `[*batch, K + 1]` of the density of |x| per interval at its knots, and its integrals up to them."""
        mass = torch.where(self.visible[..., None], self._knots, 1.0)
        value = mass + _FLOOR * mass.mean(-1, keepdim=True)
        steps = (value[..., 1:] + value[..., :-1]) / 2
        total = steps.sum(-1, keepdim=True)
        edges = torch.cat([torch.zeros_like(total), steps.cumsum(-1) / total], dim=-1)
        return value / total, edges

    @functools.cached_property
    def solid_angle(self) -> Tensor:
        """The ring's solid angle by the trapezoidal rule, `[*batch]`; 0 in the plane. Points farther off than a tenth
        of the radius have ten digits and more, points a thousandth from an edge three."""
        x = torch.linspace(0.0, 1.0, _NODES + 1, dtype=torch.float64, device=self.flat.device)
        return torch.where(self.visible, _trapezoid(self._masses(x)), 0.0)

    def _masses(self, x: Tensor) -> Tensor:
        """M `[*batch, K]` at `x [K]`."""
        shape = self._shape.map(lambda value: value[..., None])
        around = _Around.at(x, shape)
        return (_Between.of(around, shape).mass * around.slope).clamp_min(1e-300)

    def sample(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """Directions `[..., 2]` in the ring from uniforms `[..., 2]`, and their log density."""
        values, edges = (x.to(u) for x in self.table)
        shape = self._shape.map(lambda x: x.to(u))
        turned = 2 * u[..., 0] - 1  # u = 1/2 is the nearest point, so that directions move with u all the way round
        share = turned.abs()
        k = (share[..., None] >= edges[..., 1:-1]).sum(-1)
        low, high, start = (_at(x, i) for x, i in ((values, k), (values, k + 1), (edges, k)))
        part = (share - start).clamp_min(0.0)  # mass within the interval: low t + (high - low) t^2 / 2
        root = torch.sqrt((low * low + 2 * (high - low) * part).clamp_min(torch.finfo(u.dtype).tiny))
        t = (2 * part / (low + root)).clamp(0.0, 1.0)
        around = _Around.at((k + t) / _KNOTS, shape)
        between = _Between.of(around, shape)
        rise, fall = between.at(u[..., 1])
        across = torch.sqrt((rise * fall).clamp_min(torch.finfo(u.dtype).tiny))
        sine = around.sine * torch.where(turned < 0, -1.0, 1.0)
        parts = ((1 - rise, self.axis), (across * around.cosine, self.first), (across * sine, self.second))
        omega = to_angles(sum(a[..., None] * axis.to(u) for a, axis in parts))
        return omega, _log_ratio(low + t * (high - low), between.mass * around.slope)

    def log_prob(self, omega: Tensor) -> Tensor:
        """Log density of `sample`; -inf beside the ring."""
        parts = self._components(omega)
        _, a, b = parts
        away = (a != 0) | (b != 0)
        length = torch.sqrt(torch.where(away, a * a + b * b, 1.0))
        cosine, sine = torch.where(away, a / length, 1.0), b / length  # of alpha
        values, _ = (x.to(omega) for x in self.table)
        shape = self._shape.map(lambda x: x.to(omega))
        around = _Around.of(cosine, sine, shape)
        place = around.x * _KNOTS
        k = place.detach().long().clamp(0, _KNOTS - 1)
        low, high = _at(values, k), _at(values, k + 1)
        mass = _Between.of(around, shape).mass * around.slope
        log_density = _log_ratio(low + (place - k) * (high - low), mass)
        return torch.where(self._between(*parts), log_density, -math.inf)

    def contains(self, omega: Tensor) -> Tensor:
        """Whether directions `[..., 2]` meet the ring, to the rounding of their angles; never in the plane."""
        return self._between(*self._components(omega)) & self.visible

    def _components(self, omega: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Directions along axis, first and second."""
        w = to_vector(omega)
        along, a, b = ((w * x.to(w)).sum(-1) for x in (self.axis, self.first, self.second))
        return along, a, b

    def _between(self, along: Tensor, a: Tensor, b: Tensor) -> Tensor:
        """Both circles' cones, `g = |(x, y) h - (d, 0) z|^2 - r^2 z^2`, in the frame of the plane: z along its normal,
        at the height h and the distance d from the centre. For points close to the ring g is expanded about their foot,
        whose coordinates are small there; for others about the centre."""
        eps = SLACK * torch.finfo(along.dtype).eps
        along, a, b = along.detach(), a.detach(), b.detach()
        h, d, shift, e, near, far, inner, outer, blur = (x.to(along) for x in self._cones)
        eps = eps + blur
        x, z = d * along + h * a, h * along - d * a
        across, y = x * h - shift * z, b * h
        square = across * across + y * y - 2 * e * across * z
        slide = across - e * z
        inside = z >= -eps
        for r, c, sign in ((inner, near, 1.0), (outer, far, -1.0)):
            # eps at right angles to the cone: the gradient's length times eps, and the next order at its apex
            slope = torch.sqrt(h * h * (slide * slide + y * y) + (slide * d + r * r * z) ** 2)
            slack = 2 * eps * slope + eps * eps * (1 + r * r)
            inside = inside & (sign * (square + c * z * z) >= -slack)
        return inside


class _Shape(NamedTuple):
    """Radii over the distance of the centre, `1 - radius s` of both, k, s and kappa."""

    inner: Tensor
    outer: Tensor
    inner_rest: Tensor
    outer_rest: Tensor
    flat: Tensor
    slant: Tensor
    kappa: Tensor

    def map(self, function: Callable[[Tensor], Tensor]) -> _Shape:
        return _Shape(*map(function, self))


class _Around(NamedTuple):
    """A place on the circles: x, cos and sin of alpha, |dalpha/dx|, q^2 = k^2 cos^2 psi + sin^2 psi, and sin^2 of half
    the angle in the plane from the nearest point."""

    x: Tensor
    cosine: Tensor
    sine: Tensor
    slope: Tensor
    q: Tensor
    half: Tensor

    @staticmethod
    def at(x: Tensor, shape: _Shape) -> _Around:
        """The place of x in [0, 1]."""
        flat, kappa = shape.flat, shape.kappa
        a, b = torch.cos(HALF_PI * x), kappa * torch.sin(HALF_PI * x)
        square = a * a + b * b  # of cos and sin of half the angle from the nearest point, before they are normalised
        cosine, sine = (b - a) * (b + a) / square, 2 * a * b / square  # of psi
        q = torch.sqrt(((flat * cosine) ** 2 + sine * sine).clamp_min(torch.finfo(square.dtype).tiny))
        # kappa^2 cos^2 + sin^2 of the half angle is kappa^2 / square
        slope = flat / (q * q) * (math.pi * kappa) / square
        return _Around(x, flat * cosine / q, sine / q, slope, q, b * b / square)

    @staticmethod
    def of(cosine: Tensor, sine: Tensor, shape: _Shape) -> _Around:
        """The place of alpha."""
        flat, kappa = shape.flat, shape.kappa
        w = torch.sqrt((cosine * cosine + (flat * sine) ** 2).clamp_min(torch.finfo(cosine.dtype).tiny))
        psi = cosine / w
        ahead = psi < 0
        # tan of half the angle from the nearest point, or its inverse, whichever is below 1
        ratio = flat * sine.abs() / w / (1 + psi.abs())
        one = torch.ones_like(ratio)
        x = torch.atan2(torch.where(ahead, ratio, one), kappa * torch.where(ahead, one, ratio)) / HALF_PI
        half = ratio * ratio / (1 + ratio * ratio)
        half = torch.where(ahead, half, 1 - half)
        slope = w * w / flat * (math.pi / kappa) * (kappa * kappa * (1 - half) + half)
        return _Around(x, cosine, sine, slope, flat / w, half)


@dataclass(frozen=True)
class _Between:
    """What lies between two circles at alpha: 1 - cos(chi) and 1 + cos(chi) of each, none from the other."""

    rises: tuple[Tensor, Tensor]
    falls: tuple[Tensor, Tensor]

    @staticmethod
    def of(around: _Around, shape: _Shape) -> _Between:
        lift = 2 * shape.slant * around.half
        near = _rise_and_fall(shape.inner * around.q, shape.inner_rest + shape.inner * lift)
        far = _rise_and_fall(shape.outer * around.q, shape.outer_rest + shape.outer * lift)
        return _Between((near[0], far[0]), (near[1], far[1]))

    @property
    def mass(self) -> Tensor:
        """cos chi_inner - cos chi_outer."""
        behind = self.rises[0] > 1
        return torch.where(behind, self.falls[0] - self.falls[1], self.rises[1] - self.rises[0])

    def at(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """1 - cos(chi) and 1 + cos(chi) where the share u of the mass lies inside."""
        (a, b), (c, d) = self.rises, self.falls
        return a + u * (b - a), c + u * (d - c)


def _trapezoid(values: Tensor) -> Tensor:
    """Integral over [-1, 1] of an even function by its values at even steps over [0, 1]."""
    return 2 * (values.sum(-1) - (values[..., 0] + values[..., -1]) / 2) / (values.shape[-1] - 1)


def _log_ratio(table: Tensor, mass: Tensor) -> Tensor:
    """Log density from the table's density of |x| per interval and from M."""
    return torch.log(table) - torch.log(mass.clamp_min(torch.finfo(mass.dtype).tiny)) + math.log(_KNOTS / 2)


def _rise_and_fall(across: Tensor, along: Tensor) -> tuple[Tensor, Tensor]:
    """1 - cos and 1 + cos of the angle in [0, pi] whose tangent is across / along, without cancellation."""
    length = torch.sqrt((across * across + along * along).clamp_min(torch.finfo(along.dtype).tiny))
    sum_ = length + along.abs()
    small, large = across * across / (length * sum_), sum_ / length
    ahead = along > 0
    return torch.where(ahead, small, large), torch.where(ahead, large, small)


def _at(table: Tensor, index: Tensor) -> Tensor:
    """Entry `index` `[..., *batch]` of tables `[*batch, K]`."""
    if table.dim() == 1:
        return table[index]
    return table.expand(*index.shape, table.shape[-1]).gather(-1, index[..., None])[..., 0]
