"""Edges of emitters in (theta, phi), for quadrature that breaks there: where a curve on the sphere crosses a circle of
latitude.

Every curve is cut where its inclination turns, so that each piece meets a circle of latitude at most once; beyond its
ends a piece stays at its end. Its azimuth is then continuous in theta_i.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from dsfit.frame import TWO_PI, to_angles, wrap
from dsfit.scene.lights.base import tidy

_NODES = 512
_HALVINGS = 46


@dataclass(frozen=True)
class Curve:
    """A smooth curve: `point(s)` `[..., 3]`, of any length > 0, and `slope(s)`, its derivative, for s in [0, 1]."""

    point: Callable[[Tensor], Tensor]
    slope: Callable[[Tensor], Tensor]

    def rises(self, s: Tensor) -> Tensor:
        """Whether the inclination grows with s; by d(x / |p|) / ds."""
        p, q = self.point(s), self.slope(s)
        return q[..., 0] * (p * p).sum(-1) - p[..., 0] * (p * q).sum(-1) > 0


def segment(start: Tensor, end: Tensor) -> Curve:
    """The straight line between two points `[3]`."""
    return Curve(lambda s: start + s[..., None] * (end - start), lambda s: (end - start).expand(*s.shape, 3))


def circle(center: Tensor, first: Tensor, second: Tensor) -> Curve:
    """`center + cos(2 pi s) first + sin(2 pi s) second`."""

    def point(s: Tensor) -> Tensor:
        angle = TWO_PI * s[..., None]
        return center + torch.cos(angle) * first + torch.sin(angle) * second

    def slope(s: Tensor) -> Tensor:
        angle = TWO_PI * s[..., None]
        return TWO_PI * (torch.cos(angle) * second - torch.sin(angle) * first)

    return Curve(point, slope)


@dataclass(frozen=True)
class _Piece:
    """Part [low, high] of a curve on which the inclination is monotone, with azimuths unwrapped at nodes."""

    curve: Curve
    low: float
    high: float
    ends: tuple[float, float]
    nodes: Tensor
    azimuths: Tensor

    def azimuth(self, theta: Tensor) -> Tensor:
        """Unwrapped azimuth where the piece has the inclination, or at its nearer end."""
        rising = self.ends[1] > self.ends[0]
        low, high = torch.full_like(theta, self.low), torch.full_like(theta, self.high)
        for _ in range(_HALVINGS):
            middle = (low + high) / 2
            before = (to_angles(self.curve.point(middle))[..., 0] < theta) == rising
            low, high = torch.where(before, middle, low), torch.where(before, high, middle)
        return self._unwrapped((low + high) / 2)

    def _unwrapped(self, s: Tensor) -> Tensor:
        phi = to_angles(self.curve.point(s))[..., 1]
        k = torch.searchsorted(self.nodes, s.contiguous()).clamp(1, len(self.nodes) - 1)
        share = (s - self.nodes[k - 1]) / (self.nodes[k] - self.nodes[k - 1])
        near = self.azimuths[k - 1] + share * (self.azimuths[k] - self.azimuths[k - 1])
        return near + wrap(phi - near)


class Outline:
    """Closed curves around an emitter, each given by its parts in order."""

    def __init__(self, curves: list[list[Curve]]) -> None:
        self.pieces: list[_Piece] = []
        for parts in curves:
            last: Tensor | None = None
            for curve in parts:
                nodes = torch.linspace(0.0, 1.0, _NODES + 1, dtype=torch.float64)
                angles = to_angles(curve.point(nodes))
                steps = torch.cat([angles[:1, 1], wrap(angles[1:, 1] - angles[:-1, 1])])
                azimuths = steps.cumsum(0)
                if last is not None:
                    azimuths = azimuths + TWO_PI * torch.round((last - azimuths[0]) / TWO_PI)
                last = azimuths[-1]
                self.pieces += list(_pieces(curve, nodes, azimuths))
        if self.pieces:
            spans = torch.cat([piece.azimuths for piece in self.pieces])
            self.centre = float(spans.max() + spans.min()) / 2
            self.reach = min(float(spans.max() - spans.min()) / 2, math.pi)

    def breakpoints(self) -> tuple[list[float], list[float]]:
        """Inclinations at which curves turn or end; azimuths between which they lie."""
        if not self.pieces:
            return [], []
        thetas = [theta for piece in self.pieces for theta in piece.ends]
        whole = self.reach > math.pi - 1e-9
        return tidy(thetas, [] if whole else [self.centre + k * self.reach for k in (-1, 0, 1)])

    def azimuth_edges(self, theta_i: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """As `Light.azimuth_edges`."""
        count = len(self.pieces)
        if not count:
            return theta_i.new_zeros(0), theta_i.new_zeros(*theta_i.shape, 0), theta_i.new_zeros(0)
        theta = theta_i.to(torch.float64)
        offset = torch.stack([piece.azimuth(theta) - self.centre for piece in self.pieces], dim=-1)
        return theta_i.new_full((count,), self.centre), offset.to(theta_i), theta_i.new_full((count,), self.reach)


def _pieces(curve: Curve, nodes: Tensor, azimuths: Tensor) -> list[_Piece]:
    rises = curve.rises((nodes[1:] + nodes[:-1]) / 2)
    turns = (rises[1:] != rises[:-1]).nonzero()[:, 0]
    cuts = [0.0]
    for k in turns.tolist():
        low, high = (nodes[k] + nodes[k + 1]) / 2, (nodes[k + 1] + nodes[k + 2]) / 2
        for _ in range(_HALVINGS):
            middle = (low + high) / 2
            low, high = (middle, high) if bool(curve.rises(middle) == rises[k]) else (low, middle)
        cuts.append(float((low + high) / 2))
    cuts.append(1.0)
    ends = to_angles(curve.point(torch.tensor(cuts, dtype=torch.float64)))[:, 0].tolist()
    return [
        _Piece(curve, cuts[k], cuts[k + 1], (ends[k], ends[k + 1]), nodes, azimuths) for k in range(len(cuts) - 1)
    ]
