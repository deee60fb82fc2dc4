"""What a camera sees: points on fibres, and the shading contexts there."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

from dsfit.context import Context
from dsfit.errors import check_dtype
from dsfit.frame import to_angles


@dataclass(frozen=True)
class Hits:
    """Nearest fibre points along camera rays.

    Attributes:
        pixel: `[H]` int64, which pixel of the tile, row by row; sorted, so that the hits of a pixel are neighbours.
        sample: `[H]` int64, which of the pixel's sub-pixel samples.
        position: `[H, 3]`, on the fibre's axis, in world coordinates.
        frame: `[H, 3, 3]`, rows tangent (root to tip), normal, binormal: `w_fibre = frame @ w_world`.
        outgoing: `[H, 3]`, unit vector towards the camera, in world coordinates.
        offset: `[H]`, h in [-1, 1]: how far from the axis the ray meets the fibre, in fibre radii.
        radius: `[H]`, of the fibre there.
        strand, segment: `[H]` int64, which strand, and which of `Strands.starts`.
        depth: `[H]`, distance from the camera.
    """

    pixel: Tensor
    sample: Tensor
    position: Tensor
    frame: Tensor
    outgoing: Tensor
    offset: Tensor
    radius: Tensor
    strand: Tensor
    segment: Tensor
    depth: Tensor

    def __len__(self) -> int:
        return len(self.pixel)

    def __getitem__(self, index: Any) -> Hits:
        return Hits(*(getattr(self, field.name)[index] for field in fields(self)))


@dataclass(frozen=True, init=False)
class HitContext(Context):
    """The shading contexts of hits: those of a `Context`, and which hit each belongs to.

    Lights and scatter counts of a scene look up position and frame by `hit`, so that every estimator and proposal that
    passes contexts on works in a rendering.
    """

    hit: Tensor

    def __init__(
        self, theta_r: Any, phi_r: Any = 0.0, n: Any = 0.0, v: Any = None, *, hit: Tensor,
        dtype: torch.dtype | None = None,
    ) -> None:  # fmt: skip
        super().__init__(theta_r, phi_r, n, v, dtype=dtype)
        object.__setattr__(self, "hit", hit.expand(self.theta_r.shape))

    def to(self, *args: Any, **kwargs: Any) -> HitContext:
        plain = super().to(*args, **kwargs)
        return HitContext(plain.theta_r, plain.phi_r, plain.n, plain.v, hit=self.hit.to(plain.device))


def context_of(hits: Hits, n: Any = 0.0, v: Any = None, dtype: torch.dtype = torch.float64) -> HitContext:
    """The contexts `[H]` of hits: viewing directions in their fibre frames, computed in float64 and rounded at the end.

    Args:
        hits: what the camera sees.
        n, v: scattering hints `[H]` or single numbers, as for `Context`.
        dtype: of the contexts; theta_r is an atan2, so rounding cannot take it beyond what `Context` allows.

    Raises:
        InputError: hints out of range or of another length, another dtype.
    """
    check_dtype("context.dtype", dtype)
    viewer = (hits.frame.to(torch.float64) @ hits.outgoing.to(torch.float64).unsqueeze(-1)).squeeze(-1)
    theta, phi = to_angles(viewer).to(dtype).unbind(-1)
    return HitContext(theta, phi, n, v, hit=torch.arange(len(hits)), dtype=dtype)


def coverage_of(hits: Hits, pixels: int, samples: int) -> Tensor:
    """Share `[pixels]` (float64) of each pixel's rays that hit a fibre."""
    return torch.bincount(hits.pixel, minlength=pixels).to(torch.float64) / samples
