"""Expected crossings along rays in torch: any dtype, with gradients."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.nn.functional import grid_sample, pad
from torch.utils.checkpoint import checkpoint

if TYPE_CHECKING:
    from dsfit.render.grid.density import DensityGrid

SPREAD = 3 * (1 - math.pi / 4 * math.sqrt(3 / 2))
"""k of `DensityGrid`: makes isotropic tangents exact."""

START = 0.25
"""Voxels that rays from points on fibres leave out at first. Densities are smeared over a voxel or two, and points on
fibres, above all those that are seen, have less in front of them than that. Among 0, 1/4, 0.35 and 1/2, a quarter has
the least mean square error of exp(-n) against whether the exact number of crossings is 0, in blocks, curtains and balls
of hair, or comes within 4 % of it; exp(-n) of points seen is too small on average, mostly by less than half as much as
without (measured by experiments/scatter_counts.py)."""

SELF = 0.276
"""c of `DensityGrid.crossings`: what is left beyond that start of the crossings that a straight fibre with r = a / 2
has with itself, mean over directions and places of the voxels' faces (they spread by 0.02)."""

_SAMPLES = 1 << 18
"""Points of rays that are held at once."""


def march(grid: DensityGrid, origin: Tensor, direction: Tensor, begin: float = 0.0) -> Tensor:
    """n `[*]` of rays `[*, 3]` of one dtype, from `begin` voxels on. Memory is bounded: rays go in chunks, which a
    gradient computes again."""
    shape = origin.shape[:-1]
    field = pad(grid.moments.to(origin.dtype).permute(3, 0, 1, 2), (1, 1, 1, 1, 1, 1)).unsqueeze(0)
    most = math.ceil(math.hypot(*(size + 1 for size in grid.shape)) / grid.step)
    rays = max(1, _SAMPLES // most)
    chunks = list(zip(origin.reshape(-1, 3).split(rays), direction.reshape(-1, 3).split(rays), strict=True))
    again = len(chunks) > 1 and torch.is_grad_enabled()
    parts = [
        checkpoint(_march, grid, field, begin, *chunk, use_reentrant=False)
        if again
        else _march(grid, field, begin, *chunk)
        for chunk in chunks
    ]
    return (torch.cat(parts) if parts else origin.new_zeros(0)).reshape(shape)


def _march(grid: DensityGrid, field: Tensor, begin: float, origin: Tensor, direction: Tensor) -> Tensor:
    """Sum of q(d) at the middles of steps, `[N]`; coordinates are voxels, with centres at 1 to the number of them."""
    d = direction / direction.norm(dim=-1, keepdim=True)
    start = (origin - grid.low.to(origin)) / grid.voxel + 0.5
    top = torch.tensor([size + 1.0 for size in grid.shape], dtype=origin.dtype)
    enter, leave = _interval(start, d, top, begin)
    steps = torch.ceil((leave - enter).detach() / grid.step).long()
    ray = torch.arange(len(steps)).repeat_interleave(steps)
    turn = torch.arange(len(ray)) - (steps.cumsum(0) - steps)[ray]
    t = enter[ray] + (turn.to(enter) + 0.5) * grid.step
    place = start[ray] + t[:, None] * d[ray]
    # The field is zero at the border and beyond: the last step, which may reach past it, adds nothing there.
    place = torch.minimum(place.clamp_min(0.0), top)
    scaled = (2 * place / top - 1).flip(-1)  # grid_sample counts axes from the last
    moments = grid_sample(field, scaled[None, None, None], mode="bilinear", padding_mode="zeros", align_corners=True)
    rate = crossing_rate(moments[0, :, 0, 0], d[ray])
    n = torch.zeros_like(enter).index_add(0, ray, rate) * (grid.step * grid.voxel)
    return n.clamp_max(grid.max_n)


def _interval(start: Tensor, d: Tensor, top: Tensor, begin: float) -> tuple[Tensor, Tensor]:
    """Where rays enter and leave the box [0, top], from `begin` on; the same number twice where they miss it."""
    flat = d == 0
    inverse = 1 / torch.where(flat, 1.0, d)
    one, two = -start * inverse, (top - start) * inverse
    clear = (start >= 0) & (start <= top)
    near = torch.where(flat, torch.where(clear, -torch.inf, torch.inf), torch.minimum(one, two)).amax(-1)
    far = torch.where(flat, torch.where(clear, torch.inf, -torch.inf), torch.maximum(one, two)).amin(-1)
    hit = far > near.clamp_min(begin)
    return torch.where(hit, near, begin).clamp_min(begin), torch.where(hit, far, begin)


def crossing_rate(moments: Tensor, d: Tensor) -> Tensor:
    """q(d) of `DensityGrid` for moments `[6, *]` and unit directions `[*, 3]`; 0 with gradient 0 where it vanishes."""
    xx, yy, zz, xy, xz, yz = moments.unbind(0)
    x, y, z = d.unbind(-1)
    tx, ty, tz = xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z
    trace = xx + yy + zz
    along = tx * x + ty * y + tz * z
    power = trace * (trace - along)
    some = (trace > torch.finfo(trace.dtype).tiny ** 0.25) & (power > torch.finfo(trace.dtype).eps * trace * trace)
    root = torch.sqrt(torch.where(some, power, 1.0))
    spread = (trace * along - (tx * tx + ty * ty + tz * tz)).clamp_min(0.0)
    return torch.where(some, root - SPREAD * spread / root, 0.0)
