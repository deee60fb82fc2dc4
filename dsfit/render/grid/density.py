"""A voxel grid of fibre moments, and how many fibres rays through it are expected to cross."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from dsfit.arguments import all_finite
from dsfit.errors import (
    FLOATS,
    InputError,
    as_number,
    as_real,
    check_broadcast,
    check_choice,
    check_finite,
    check_range,
)
from dsfit.render.grid.deposit import deposit
from dsfit.render.grid.march import SELF, START, march
from dsfit.render.grid.native import Compiled, NoCompiler
from dsfit.render.strands import Strands

if TYPE_CHECKING:
    from dsfit.render.grid.table import DirectionalTable

_MOST = 512
"""Voxels along a side: 2^27 of them take 6 GiB, and the compiled march counts their numbers in 32 bits."""

_FINEST = 1 / 64


class DensityGrid:
    """Fibres as a density: per voxel the second moment of their tangents.

    `T = sum of 2 r l t t^T / V` over the pieces of fibre in a voxel of volume V (length l, radius r, unit tangent t).
    Its trace is the density of length x diameter. In direction d the expected crossings per unit length are
    `q(d) = sum of 2 r l |sin(t, d)| / V`, which the moments give as

        q = (P - k W) / sqrt(P),  P = tr T (tr T - d^T T d),  W = tr T d^T T d - |T d|^2,
        k = 3 (1 - (pi / 4) sqrt(3 / 2)) = 0.1143:

    the root of the mean square sine, less a term for its spread. It is exact for aligned tangents (W = 0) and for
    isotropic ones (where the root alone is 4 % too large), and right to 0.1 % along a narrow bundle, where the
    spread is Gaussian.

    Args:
        moments: `[X, Y, Z, 6]`, the components xx, yy, zz, xy, xz, yz of T per unit length; may require a gradient.
        low: `[3]`, lowest corner, in world coordinates.
        voxel: side of the cubic voxels, > 0.
        step: of the march, as a fraction of the voxel, in [1/64, 1]. In hair, steps of a whole voxel err by 0.04 to
            0.45 crossings (RMS) at a mean of 6 to 15, one way as often as the other; half a voxel by a third to a
            quarter of that.
        max_n: crossings are limited to this number, > 0; the light is gone there.
        mode: "compiled" (C++ in float32, built for this machine at first use; no gradients), "eager" (torch, in the
            dtype of the ray), or "auto": compiled where no gradient is asked for and there is a compiler.

    Raises:
        InputError: shapes that do not fit, values not finite or out of range, mode "compiled" without a compiler.
    """

    def __init__(
        self,
        moments: Tensor,
        low: Any,
        voxel: float,
        *,
        step: float = 1.0,
        max_n: float = 100.0,
        mode: str = "auto",
    ) -> None:
        moments = check_finite("moments", as_real("moments", moments))
        if moments.ndim != 4 or moments.shape[-1] != 6 or not moments.numel() or max(moments.shape[:3]) > _MOST:
            raise InputError("moments", tuple(moments.shape), f"shape [X, Y, Z, 6], at most {_MOST} voxels a side")
        trace = moments.detach()[..., :3]
        if bool((trace < 0).any()):
            raise InputError("moments", float(trace.min()), "moments of a density: xx, yy, zz >= 0")
        self.moments = moments
        self.low = check_finite("low", as_real("low", low, torch.float64))
        if self.low.shape != (3,):
            raise InputError("low", tuple(self.low.shape), "shape [3]")
        self.voxel = as_number("voxel", voxel, 0.0, open_low=True)
        self.step = as_number("step", step, _FINEST, 1.0)
        self.max_n = as_number("max_n", max_n, 0.0, open_low=True)
        self.mode = check_choice("mode", mode, ("auto", "compiled", "eager"))
        if mode == "compiled":
            _ = self.compiled

    @classmethod
    def of(cls, strands: Strands, resolution: int, **options: Any) -> DensityGrid:
        """The grid of these strands, with cubic voxels: `resolution` of them along the longest side of their box.

        Every segment is cut exactly at the faces of voxels: the sum of trace x volume is that of length x diameter.
        """
        if isinstance(resolution, bool) or not isinstance(resolution, int) or not 1 <= resolution <= _MOST:
            raise InputError("resolution", resolution, f"a whole number in [1, {_MOST}]")
        low, high = (x.to(torch.float64) for x in strands.bounds)
        extent = high - low
        voxel = float(extent.max()) / resolution
        counts = torch.ceil(extent / voxel - 1e-9).clamp(1, resolution)
        corner = (low + high - counts * voxel) / 2
        x, y, z = (int(count) for count in counts)
        return cls(deposit(strands, corner, voxel, (x, y, z)), corner, voxel, **options)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Voxels along x, y and z."""
        x, y, z, _ = self.moments.shape
        return x, y, z

    @property
    def high(self) -> Tensor:
        """Highest corner `[3]`."""
        return self.low + self.voxel * torch.tensor(self.shape, dtype=torch.float64)

    @property
    def memory(self) -> int:
        """Bytes of the moments, and of their float32 form for the compiled march where that has been made."""
        own = self.moments.numel() * self.moments.element_size()
        return own + (self.compiled.memory if "compiled" in self.__dict__ else 0)

    @functools.cached_property
    def compiled(self) -> Compiled:
        """The march in C++, on the moments as they are at first use.

        Raises:
            InputError: no compiler.
        """
        try:
            return Compiled(self.moments, self.low, self.voxel, self.step, self.max_n)
        except NoCompiler as error:
            raise InputError("mode", "compiled", f"'eager' here: {error}") from None

    @functools.cached_property
    def backend(self) -> str:
        """What is used where no gradient is asked for: "compiled" or "eager"."""
        if self.mode != "auto":
            return self.mode
        try:
            _ = self.compiled
        except InputError:
            return "eager"
        return "compiled"

    def crossings(self, origin: Tensor, direction: Tensor, radius: Tensor | float | None = None) -> Tensor:
        """Expected crossings n >= 0, `[*]`, of rays from their origin to the border of the grid, at most `max_n`.

        The moments are interpolated trilinearly between the centres of voxels (and fall to zero over half a voxel
        beyond the border) and q(d) is summed at the middles of steps of `step` voxels.

        Args:
            origin: `[*, 3]`, in world coordinates, inside or outside; broadcast with `direction`.
            direction: `[*, 3]`, normalised here.
            radius: of the fibre that the origin lies on, >= 0, `[*]`. The ray then starts a quarter of a voxel on
                (`march.START`): the density just there is smeared from further in. And the fibre itself is in the
                density: in a field smeared over voxels of side a, a straight fibre of radius r adds the same, on
                average, in every direction, n_own = 2 r c / a with c = 0.276; that is taken off, down to 0 at the
                least. None: the ray starts at the origin, and nothing is taken off.

        The result has the rays' common dtype. Gradients flow to origin, direction and moments.

        Raises:
            InputError: shapes that do not broadcast, other dtypes, values not finite, a direction of length 0.
        """
        origin, direction = _ray("origin", origin), _ray("direction", direction)
        shape = (*check_broadcast(origin=origin[..., 0], direction=direction[..., 0]), 3)
        longest = direction.detach().abs().amax(-1)
        if not bool(((longest > 1e-15) & (longest < 1e15)).all()):
            raise InputError("direction", float(longest.min()), "vectors of length in [1e-15, 1e15]")
        dtype = torch.promote_types(origin.dtype, direction.dtype)
        if radius is not None:
            radius = check_range("radius", as_real("radius", radius), 0.0)
        own, begin = (None, 0.0) if radius is None else (self.own_crossings(radius).to(dtype), START)
        given = (origin, direction, self.moments, *([] if own is None else [own]))
        asked = torch.is_grad_enabled() and any(x.requires_grad for x in given)
        if self.mode == "compiled" and asked:
            raise InputError("mode", "compiled", "'auto' or 'eager' where gradients are asked for")
        if self.backend == "compiled" and not asked:
            n = self.compiled.march(origin.expand(shape), direction.expand(shape), begin).to(dtype)
        else:
            n = march(self, origin.to(dtype).expand(shape), direction.to(dtype).expand(shape), begin)
        return n if own is None else (n - own).clamp_min(0.0)

    def own_crossings(self, radius: Tensor) -> Tensor:
        """n_own of `crossings`."""
        return radius * (2 * SELF / self.voxel)

    def hints(self, position: Tensor, v: str | float = "poisson") -> tuple[Tensor, Tensor]:
        """Representative n and mean v at points `[*, 3]`, as `Scattering.hints`: "transmitted", exp(-n) is the mean of
        exp(-n(d)) over the sphere, and v the mean by the rule of `Scattering`. Looked up in a field that is computed
        once, on a lattice of `table.LATTICE` points along the longest side. No gradients."""
        return self.table.hints(position, v)

    @functools.cached_property
    def table(self) -> DirectionalTable:
        """`directional()` with its defaults, computed once."""
        return self.directional()

    def directional(self, **options: Any) -> DirectionalTable:
        """n on a lattice of points x directions; see `DirectionalTable`."""
        from dsfit.render.grid.table import DirectionalTable

        return DirectionalTable.of(self, **options)

    def __getstate__(self) -> dict[str, Any]:
        """Without the compiled march, whose addresses hold in this process only."""
        return {key: value for key, value in self.__dict__.items() if key not in ("compiled", "backend")}

    def __repr__(self) -> str:
        return f"DensityGrid({self.shape}, voxel={self.voxel:g}, step={self.step:g}, backend={self.backend})"


def _ray(field: str, value: Tensor) -> Tensor:
    if not isinstance(value, Tensor) or value.dtype not in FLOATS or value.shape[-1:] != (3,):
        shape = tuple(value.shape) if isinstance(value, Tensor) else value
        raise InputError(field, shape, "a float64 or float32 tensor [*, 3]")
    return value if all_finite(value) else check_finite(field, value)
