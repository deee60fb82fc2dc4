"""An equirectangular environment map: bilinear radiance, and sampling whose density is exact.

Convention. The map's frame is right-handed with y up, as in OpenEXR's `ImfEnvmap.h`: latitude = asin(y), longitude =
atan2(x, z), so longitude 0 looks along +z and pi/2 along +x. Row 0 is the top. Texel (i, j) is centred at latitude pi/2
- pi (i + 1/2) / H and longitude pi - 2 pi (j + 1/2) / W: seen from inside, columns run from left to right while
longitude falls from pi to -pi. Radiance is bilinear in (latitude, longitude) between texel centres, periodic in
longitude, constant above the top and below the bottom centres.

Density. The map's luminance (mean of the channels) at texel centres is interpolated bilinearly in (sin latitude,
longitude), a density per steradian that is bilinear in each cell, so that its CDF inverts in closed form and no
rounding of solid angles is involved: sin latitude by the marginal, then longitude by the conditional of two
interpolated rows. It differs from the radiance only by the curvature of the sine inside a cell: luminance / density
lies within 2/3 .. 2 of its mean in the two rows next to the poles and tends to it with the square of the texel size
elsewhere. Both vanish at the same places.

In float32, on the CPU and without gradients both are found by C++, if there is a compiler (`environment_native`), by
the same law; elsewhere by the torch code here.
"""

from __future__ import annotations

import math
import os
from typing import Any

import torch
from torch import Tensor

from dsfit.arguments import check_directions, check_uniforms
from dsfit.errors import InputError, as_number, as_real
from dsfit.frame import to_angles
from dsfit.proposals.base import Proposal
from dsfit.scene.exr import read_exr
from dsfit.scene.lights.base import Light, LightDistribution, LightProposal, around, tidy
from dsfit.scene.lights.environment_native import Prepared

_PI = math.pi
MAX_LISTED = 64
"""Maps up to this size on both sides list all texel lines as breakpoints when their pole is the fibre's tangent."""

_TABLES = ("luminance", "column_mass", "edges", "rises", "row_values", "row_mass")


def check_image(field: str, image: Tensor) -> Tensor:
    """An image `[H, W, C]` that can be a light: not empty, finite, >= 0, not all black; else `InputError`."""
    if image.dim() != 3 or image.numel() == 0:
        raise InputError(field, f"shape {tuple(image.shape)}", "a non-empty image [H, W, C]")
    for name, bad in (("NaN", image.isnan()), ("infinite", image.isinf()), ("negative", image < 0)):
        count = int(bad.sum())
        if count:
            row, column, channel = (int(x) for x in bad.nonzero()[0])
            what = f"{count} {name} values, the first in row {row}, column {column}, channel {channel}"
            raise InputError(field, what, "finite radiances >= 0")
    if not (image > 0).any():
        raise InputError(field, "an image that is black everywhere", "an image with some light in it")
    return image


