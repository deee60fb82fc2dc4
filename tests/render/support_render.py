"""A picture without geometry: hits made by hand, behind the interfaces of camera and visibility."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any

import torch

import dsfit
from dsfit.render.hits import Hits
from dsfit.render.scene import RenderScene
from dsfit.scene import ConstantLight, ConstantScattering
from dsfit.scene.lights.sun import SunLight


@dataclass(frozen=True)
class FlatCamera:
    """Looks along -z."""

    width: int = 6
    height: int = 4


@dataclass(frozen=True)
class HandMade:
    """Fibres of many orientations, one under each ray: frames, positions and views are functions of pixel and
    sub-pixel sample; rays of the first column and every fifth ray meet nothing."""

    camera: FlatCamera
    all_rays: bool = False

    def hits(self, rows: range, columns: range, samples: int, seed: int) -> Hits:
        row, column, sample = torch.meshgrid(
            torch.tensor(rows), torch.tensor(columns), torch.arange(samples), indexing="ij"
        )
        pixel = (row - rows.start) * len(columns) + column - columns.start
        row, column, sample, pixel = (x.reshape(-1) for x in (row, column, sample, pixel))
        key = (row * 131 + column * 17 + sample * 5 + seed).double()
        kept = torch.ones_like(row, dtype=torch.bool) if self.all_rays else (column > 0) & ((key + 3 * sample) % 5 != 1)
        row, column, sample, pixel, key = (x[kept] for x in (row, column, sample, pixel, key))
        turn, tilt = 0.9 * key, 1.2 * torch.sin(0.7 * key)
        flat = torch.cos(tilt)
        tangent = torch.stack([flat * torch.cos(turn), torch.sin(tilt), flat * torch.sin(turn)], -1)
        up = torch.tensor([0.3, -0.5, 0.8], dtype=torch.float64).expand_as(tangent)
        normal = torch.linalg.cross(up, tangent)
        normal = normal / normal.norm(dim=-1, keepdim=True)
        frame = torch.stack([tangent, normal, torch.linalg.cross(tangent, normal)], -2)
        view = torch.stack([0.2 * torch.sin(key), 0.2 * torch.cos(key), torch.ones_like(key)], -1)
        position = torch.stack([column - 2.5, 1.5 - row, 0.3 * torch.sin(key)], -1).double() + 0.01 * sample[:, None]
        flat = torch.zeros_like(key)
        return Hits(
            pixel, sample, position, frame, view / view.norm(dim=-1, keepdim=True), flat, flat + 0.01, row * 0, row * 0,
            10 + flat,
        )  # fmt: skip


def bsdf(preset: str = "brown") -> dsfit.DualScattering:
    """A round fibre with tables."""
    return dsfit.DualScattering(dsfit.Fiber.preset(preset), precision="table")


_BSDF = bsdf()


def scene(light: Any, *, n: float = 1.5, v: float = 0.3, all_rays: bool = False, **options: Any) -> RenderScene:
    """24 pixels under a light, with constant scattering."""
    camera = FlatCamera(options.pop("width", 6), options.pop("height", 4))
    given = {"subsamples": 2, "bsdf": _BSDF, **options}
    grid = given.pop("grid", ConstantScattering(n, v))
    return RenderScene(camera, HandMade(camera, all_rays), light=light, grid=grid, **given)  # type: ignore[arg-type]


def narrow_light(kappa: float = 200.0) -> Any:
    """A small bright source and a dim sky."""
    from dsfit.scene.lights import VonMisesFisherLights

    direction = torch.tensor([[math.sin(0.6), 0.5, math.cos(0.6)]], dtype=torch.float64)
    return VonMisesFisherLights(direction, kappa, 3.0, ambient=0.1)


PIXEL = (range(1, 2), range(2, 3))


@functools.cache
def lit(kind: str):
    lights = {
        "furnace": ConstantLight([1.0, 2.0, 3.0]),
        "sun": SunLight([0.5, 0.6, 0.7], 0.2, 1.0),
        "lobe": narrow_light(),
    }
    return lights[kind]


@functools.cache
def pixel_truth(kind: str) -> torch.Tensor:
    """The pixel's value `[C]` by quadrature in float64."""
    one = scene(lit(kind), all_rays=True, dtype=torch.float64)
    hits = one.hits(*PIXEL)
    found = dsfit.reference(one.integrand(hits, exact=True), one.contexts(hits), 1e-6)
    assert found.converged and len(hits) == 2
    return found.value.mean(0)
