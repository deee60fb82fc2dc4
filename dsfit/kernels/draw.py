"""Directions of the mixture from three uniforms, in float32."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from dsfit.frame import HALF_PI
from dsfit.kernels.geometry import take
from dsfit.kernels.layout import FIELDS, Layout
from dsfit.kernels.normal import upper_quantile

_EPS = 2.0**-25


def draw(
    layout: Layout, fields: Tensor, theta_r: Tensor, laws: tuple[Tensor, ...], u: tuple[Tensor, Tensor, Tensor]
) -> tuple[Tensor, Tensor]:
    """theta_i and phi `[S, B]`.

    u[0] selects the component, u[1] is inverted in theta_h, u[2] in phi. What u[0] leaves after selection chooses one
    of the two rows of the table around theta_diff with the probability that the blend gives it, and that row's CDF is
    inverted: the density of phi is exactly the blend.
    """
    u = tuple(x.clamp(_EPS, 1 - _EPS) for x in u)
    chosen, rest, outside = _select(layout, fields, u[0])
    theta_h = _inclination(chosen, u[1])
    lobe = (2 * theta_h - theta_r).clamp(-HALF_PI, HALF_PI)
    v = 2 * u[1] - 1
    ball = torch.atan2(v, 2 * torch.sqrt(u[1] * (1 - u[1])))
    theta_i = torch.where(outside, ball, lobe)
    signed = 2 * u[2] - 1
    target = signed.abs()
    uniform = target * math.pi
    phi = torch.where(chosen["law"] < -1.5, 0.5 * uniform, uniform)
    if layout.tables:
        number = chosen["law"].clamp_min(0).to(torch.int32)
        drawn = _azimuth(layout, laws, number, (theta_r - theta_i).abs() * 0.5, rest, target)
        phi = torch.where((chosen["law"] >= 0) & ~outside, drawn, phi)
    return theta_i, torch.copysign(torch.where(outside, uniform, phi), signed)


def _select(layout: Layout, fields: Tensor, u: Tensor) -> tuple[dict[str, Tensor], Tensor, Tensor]:
    """The fields of the component that u selects, the uniform number that is left, and where the sphere is meant."""
    names = [name for name in FIELDS if name not in ("log_scale", "edge")]
    edge = fields[FIELDS.index("edge")]
    rows = {name: fields[FIELDS.index(name)] for name in names}
    numbers = [float(law) if isinstance(law, int) else (-1.0 if law == "all" else -2.0) for law in layout.laws]
    chosen = {name: rows[name][0] + 0 * u for name in names}
    chosen["law"] = torch.full_like(u, numbers[0])
    low, high = torch.zeros_like(u), edge[0] + 0 * u
    for k in range(1, len(layout.laws)):
        beyond = u >= edge[k - 1]
        for name in names:
            chosen[name] = torch.where(beyond, rows[name][k], chosen[name])
        chosen["law"] = torch.where(beyond, numbers[k], chosen["law"])
        low, high = torch.where(beyond, edge[k - 1], low), torch.where(beyond, edge[k], high)
    return chosen, (u - low) / (high - low).clamp_min(1e-30), u >= edge[-1]


def _inclination(chosen: dict[str, Tensor], u: Tensor) -> Tensor:
    """theta_h by the inverse of the two-piece normal law. Either piece is drawn from its far end: tails keep the digits
    of u."""
    left = chosen["left"]
    below = u < left
    share = torch.where(below, u / left.clamp_min(1e-30), (1 - u) / (1 - left).clamp_min(1e-30)).clamp(_EPS, 1.0)
    far = torch.where(below, chosen["far_left"], chosen["far_right"])
    near = torch.where(below, chosen["near_left"], chosen["near_right"])
    scale = torch.where(below, -0.5 / chosen["below"], 0.5 / chosen["above"]) * math.sqrt(2)
    return chosen["mode"] + scale * upper_quantile(far + share * (near - far))


def _azimuth(
    layout: Layout, laws: tuple[Tensor, ...], number: Tensor, diff: Tensor, rest: Tensor, target: Tensor
) -> Tensor:
    """|phi| from one row of a table: bisection for the column, then the root of its linear density."""
    density, cumulative = laws[:2]
    rows, columns = layout.law_rows, layout.law_columns
    x = (diff * ((rows - 1) / HALF_PI)).clamp_max(rows - 1)
    row = x.to(torch.int32).clamp_max(rows - 2)
    row = row + (rest < x - row.to(x.dtype)).to(torch.int32)
    first = ((number * rows + row) * columns).to(torch.int64)
    low = torch.zeros_like(first)
    step = 1 << (columns - 2).bit_length()
    while step := step >> 1:
        middle = (low + step).clamp_max(columns - 2)
        low = torch.where(take(cumulative, first + middle) <= target, middle, low)
    width = math.pi / (columns - 1)
    at = first + low
    before = take(cumulative, at)
    f0, f1 = take(density, at), take(density, at + 1)
    missing = (target - before).clamp_min(0) / width
    root = torch.sqrt((f0 * f0 + 2 * (f1 - f0) * missing).clamp_min(1e-30))
    inside = (2 * missing / (f0 + root)).clamp(0, 1)
    return ((low.to(x.dtype) + inside) * width).clamp_max(math.pi)
