"""Running mean and second central moments, updated out of place.

Welford 1962, merged as in Chan, Golub and LeVeque 1983, so no large sums are subtracted from each other.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Moments:
    """Moments of vectors of length D, for any grid of cells.

    Fields:
        count: samples in each cell `[*cells]`, in the dtype of the data.
        mean: `[*cells, D]`.
        scatter: sum of squared deviations `[*cells, D]`, or of their outer products `[*cells, D, D]`.
    """

    count: Tensor
    mean: Tensor
    scatter: Tensor

    @staticmethod
    def of(y: Tensor, *, full: bool = False, mask: Tensor | None = None) -> Moments:
        """Moments over the first axis of y `[n, *cells, D]`; only where `mask [n, *cells]`, if given."""
        if mask is None:
            count = y.new_full(y.shape[1:-1], y.shape[0])
            mean = y.mean(dim=0)
            deviation = y - mean
        else:
            inside = mask.to(y.dtype)
            count = inside.sum(dim=0)
            kept = torch.where(mask.unsqueeze(-1), y, 0.0)
            mean = kept.sum(dim=0) / count.clamp_min(1).unsqueeze(-1)
            deviation = (kept - mean) * inside.unsqueeze(-1)
        scatter = torch.einsum("n...i,n...j->...ij", deviation, deviation) if full else deviation.square().sum(dim=0)
        return Moments(count, mean, scatter)

    def merge(self, other: Moments | None) -> Moments:
        """Moments of both sets of samples together."""
        if other is None:
            return self
        count = self.count + other.count
        delta = other.mean - self.mean
        share = (other.count / count.clamp_min(1)).unsqueeze(-1)
        between = _outer(delta, self.full) * _like(self.count * other.count / count.clamp_min(1), self.scatter)
        return Moments(count, self.mean + delta * share, self.scatter + other.scatter + between)

    def pool(self) -> Moments:
        """Moments of all samples over the first cell axis."""
        count = self.count.sum(dim=0)
        mean = (self.mean * self.count.unsqueeze(-1)).sum(dim=0) / count.clamp_min(1).unsqueeze(-1)
        between = _outer(self.mean - mean, self.full) * _like(self.count, self.scatter)
        return Moments(count, mean, (self.scatter + between).sum(dim=0))

    @staticmethod
    def cat(parts: list[Moments]) -> Moments:
        """Concatenate along the first cell axis."""
        return Moments(*(torch.cat([getattr(part, name) for part in parts]) for name in ("count", "mean", "scatter")))

    @property
    def full(self) -> bool:
        """Whether `scatter` holds outer products."""
        return self.scatter.ndim > self.mean.ndim

    @property
    def second(self) -> Tensor:
        """E[y y^T] `[*cells, D, D]` (or E[y^2] `[*cells, D]`), the raw second moment over the samples."""
        return _outer(self.mean, self.full) + self.scatter / _like(self.count.clamp_min(1), self.scatter)

    @property
    def variance(self) -> Tensor:
        """Unbiased sample variance, shape of `scatter`; nan with fewer than two samples."""
        degrees = torch.where(self.count > 1, self.count - 1, torch.nan)
        return self.scatter / _like(degrees, self.scatter)


def _outer(x: Tensor, full: bool) -> Tensor:
    return x.unsqueeze(-1) * x.unsqueeze(-2) if full else x.square()


def _like(x: Tensor, target: Tensor) -> Tensor:
    return x.reshape(*x.shape, *[1] * (target.ndim - x.ndim))
