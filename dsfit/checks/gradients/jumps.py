"""Where a function of directions jumps: what derivatives of samples cannot see."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from dsfit.frame import HALF_PI

_ROWS, _POINTS, _CANDIDATES, _HALVINGS = 17, 720, 6, 32
SEEN = 1e-3
"""Smallest jump, relative to the larger of both sides, that counts as one."""


@dataclass(frozen=True)
class Jumps:
    """Jumps along one angle.

    Attributes:
        largest: relative to the larger of both sides; 0 where there is none.
        at: (theta, phi) of the largest, radians.
        count: lines of the scan that have one.
    """

    largest: float
    at: tuple[float, float]
    count: int


@torch.no_grad()
def find_jumps(function: Callable[[Tensor], Tensor], along: int) -> Jumps:
    """Scan lines of constant theta (`along` = 1, in phi) or of constant phi (`along` = 0, in theta) for jumps.

    Each line is sampled evenly; the intervals over which the function changes most are halved towards the larger
    change until they are a few roundings wide. A continuous function's change goes to zero there, a jump stays. Jumps
    that are much smaller than the function's other changes on the line can be missed.

    Args:
        function: of directions `[N, 2]`, to finite values `[N]`.
        along: 0 for theta, 1 for phi.
    """
    ends = (HALF_PI * (1 - 1e-6), math.pi)
    fixed_end, end = ends[1 - along], ends[along]
    # off the symmetric places, where a line could run along a jump
    lines = torch.linspace(-0.973 * fixed_end, 0.969 * fixed_end, _ROWS, dtype=torch.float64)
    x = torch.linspace(-end, end, _POINTS, dtype=torch.float64) * (1 - 1e-7)

    def value(line: Tensor, t: Tensor) -> Tensor:
        pair = (t, line) if along == 0 else (line, t)
        return function(torch.stack(torch.broadcast_tensors(*pair), dim=-1).reshape(-1, 2)).reshape(t.shape)

    grid = value(lines[:, None].expand(-1, _POINTS), x.expand(_ROWS, -1))
    change = (grid[:, 1:] - grid[:, :-1]).abs()
    top = change.topk(_CANDIDATES, dim=1).indices
    low, high = x[top], x[top + 1]
    rows = lines[:, None].expand_as(low)
    f_low, f_high = grid.gather(1, top), grid.gather(1, top + 1)
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        f = value(rows, middle)
        left = (f - f_low).abs() >= (f_high - f).abs()
        low, high = torch.where(left, low, middle), torch.where(left, middle, high)
        f_low, f_high = torch.where(left, f_low, f), torch.where(left, f, f_high)
    size = (f_high - f_low).abs() / torch.maximum(f_high.abs(), f_low.abs()).clamp_min(1e-300)
    size = size * (torch.maximum(f_high.abs(), f_low.abs()) > 1e-9 * grid.abs().max())  # of what matters
    found = size > SEEN
    if not bool(found.any()):
        return Jumps(0.0, (0.0, 0.0), 0)
    k = int(size.argmax())
    place, line = float(low.reshape(-1)[k]), float(rows.reshape(-1)[k])
    return Jumps(float(size.max()), (place, line) if along == 0 else (line, place), int(found.any(1).sum()))
