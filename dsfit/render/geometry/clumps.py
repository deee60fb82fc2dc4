"""Clumping: strands drawn towards the one in the middle of their lock."""

from __future__ import annotations

import torch
from torch import Tensor

from dsfit.render.geometry.build import smoothstep, uniform


def nearest_centre(roots: Tensor, centres: Tensor) -> Tensor:
    """Index `[S]` of the centre `[C, d]` closest to each root `[S, d]`."""
    step = max(1, 20_000_000 // len(centres))
    return torch.cat([torch.cdist(part, centres).argmin(-1) for part in roots.split(step)])


def clumped(curves: Tensor, roots: Tensor, locks: int, strength: float, generator: torch.Generator) -> Tensor:
    """Curves `[S, K, 3]` pulled towards the middle one of their lock, not at all at the root and most at the tip.

    Args:
        roots: where strands stand, `[S, d]`; a lock is what is closest to one of `locks` strands chosen at random.
        strength: share of the distance to the middle strand that is closed at the tip; varies by half between locks.
    """
    if locks < 1 or strength == 0.0:
        return curves
    guides = torch.randperm(len(curves), generator=generator)[:locks]
    lock = nearest_centre(roots, roots[guides])
    pull = strength * uniform((len(guides),), generator, 0.5, 1.0)[lock]
    s = smoothstep(torch.linspace(0.0, 1.0, curves.shape[1], dtype=curves.dtype), 0.05, 1.0)
    return curves + (pull[:, None] * s)[..., None] * (curves[guides][lock] - curves)
