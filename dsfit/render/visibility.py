"""What a camera sees of strands of hair, by Embree."""

from __future__ import annotations

import importlib

import numpy as np
import torch
from torch import Tensor

from dsfit.errors import InputError
from dsfit.render.camera import Camera
from dsfit.render.hits import Hits
from dsfit.render.pixel_samples import pixel_samples
from dsfit.render.ribbons import Ribbons
from dsfit.render.strand_frames import carried_normals, point_tangents, turned, unit
from dsfit.render.strands import Strands

_RAYS = 2**17
"""Most rays in flight; a ray takes about 200 bytes, a hit 1 kB."""


class Visibility:
    """Nearest fibres along the rays of a camera: strips of the fibres' width that face it.

    Embree (package `embreex`) finds the strip in float32, in a scene shifted to the camera and scaled to unit size;
    the place on it is then computed in float64.

    Args:
        strands: the hair; not changed afterwards.
        camera: where it is seen from.

    Raises:
        InputError: no strands or no camera, embreex is not installed, or there are more triangles than it can number.
    """

    def __init__(self, strands: Strands, camera: Camera) -> None:
        for field, given, kind in (("strands", strands, Strands), ("camera", camera, Camera)):
            if not isinstance(given, kind):
                raise InputError(field, type(given).__name__, f"a dsfit {kind.__name__}")
        embree, meshes = _embree()
        self.strands, self.camera = strands, camera
        self._ribbons = Ribbons.facing(strands, camera.position)
        exact = Strands(strands.points.to(torch.float64), strands.first, strands.radius.to(torch.float64))
        self._radius, self._strand = exact.radius, exact.strand_of_point
        self._tangent = point_tangents(exact)
        self._normal = carried_normals(exact, self._tangent)
        triangles = self._ribbons.triangles()
        if len(triangles) >= 2**31 or 2 * len(strands.points) >= 2**31:
            raise InputError("strands", len(triangles), "at most 2^30 segments")
        vertices = self._ribbons.vertices()
        scaled = (vertices / vertices.abs().max()).to(torch.float32)
        self._scene = embree.EmbreeScene(robust=True)
        meshes.TriangleMesh(self._scene, scaled.numpy(), triangles.to(torch.int32).numpy())

    def hits(self, rows: range, columns: range, samples: int, seed: int) -> Hits:
        """Nearest fibre points along `samples` rays through every pixel of a tile.

        Rays go through the points of a scrambled (0,2)-sequence of each pixel (`pixel_samples`), so the same seed gives
        the same hits whatever the tiling, and the mean over a pixel's rays is unbiased.

        Args:
            rows, columns: of the image; `Hits.pixel` counts the pixels of this tile, row by row.
            samples: rays per pixel.
            seed: of the scrambling.

        Returns:
            `Hits` in float64 on the CPU. `offset` is positive on the side of tangent x outgoing.

        Raises:
            InputError: pixels that the image does not have, samples < 1, a seed that is not an integer in [0, 2^64).
        """
        pixels = self._pixels(rows, columns)
        _check_whole("samples", samples, 1, 2**31)
        _check_whole("seed", seed, 0, 2**64)
        count = len(pixels) * samples
        starts = range(0, max(count, 1), _RAYS)
        parts = [self._some(pixels, start, min(start + _RAYS, count), samples, seed) for start in starts]
        return Hits(*(torch.cat([getattr(part, name) for part in parts]) for name in Hits.__dataclass_fields__))

    def _pixels(self, rows: range, columns: range) -> Tensor:
        for field, given, size in (("rows", rows, self.camera.height), ("columns", columns, self.camera.width)):
            if not isinstance(given, range) or (len(given) and not (0 <= min(given) and max(given) < size)):
                raise InputError(field, given, f"a range within 0 to {size - 1}")
        row, column = torch.tensor(list(rows), dtype=torch.long), torch.tensor(list(columns), dtype=torch.long)
        return (row.unsqueeze(-1) * self.camera.width + column).flatten()

    def _some(self, pixels: Tensor, start: int, stop: int, samples: int, seed: int) -> Hits:
        """The hits of rays number `start` to `stop - 1`."""
        ray = torch.arange(start, stop)
        pixel = ray // samples
        first = int(pixel[0]) if len(pixel) else 0
        shown = pixels[first : int(pixel[-1]) + 1] if len(pixel) else pixels[:0]
        row, column = shown // self.camera.width, shown % self.camera.width
        low = start - first * samples
        places = pixel_samples(row, column, samples, seed).flatten(0, 1)[low : low + len(ray)]
        direction = self.camera.rays(pixels[pixel], places)[1]
        single = direction.to(torch.float32).numpy()
        found = torch.from_numpy(self._scene.run(np.zeros_like(single), single, output=True)["primID"]).to(torch.long)
        hit = torch.nonzero(found >= 0).flatten()
        return self._described(found[hit], direction[hit], pixel[hit], ray[hit] - pixel[hit] * samples)

    def _described(self, triangle: Tensor, direction: Tensor, pixel: Tensor, sample: Tensor) -> Hits:
        along, across, depth = self._ribbons.place(triangle, direction)
        segment = triangle // 2
        start = self._ribbons.starts[segment]
        wide = along.unsqueeze(-1)

        def between(of_points: Tensor, share: Tensor = wide) -> Tensor:
            return (1 - share) * of_points[start] + share * of_points[start + 1]

        here = self._tangent[start]
        tangent = unit(between(self._tangent), here)
        normal = turned(self._normal[start], here, tangent)
        frame = torch.stack([tangent, normal, torch.linalg.cross(tangent, normal)], dim=-2)
        right = torch.linalg.cross(tangent, -direction)
        side = (right * between(self._ribbons.side)).sum(-1)
        offset = torch.where(side < 0, -across, across)
        position = between(self._ribbons.axis) + self.camera.position
        radius = between(self._radius, along)
        return Hits(pixel, sample, position, frame, -direction, offset, radius, self._strand[start], segment, depth)


def _embree():  # noqa: ANN202 - two modules
    try:
        return tuple(importlib.import_module(f"embreex.{name}") for name in ("rtcore_scene", "mesh_construction"))
    except ImportError as error:
        raise InputError("visibility", str(error), "an installation with Embree: pip install embreex") from None


def _check_whole(field: str, value: object, low: int, high: int) -> None:
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value < high:
        raise InputError(field, value, f"an integer >= {low} and below {high}")
