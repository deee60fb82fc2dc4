"""Emitters with an edge, near and far, narrow and wide; cell masses of their densities; a scene's positions."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from dsfit.context import Context
from dsfit.frame import HALF_PI
from dsfit.quadrature import gauss_legendre
from dsfit.scene import ConstantLight, Light, RectangleLight, RingLight, SphereLight, SunLight, TotalLight

CONTEXT = Context(0.3, 1.0)
RGB = [1.0, 0.5, 0.1]


def turn(seed: int) -> Tensor:
    q, _ = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64))
    return q * torch.sign(torch.linalg.det(q))


def uniforms(*shape: int, seed: int = 1, dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def sheet(corner: list[float], u: float, v: float, **options: object) -> RectangleLight:
    return RectangleLight(corner, [u, 0.0, 0.0], [0.0, v, 0.0], RGB, two_sided=True, rotation=turn(3), **options)


def ring(center: list[float], inner: float, outer: float, **options: object) -> RingLight:
    return RingLight(center, [0, 0, 1], inner, outer, RGB, two_sided=True, rotation=turn(4), **options)


EMITTERS: dict[str, Callable[[], Light]] = {
    "sun": lambda: SunLight([0.3, 1.0, 0.5], radiance=RGB),
    "sun wide": lambda: SunLight([-0.3, -1.0, 0.1], 0.6, radiance=RGB),
    "sun hemisphere": lambda: SunLight([-0.3, -1.0, 0.1], HALF_PI, radiance=RGB),
    "sun at the tangent": lambda: SunLight([1.0, 0.1, 0.1], 0.3, radiance=RGB),
    "sphere": lambda: SphereLight([0.5, 1.0, 2.0], 0.7, RGB),
    "sphere far": lambda: SphereLight([5e5, 1e6, 2e6], 0.7e4, RGB),
    "sphere on it": lambda: SphereLight([0.0, 0.6, 0.8], 1.0, RGB),
    "sphere inside": lambda: SphereLight([0.1, 0.6, 0.2], 1.0, RGB),
    "rectangle": lambda: sheet([-1.0, -0.5, 2.0], 2.0, 1.0),
    "rectangle close": lambda: sheet([-1.0, -0.5, 0.02], 2.0, 1.0),
    "rectangle tiny": lambda: sheet([0.3, 0.2, 1.0], 1e-3, 2e-3),
    "rectangle grazing": lambda: sheet([0.5, -1.0, 0.01], 2.0, 2.0),
    "ring": lambda: ring([1.0, -0.5, 2.0], 0.5, 1.0),
    "ring on the axis": lambda: ring([0.0, 0.0, 1.0], 0.5, 1.0),
    "ring close": lambda: ring([1.5, 0.2, 0.2], 1.0, 2.0),
    "ring around": lambda: ring([0.5, 0.0, 0.1], 1.0, 2.0),
    "ring far": lambda: ring([30.0, 10.0, 40.0], 0.5, 1.0),
    "disc": lambda: ring([1.0, -0.5, 2.0], 0.0, 1.0),
}
TINY = ("sun", "sphere far", "rectangle tiny", "ring far")  # so small that cos(theta) is a constant over them


def total() -> TotalLight:
    names = ("sun wide", "sphere", "rectangle", "ring")
    return TotalLight([*(EMITTERS[name]() for name in names), ConstantLight(0.02)])


def cell_edges(light: Light) -> tuple[Tensor, Tensor]:
    """A grid of cells about the emitter."""
    thetas, phis = light.breakpoints()
    low, high = (min(thetas), max(thetas)) if thetas else (-HALF_PI, HALF_PI)
    theta = torch.linspace(low, high, 8, dtype=torch.float64)
    start, end = (min(phis), max(phis)) if len(phis) == 3 and max(phis) - min(phis) < math.pi else (-math.pi, math.pi)
    phi = torch.linspace(start, end, 8, dtype=torch.float64)
    ends = torch.tensor([math.pi], dtype=torch.float64)
    theta = torch.unique(torch.cat([-ends / 2, theta, ends / 2, torch.tensor(thetas, dtype=torch.float64)]))
    return theta, torch.unique(torch.cat([-ends, phi, ends]))


def cell_mass(
    light: Light, log_prob: Callable[[Tensor], Tensor], theta_edges: Tensor, phi_edges: Tensor, jacobian: bool = True
) -> Tensor:
    """Integral of a density over every cell `[theta cells, phi cells]`; azimuths are cut at the emitter's edges."""
    x, w = gauss_legendre(24)
    s = torch.sin(math.pi / 4 * (1 + x)) ** 2  # gathers nodes at the ends, where the emitter's width has a root
    width = (theta_edges[1:] - theta_edges[:-1])[:, None]
    theta = (theta_edges[:-1, None] + width * s).flatten()
    weight = (width * w * math.pi / 4 * torch.sin(math.pi / 2 * (1 + x))).flatten()
    centre, offset, _ = light.azimuth_edges(theta)
    cuts = torch.remainder(centre + offset + math.pi, 2 * math.pi) - math.pi
    cuts = torch.cat([cuts, phi_edges.expand(len(theta), -1)], dim=-1).sort(dim=-1).values
    y, v = gauss_legendre(8)
    half = (cuts[:, 1:] - cuts[:, :-1])[..., None] / 2
    phi = cuts[:, :-1, None] + half * (1 + y)
    density = torch.exp(log_prob(torch.stack([theta[:, None, None].expand_as(phi), phi], dim=-1)))
    part = (density * half * v).sum(-1) * weight[:, None]
    part = part * torch.cos(theta)[:, None] if jacobian else part
    row = torch.arange(len(theta)) // len(x)
    column = torch.searchsorted(phi_edges, phi[..., 4].contiguous()) - 1
    flat = row[:, None] * (len(phi_edges) - 1) + column.clamp(0, len(phi_edges) - 2)
    mass = torch.zeros((len(theta_edges) - 1) * (len(phi_edges) - 1), dtype=torch.float64)
    return mass.index_add(0, flat.flatten(), part.flatten()).reshape(len(theta_edges) - 1, -1)
