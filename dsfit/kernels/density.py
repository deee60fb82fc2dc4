"""Density of the mixture per steradian, in float32."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from dsfit.frame import HALF_PI
from dsfit.kernels.geometry import Direction, Records
from dsfit.kernels.layout import FIELDS, Layout

_TINY = 1e-37


def density(layout: Layout, fields: Tensor, sphere: Tensor, direction: Direction, records: Records) -> Tensor:
    """p(omega_i) `[S, B]`: lobes of theta_h times azimuths over cos(theta_i), and `sphere`, the share of the uniform
    sphere over 4 pi.

    `fields` is `[F, K, B]` in the order of `layout.FIELDS`.
    """
    mode, below, above, log_scale = fields[: FIELDS.index("log_scale") + 1].unbind()
    tables: dict[int, Tensor] = {}
    total: Tensor | float = 0.0
    for k, law in enumerate(layout.laws):
        x = direction.theta_h - mode[k]
        z = x * torch.where(x < 0, below[k], above[k])
        lobe = torch.exp(log_scale[k] - z * z)
        total = total + lobe * _azimuth(law, direction, records, tables)
    return total / direction.cos_i + sphere


def log_density(value: Tensor) -> Tensor:
    """log p; the density is positive everywhere."""
    return torch.log(value.clamp_min(_TINY))


def _azimuth(law: int | str, direction: Direction, records: Records, tables: dict[int, Tensor]) -> Tensor | float:
    """Density of |phi|."""
    if law == "all":
        return 1 / math.pi
    if law == "back":
        return torch.where(direction.phi < HALF_PI, 2 / math.pi, 0.0)
    if law not in tables:
        tables[law] = records[law]
    return tables[law]
