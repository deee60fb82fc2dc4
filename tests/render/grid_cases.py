"""Grids, strands and hits for the tests of the density grid."""

from __future__ import annotations

import torch
from torch import Tensor

from dsfit.render import Hits, Strands
from dsfit.render.grid import DensityGrid

F64 = torch.float64


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, dtype=F64, generator=generator(seed))


def uniform(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, dtype=F64, generator=generator(seed))


def unit(x: Tensor) -> Tensor:
    return x / x.norm(dim=-1, keepdim=True)


def packed(tensor: Tensor) -> Tensor:
    """The six components of symmetric matrices `[..., 3, 3]`."""
    return torch.stack([tensor[..., i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))], dim=-1)


def homogeneous(tensor: Tensor, counts: tuple[int, int, int] = (12, 12, 12), **options: object) -> DensityGrid:
    """The same tensor everywhere in a box of voxels of side 0.25 with its lowest corner at (-1, 2, 0.5)."""
    options.setdefault("mode", "eager")
    return DensityGrid(packed(tensor).expand(*counts, 6).contiguous(), (-1.0, 2.0, 0.5), 0.25, **options)


def uneven(counts: tuple[int, int, int] = (5, 7, 4), seed: int = 0, **options: object) -> DensityGrid:
    """Random moments of full rank, different in every voxel; voxels of side 0.3."""
    factor = normal(*counts, 3, 3, seed=seed)
    return DensityGrid(packed(factor @ factor.transpose(-1, -2)), (-0.5, 0.2, 1.0), 0.3, **options)


def polylines(points: Tensor, radius: Tensor) -> Strands:
    """Strands from `[S, K, 3]` and `[S, K]`."""
    count, each = points.shape[:2]
    return Strands(points.reshape(-1, 3), torch.arange(count + 1) * each, radius.reshape(-1))


def tangle(strands: int = 40, points: int = 12, seed: int = 0) -> Strands:
    """Random walks with long steps, of changing radius."""
    walk = normal(strands, points, 3, seed=seed).cumsum(1) * torch.tensor([1.0, 0.6, 0.3], dtype=F64)
    return polylines(walk, 0.01 + 0.02 * uniform(strands, points, seed=seed + 1))


def hits_at(position: Tensor, radius: float = 0.01, seed: int = 0) -> Hits:
    """Hits at points `[H, 3]` with random frames."""
    count = len(position)
    frame = torch.linalg.qr(normal(count, 3, 3, seed=seed))[0]
    zero, number = torch.zeros(count, dtype=F64), torch.zeros(count, dtype=torch.int64)
    return Hits(number, number, position, frame, frame[:, 1], zero, zero + radius, number, number, zero + 1)