def _linear_inverse(u: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """Quantile x in [0, 1] of the density proportional to `a + (b - a) x`, a, b >= 0, not both zero."""
    root = torch.sqrt(((1 - u) * a * a + u * b * b).clamp_min(torch.finfo(u.dtype).tiny))
    return (u * (a + b) / (a + root)).clamp(0.0, 1.0)


class EnvironmentLight(Light):
    """Radiance from an equirectangular map (see the module's text for the convention).

    Args:
        image: `[H, W, C]`, any H, W, C >= 1, finite, >= 0, not all black. float32 or float64 is kept; lookups are in
            the dtype of omega_i.
        scale: factor on all radiances, > 0.
        rotation: map's frame -> fibre frame; see `Light`.
        name: for messages and labels.

    Raises:
        InputError: the image cannot be a light; the message says why, and where in the image.
    """

    image: Tensor
    luminance: Tensor
    column_mass: Tensor
    edges: Tensor
    rises: Tensor
    row_values: Tensor
    row_mass: Tensor

    def __init__(self, image: Any, scale: float = 1.0, rotation: Any = None, *, name: str = "image") -> None:
        super().__init__(rotation)
        self.name = name
        image = check_image(name, as_real(name, image))
        self.scale = as_number("scale", scale, 0.0, open_low=True)
        largest = float(image.detach().max())
        if not math.isfinite(self.scale * largest) or self.scale * largest > torch.finfo(image.dtype).max:
            raise InputError("scale", scale, f"numbers whose product with the largest pixel, {largest:g}, is finite")
        self.register_buffer("image", image)
        self.prepared = Prepared()
        height = image.shape[0]
        # Node values of the density by row; the poles repeat the outermost rows. Tables stay float64: they are sums of
        # up to 1e7 terms.
        luminance = image.detach().to(torch.float64)
        luminance = luminance.mean(-1) / luminance.mean(-1).amax()
        pairs = (luminance + luminance.roll(-1, 1)) / 2
        cumulative = torch.cat([torch.zeros_like(pairs[:, :1]), torch.cumsum(pairs, 1)], dim=1)
        # Colatitudes of the nodes: 0, the texel centres, pi.
        nodes = torch.arange(height + 2, dtype=torch.float64, device=image.device)
        edges = ((nodes - 0.5) * (_PI / height)).clamp(0.0, _PI)
        rises = 2 * torch.sin((edges[1:] + edges[:-1]) / 2) * torch.sin((edges[1:] - edges[:-1]) / 2)
        rows = cumulative[(nodes.long() - 1).clamp(0, height - 1), -1] * (2 * _PI / image.shape[1])
        mass = rises * (rows[1:] + rows[:-1]) / 2
        row_mass = torch.cat([torch.zeros_like(mass[:1]), torch.cumsum(mass, 0)])
        for key, value in zip(_TABLES, (luminance, cumulative, edges, rises, rows, row_mass), strict=True):
            self.register_buffer(key, value)

    def _apply(self, fn: Any, recurse: bool = True) -> EnvironmentLight:
        """Move the tables with the module, but keep them float64 when it is cast to float32."""
        tables = {key: self._buffers[key] for key in _TABLES}
        super()._apply(fn, recurse)
        for key, value in tables.items():
            self._buffers[key] = value.to(self._buffers[key].device)  # type: ignore[union-attr]
        return self

    @classmethod
    def from_file(cls, path: str | os.PathLike[str], scale: float = 1.0, rotation: Any = None) -> EnvironmentLight:
        """The map in an EXR file: its channels R, G, B if it has them, else its one channel (or Y); alpha is ignored.

        Raises:
            InputError: the file cannot be read (see `read_exr`), has other channels, or its pixels cannot be a light.
                The message names the file and what is wrong.
        """
        found = read_exr(path)
        names = [name for name in found.channels if name != "A"]
        wanted = ["R", "G", "B"] if {"R", "G", "B"} <= set(names) else ["Y"] if "Y" in names else names
        if wanted != ["R", "G", "B"] and len(wanted) != 1:
            raise InputError(
                f"EXR file {str(path)!r}", f"channels {list(found.channels)}", "channels R, G, B, or Y, or a single one"
            )
        pixels = found.pixels[..., [found.channels.index(name) for name in wanted]]
        return cls(pixels, scale, rotation, name=f"EXR file {str(path)!r}")

    @property
    def channels(self) -> int:  # type: ignore[override]
        return self.image.shape[-1]

    @property
    def label(self) -> str:
        return f"environment {self.image.shape[1]} x {self.image.shape[0]}"

    def _coordinates(self, omega_i: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Row interval k in 0 .. H (between nodes k and k + 1), place in it, column interval, place in it."""
        height, width, _ = self.image.shape
        latitude, longitude = to_angles(self.world_vector(omega_i).roll(-1, -1)).unbind(-1)
        row = (_PI / 2 - latitude) * (height / _PI) - 0.5
        column = (_PI - longitude) * (width / (2 * _PI)) - 0.5
        k, j = torch.floor(row.detach()), torch.floor(column.detach())
        return (k.long() + 1).clamp(0, height), (row - k).clamp(0.0, 1.0), j.long() % width, column - j

    def _corners(self, k: Tensor, j: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Places of the four texels around, in the flattened map."""
        height, width = self.luminance.shape
        above, below = (k - 1).clamp_min(0) * width, k.clamp_max(height - 1) * width
        right = torch.where(j == width - 1, 0, j + 1)
        return above + j, above + right, below + j, below + right

    def forward(self, omega_i: Tensor) -> Tensor:
        check_directions(omega_i, field="omega_i")
        if (compiled := self.prepared.serving(self, omega_i)) is not None:
            return compiled.radiance(omega_i, self.rotation)
        k, t, j, s = self._coordinates(omega_i)
        weights = ((1 - t) * (1 - s), (1 - t) * s, t * (1 - s), t * s)
        corners = [place * self.channels for place in self._corners(k, j)]
        # channel by channel: sums over a last dimension of three run at a fraction of the speed
        found = [
            sum(w * _at(self.image, place + channel).to(omega_i) for w, place in zip(weights, corners, strict=True))
            for channel in range(self.channels)
        ]
        return self.scale * torch.stack(found, dim=-1)

    def power(self) -> Tensor:
        """The integral of the sampling density, which differs from that of the radiance by the square of a texel."""
        return self.row_mass[-1] * (self.scale * self.image.detach().to(torch.float64).mean(-1).amax())

    def covers(self) -> bool:
        return bool((self.luminance > 0).all())

    def proposal(self) -> Proposal:
        """Directions by the map's luminance; exact density, positive wherever the radiance is."""
        return LightProposal(self, EnvironmentDistribution)

    def breakpoints(self) -> tuple[list[float], list[float]]:
        """Texels far brighter than the mean; for a small map with its pole along the tangent, all texel lines.

        In any other orientation the map's kinks run obliquely through (theta, phi): quadrature is then slow and only
        bounds its error.
        """
        self.single_frame()
        height, width = self.luminance.shape
        thetas: list[float] = []
        phis: list[float] = []
        mean = self.row_mass[-1] / (4 * _PI)
        values, indices = self.luminance.flatten().topk(min(8, height * width))
        for value, index in zip(values, indices.tolist(), strict=True):
            if value > 20 * mean:
                texel = self._texel_direction(index // width, index % width)
                more = around(texel, max(_PI / height, 2 * _PI / width), (1.0,))
                thetas, phis = thetas + more[0], phis + more[1]
        pole = self.to_fibre(torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64, device=self.image.device))
        if abs(pole[0].item()) > 1 - 1e-12 and max(height, width) <= MAX_LISTED:
            for i in range(height):
                thetas.append(to_angles(self._texel_direction(i, 0))[0].item())
            for j in range(width):
                phis.append(to_angles(self._texel_direction(height // 2, j))[1].item())
        return tidy(thetas, phis)

    def _texel_direction(self, i: int, j: int) -> Tensor:
        height, width = self.luminance.shape
        latitude, longitude = _PI / 2 - _PI * (i + 0.5) / height, _PI - 2 * _PI * (j + 0.5) / width
        return self.to_fibre(
            _direction(*torch.tensor([latitude, longitude], dtype=torch.float64, device=self.image.device))
        )


def _direction(latitude: Tensor, longitude: Tensor) -> Tensor:
    flat = torch.cos(latitude)
    return torch.stack([flat * torch.sin(longitude), torch.sin(latitude), flat * torch.cos(longitude)], dim=-1)


def _at(table: Tensor, place: Tensor) -> Tensor:
    """Elements of a flattened table; several times as fast as indexing rows and columns."""
    return table.reshape(-1).index_select(0, place.reshape(-1)).reshape(place.shape)


class EnvironmentDistribution(LightDistribution):
    """p = bilinear(luminance; sin latitude, longitude) / integral. Tables and sampling are float64.

    Uniforms: sine of latitude, longitude.
    """

    dimension = 2
    light: EnvironmentLight

    def sample(self, u: Tensor) -> Tensor:
        u = check_uniforms(u, self.dimension, self.batch_shape)
        light = self.light
        if (compiled := light.prepared.serving(light, u)) is not None:
            return compiled.sample(u, light.rotation)
        height, width = light.luminance.shape
        u0, u1 = u.to(torch.float64)[..., :2].unbind(-1)
        total = light.row_mass[-1]
        # Strictly below the total, so that the search never ends in a trailing row (or column) without mass.
        target = torch.minimum(u0 * total, torch.nextafter(total, torch.zeros_like(total)))
        k = (torch.searchsorted(light.row_mass, target.detach(), right=True) - 1).clamp(0, height)
        fraction = (target - light.row_mass[k]) / (light.row_mass[k + 1] - light.row_mass[k])
        t = _linear_inverse(fraction, light.row_values[k], light.row_values[k + 1])
        # 1 - cos and 1 + cos of the colatitude, each without cancellation at its own pole.
        low = 2 * torch.sin(light.edges[k] / 2) ** 2 + t * light.rises[k]
        high = 2 * torch.cos(light.edges[k + 1] / 2) ** 2 + (1 - t) * light.rises[k]
        colatitude = 2 * torch.atan2(torch.sqrt(low.clamp_min(1e-300)), torch.sqrt(high.clamp_min(1e-300)))

        above, below = (k - 1).clamp_min(0), k.clamp_max(height - 1)
        upper, lower, rest = above * (width + 1), below * (width + 1), 1 - t

        def mass(column: Tensor | int) -> Tensor:
            return rest * _at(light.column_mass, upper + column) + t * _at(light.column_mass, lower + column)

        full = mass(width)
        goal = torch.minimum(u1 * full, torch.nextafter(full.detach(), torch.zeros_like(full)))
        first = torch.zeros_like(k)
        for bit in reversed(range((width - 1).bit_length())):  # the last column with mass(column) <= goal
            further = (first + (1 << bit)).clamp_max(width - 1)
            first = torch.where(mass(further).detach() <= goal.detach(), further, first)
        start, end = mass(first), mass(first + 1)
        upper, lower = above * width, below * width
        after = torch.where(first == width - 1, 0, first + 1)
        a = rest * _at(light.luminance, upper + first) + t * _at(light.luminance, lower + first)
        b = rest * _at(light.luminance, upper + after) + t * _at(light.luminance, lower + after)
        s = _linear_inverse(((goal - start) / (end - start)).clamp(0.0, 1.0), a, b)
        longitude = _PI - (first + s + 0.5) * (2 * _PI / width)
        flat = torch.sin(colatitude)
        vector = torch.stack([flat * torch.sin(longitude), torch.cos(colatitude), flat * torch.cos(longitude)], dim=-1)
        return to_angles(light.to_fibre(vector)).to(u.dtype)

    def log_prob(self, omega: Tensor) -> Tensor:
        check_directions(omega, self.batch_shape)
        light = self.light
        if (compiled := light.prepared.serving(light, omega)) is not None:
            return compiled.log_prob(omega, light.rotation)
        k, t, j, s = light._coordinates(omega)
        t, s = t.to(torch.float64), s.to(torch.float64)
        lower, upper = light.edges[k], light.edges[k + 1]
        step = upper - lower
        # Place in the row measured in sin(latitude), from both ends, so that neither weight is lost to rounding.
        near = 2 * torch.sin(lower + t * step / 2) * torch.sin(t * step / 2) / light.rises[k]
        far = 2 * torch.sin(upper - (1 - t) * step / 2) * torch.sin((1 - t) * step / 2) / light.rises[k]
        a, b, c, d = (_at(light.luminance, place) for place in light._corners(k, j))
        top = (1 - s) * a + s * b
        # The half rows at the poles hold one value, and t, counted in full rows, is not the place in them.
        polar = (k == 0) | (k == light.luminance.shape[0])
        density = torch.where(polar, top, far * top + near * ((1 - s) * c + s * d))
        lit = density > 0
        log_density = torch.where(lit, torch.log(torch.where(lit, density, 1.0)), -math.inf)
        return (log_density - torch.log(light.row_mass[-1])).to(omega.dtype)
