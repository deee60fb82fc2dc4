"""A scene of hair as the integrator sees it: what a camera hits, the light, the scatter counts and the BSDF."""

from __future__ import annotations

import functools
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import torch

from dsfit.bsdf.dual_scattering import DualScattering
from dsfit.context import Context
from dsfit.errors import InputError, as_real, check_choice, check_range
from dsfit.frame import HALF_PI, to_angles
from dsfit.render.hits import HitContext, Hits
from dsfit.render.integrand import HairIntegrand
from dsfit.render.strands import Strands
from dsfit.scene.lights import Light
from dsfit.scene.scattering import Scattering

if TYPE_CHECKING:
    from dsfit.kernels import HairKernel
    from dsfit.render.camera import Camera

_ROWS = 24


@dataclass(frozen=True)
class RenderScene:
    """Everything a picture is made of.

    Attributes:
        camera: with `width` and `height` in pixels.
        visibility: has `hits(rows, columns, samples, seed) -> Hits`.
        bsdf: of all fibres.
        light: in world coordinates.
        grid: a `DensityGrid`, or a `Scattering` that is the same for all hits.
        v: rule for the directly lit share with a grid, "poisson" or "threshold".
        background: radiance `[C]` or a number, seen by rays that meet no fibre; >= 0.
        subsamples: camera rays K per pixel, the same for every technique: what is estimated is their mean.
        seed: of the places within pixels.
        dtype: of hits, contexts and directions.
        strands: kept for whoever wants them.

    Raises:
        InputError: an argument out of range.
    """

    camera: Camera
    visibility: Any
    bsdf: DualScattering
    light: Light
    grid: Any
    v: str = "poisson"
    background: Any = 0.0
    subsamples: int = 4
    seed: int = 1
    dtype: torch.dtype = torch.float32
    strands: Strands | None = None

    def __post_init__(self) -> None:
        check_choice("v", self.v, ("poisson", "threshold"))
        if isinstance(self.subsamples, bool) or not isinstance(self.subsamples, int) or self.subsamples < 1:
            raise InputError("subsamples", self.subsamples, "an integer >= 1")
        if self.dtype not in (torch.float32, torch.float64):
            raise InputError("dtype", self.dtype, "torch.float32 or torch.float64")
        background = check_range("background", as_real("background", self.background, torch.float64), 0.0)
        channels = max(self.bsdf.channels, self.light.channels)
        if background.ndim > 1 or background.numel() not in (1, channels):
            raise InputError("background", tuple(background.shape), f"a number or {channels} numbers")
        object.__setattr__(self, "background", background.expand(channels))

    @classmethod
    def of(
        cls, strands: Strands, camera: Camera, *, bsdf: DualScattering, light: Light, grid: int = 64,
        step: float | None = None, max_n: float | None = None, **options: Any,
    ) -> RenderScene:  # fmt: skip
        """The scene of these strands: rays by Embree, scatter counts from a grid of `grid` voxels along the longest
        side. `step` and `max_n` as for `DensityGrid.of`; the other options are attributes."""
        from dsfit.render.grid import DensityGrid
        from dsfit.render.visibility import Visibility

        given = {key: value for key, value in (("step", step), ("max_n", max_n)) if value is not None}
        density = DensityGrid.of(strands, resolution=grid, **given)
        return cls(camera, Visibility(strands, camera), bsdf, light, density, strands=strands, **options)

    @property
    def channels(self) -> int:
        """Number of channels C."""
        return len(self.background)

    @property
    def _kernel(self) -> HairKernel | str:
        return kernel_of(self.bsdf)

    @property
    def kernel(self) -> HairKernel | None:
        """The compiled kernel of the BSDF; None where it is not served."""
        return None if isinstance(self._kernel, str) or self.dtype == torch.float64 else self._kernel

    @property
    def backend(self) -> str:
        """What evaluates the BSDF, and why, if it is torch."""
        if isinstance(self._kernel, str):
            return self._kernel
        return "torch: float64 is asked for" if self.dtype == torch.float64 else self._kernel.backend

    def hits(self, rows: range, columns: range) -> Hits:
        """What the rays of these pixels meet, in the scene's dtype."""
        found = self.visibility.hits(rows, columns, self.subsamples, self.seed)
        return _cast(found, self.dtype)

    def sample_hits(self, count: int, generator: torch.Generator) -> Hits:
        """About `count` hits from random rows of the picture: what techniques prepare with. Fewer where the picture has
        fewer; `hits.pixel` names them 0, 1, ...

        Raises:
            InputError: nothing is hit in any row.
        """
        rows = torch.randperm(self.camera.height, generator=generator)
        parts: list[Hits] = []
        for start in range(0, len(rows), _ROWS):
            for row in rows[start : start + _ROWS].tolist():
                parts.append(self.hits(range(row, row + 1), range(self.camera.width)))
            if sum(map(len, parts)) >= count:
                break
        names = [field.name for field in fields(Hits)]
        whole = Hits(*(torch.cat([getattr(part, name) for part in parts]) for name in names))
        if not len(whole):
            raise InputError("scene", "an empty picture", "a camera that sees at least one fibre")
        chosen = whole[torch.randperm(len(whole), generator=generator)[:count].sort().values]
        order = torch.arange(len(chosen))
        return Hits(order, *(getattr(chosen, name) for name in names[1:]))

    def scattering(self, hits: Hits) -> Scattering:
        """n and v towards every direction, at these hits."""
        if isinstance(self.grid, Scattering):
            return self.grid
        from dsfit.render.grid import GridScattering

        return GridScattering(self.grid, hits, v=self.v)

    def contexts(self, hits: Hits) -> HitContext:
        """Shading contexts `[H]`: the viewing direction in the fibre's frame, hints of n and v, and the hit."""
        omega = to_angles((hits.frame @ hits.outgoing.unsqueeze(-1)).squeeze(-1))
        limit = torch.tensor(HALF_PI, dtype=omega.dtype).item()
        theta_r, phi_r = omega[:, 0].clamp(-limit, limit), omega[:, 1]
        if isinstance(self.grid, Scattering):
            hinted = self.grid.hints(Context(theta_r, phi_r))
            n, v = hinted.n, hinted.v
        else:
            n, v = self.grid.hints(hits.position, self.v)
        return HitContext(theta_r, phi_r, n.to(omega), v.to(omega), hit=torch.arange(len(hits)))

    def integrand(self, hits: Hits, *, exact: bool = False) -> HairIntegrand:
        """The integrand at these hits; `exact`: without the kernel."""
        kernel = None if exact else self.kernel
        return HairIntegrand(self.bsdf, self.light, self.scattering(hits), hits, kernel)


@functools.lru_cache(maxsize=4)
def kernel_of(bsdf: DualScattering) -> HairKernel | str:
    """The kernel of a BSDF with the mixture as it starts, made once; or why there is none."""
    from dsfit.kernels import HairKernel

    try:
        return HairKernel(bsdf)
    except InputError as error:
        return f"torch: {error}"


def _cast(hits: Hits, dtype: torch.dtype) -> Hits:
    values = (getattr(hits, field.name) for field in fields(Hits))
    return Hits(*(x.to(dtype) if x.is_floating_point() else x for x in values))


__all__ = ["RenderScene"]
