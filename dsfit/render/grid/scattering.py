"""n and v of a rendering: rays from the points of hits through the grid of densities."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from dsfit.context import Context
from dsfit.errors import InputError
from dsfit.frame import to_vector
from dsfit.render.grid.density import DensityGrid
from dsfit.render.hits import HitContext, Hits
from dsfit.scene.scattering import Scattering


class GridScattering(Scattering):
    """n(omega_i) by a ray from the hit's position through the grid, in the world direction frame^T omega_i.

    Rays start a little away from the hit, whose own fibre is taken off; see `DensityGrid.crossings`.

    Args:
        grid: the density.
        hits: the points; contexts say by `HitContext.hit` which of them they belong to.
        v: see `Scattering`.

    Raises:
        InputError: a context without hits, or with one that is not there.
    """

    def __init__(self, grid: DensityGrid, hits: Hits, v: Any = "poisson") -> None:
        super().__init__(v)
        self.grid, self.hits = grid, hits
        self._own = grid.own_crossings(hits.radius)
        self._rays = [x.detach().to(torch.float32).contiguous() for x in (hits.position, hits.frame)]

    def crossings(self, omega_i: Tensor, context: Context) -> Tensor:
        hit = self._hit(context)
        asked = torch.is_grad_enabled() and (omega_i.requires_grad or self.grid.moments.requires_grad)
        if self.grid.backend == "compiled" and not asked:
            shape = torch.broadcast_shapes(omega_i.shape[:-1], hit.shape)
            theta, phi = omega_i.expand(*shape, 2).unbind(-1)
            n = self.grid.compiled.march_hits(*self._rays, hit.expand(shape), theta, phi).to(omega_i)
            return (n - self._own.to(omega_i)[hit]).clamp_min(0.0)
        frame = self.hits.frame.to(omega_i)[hit]
        world = (to_vector(omega_i).unsqueeze(-2) @ frame).squeeze(-2)
        return self.grid.crossings(self.hits.position.to(omega_i)[hit], world, self.hits.radius.to(omega_i)[hit])

    def _hit(self, context: Context) -> Tensor:
        if not isinstance(context, HitContext):
            raise InputError("context", type(context).__name__, "a HitContext")
        hit = context.hit
        if hit.numel() and not (0 <= int(hit.min()) and int(hit.max()) < len(self.hits)):
            raise InputError("context.hit", int(hit.max()), f"whole numbers in [0, {len(self.hits) - 1}]")
        return hit
