"""What a rendering integrates at every hit: BSDF x light x scatter counts, towards all directions at once."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from dsfit.arguments import check_directions, checked
from dsfit.bsdf.dual_scattering import DualScattering
from dsfit.context import Context
from dsfit.errors import InputError
from dsfit.frame import wrap
from dsfit.render.hits import HitContext, Hits
from dsfit.scene.integrand import Integrand
from dsfit.scene.lights import ConstantLight, Light
from dsfit.scene.scattering import ConstantScattering, Scattering

if TYPE_CHECKING:
    from dsfit.kernels import HairKernel

_DARK = 0.15
"""Where at least this share of directions meets no light, only the others are marched and shaded: picking them out
costs about as much as a tenth of the work on them."""

_PLACED = 12
"""Batches of hits for which the light, as they see it, is kept."""


class HairIntegrand(Integrand):
    """f(omega_i) = F(omega_i, omega_r; n, v) cos(theta_i) L(omega_i), `[..., C]`, at the hits of a picture.

    `integrand(omega_i, context)` takes directions `[*samples, *batch, 2]` in the fibres' frames and a `HitContext`
    `[*batch]`. The crossings n and the lit share v are those towards each direction; the context's are hints for
    proposals, which do not enter. Single scattering with dual scattering's global term: light that reached the hit
    through other fibres is in F, so there are no further bounces.

    Args:
        bsdf: the dual scattering BSDF.
        light: in world coordinates; it is `placed` at every hit.
        scattering: (n, v) of these hits, looked up by `context.hit`.
        hits: the hits that `context.hit` counts.
        kernel: evaluates the BSDF in float32, without gradients; left out, torch does, in the dtype of omega_i.

    Directions without light are neither marched nor shaded. `hits` can be exchanged by `bind`, so that one integrand
    (and all that was prepared with it) serves tile after tile.

    Raises:
        InputError: channels that do not agree; directions not finite; a context without hits.
    """

    def __init__(
        self, bsdf: DualScattering, light: Light, scattering: Scattering, hits: Hits, kernel: HairKernel | None = None
    ) -> None:
        super().__init__(bsdf, light, scattering)
        self.kernel = kernel
        self.bind(hits, scattering)

    def bind(self, hits: Hits, scattering: Scattering) -> None:
        """Other hits, and their scattering."""
        self.hits, self.scattering = hits, scattering
        self._seen: list[tuple[Tensor, Light]] = []

    @property
    def is_even(self) -> bool:
        """Even in the relative azimuth whatever the hit: only where light and scattering are the same all around."""
        plain = isinstance(self.light, ConstantLight) and isinstance(self.scattering, ConstantScattering)
        return self.bsdf.fiber.is_round and plain

    def light_at(self, context: Context) -> Light:
        """The light as the hits of these contexts see it, with rotations `[*batch, 3, 3]`; the last ones are kept."""
        if not isinstance(context, HitContext):
            raise InputError("context", type(context).__name__, "a HitContext, which knows its hits")
        for hit, placed in self._seen:
            if hit is context.hit:
                return placed
        placed = self.light.placed(self.hits.position[context.hit], self.hits.frame[context.hit])
        self._seen = [(context.hit, placed), *self._seen[: _PLACED - 1]]
        return placed

    def __call__(self, omega_i: Tensor, context: Context) -> Tensor:
        check_directions(omega_i, context.batch_shape, "omega_i")
        with checked(omega_i):
            radiance = self.light_at(context)(omega_i)
        shape = torch.broadcast_shapes(omega_i.shape[:-1], context.batch_shape)
        dark = None if isinstance(self.light, ConstantLight) else (radiance == 0).all(-1).expand(shape)
        if dark is None or float(dark.sum()) < _DARK * max(1, dark.numel()):
            return self._shaded(omega_i, context) * radiance
        index = torch.nonzero(~dark.reshape(-1)).squeeze(-1)
        value = omega_i.new_zeros(shape.numel(), self.channels)
        if len(index):
            lit = context.reshape(-1)[index % context.batch_shape.numel()]
            directions = omega_i.expand(*shape, 2).reshape(-1, 2)[index]
            light = radiance.expand(*shape, -1).reshape(-1, radiance.shape[-1])[index]
            value[index] = (self._shaded(directions, lit) * light).to(value)
        return value.reshape(*shape, self.channels)

    def _shaded(self, omega_i: Tensor, context: Context) -> Tensor:
        """F cos(theta_i) `[..., C]`."""
        with checked(omega_i):
            n, v = self.scattering(omega_i, context)
        theta_i, phi_i = omega_i.unbind(-1)
        if self.kernel is None:
            phi = wrap(context.phi_r - phi_i)
            return self.bsdf(theta_i, context.theta_r, phi, n, v, phi_h=self._phi_h(context, phi))
        given = context.theta_r, n, v, theta_i, context.phi_r - phi_i
        flat = [x.expand(n.shape).reshape(-1).to(torch.float32) for x in given]
        return self.kernel.eval_each(*flat).reshape(*n.shape, self.bsdf.channels).to(omega_i.dtype)

    def theta_breaks(self, context: Context) -> Tensor:
        return self._one(context).theta_breaks(context)

    def azimuth_edges(self, context: Context, theta_i: Tensor, *, coarse: bool = False) -> Tensor:
        return self._one(context).azimuth_edges(context, theta_i, coarse=coarse)

    def _one(self, context: Context) -> Integrand:
        """The integrand of one hit, with the light in its frame: what quadrature asks for breakpoints."""
        return Integrand(self.bsdf, self.light_at(context), _Breakless(self.scattering, context))


class _Breakless(Scattering):
    """The scattering at one hit. A grid has a kink at every voxel: quadrature is not told of them."""

    def __init__(self, scattering: Scattering, context: Context) -> None:
        super().__init__()
        self.of = [scattering]

    def crossings(self, omega_i: Tensor, context: Context) -> Tensor:
        return self.of[0](omega_i, context)[0]

    def breakpoints(self) -> tuple[list[float], list[float]]:
        try:
            return self.of[0].breakpoints()
        except InputError:  # differs from hit to hit
            return [], []


__all__ = ["HairIntegrand"]
