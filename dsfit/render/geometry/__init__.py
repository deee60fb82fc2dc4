"""Hair to render: generators, readers of files, transformations, where to look from.

Generators take a `seed` and sizes in centimetres and return float64 `Strands`, y up, roots first. `GENERATORS` maps
their names to them.
"""

from __future__ import annotations

from collections.abc import Callable

from dsfit.render.geometry.ball import ball
from dsfit.render.geometry.block import block
from dsfit.render.geometry.curly_wisp import curly_wisp
from dsfit.render.geometry.double_block import double_block
from dsfit.render.geometry.hair_file import read_hair, write_hair
from dsfit.render.geometry.pbrt_file import read_pbrt_curves
from dsfit.render.geometry.straight_bundle import straight_bundle
from dsfit.render.geometry.transform import (
    fitted_into,
    joined,
    scaled,
    subsampled,
    translated,
    turned_up,
    with_radius,
)
from dsfit.render.geometry.view import VIEWS, suggested_view
from dsfit.render.geometry.wavy_bundle import wavy_bundle
from dsfit.render.strands import Strands

GENERATORS: dict[str, Callable[..., Strands]] = {
    "block": block,
    "double_block": double_block,
    "straight_bundle": straight_bundle,
    "wavy_bundle": wavy_bundle,
    "curly_wisp": curly_wisp,
    "ball": ball,
}
"""Generators of strands by name."""

__all__ = [
    "GENERATORS",
    "VIEWS",
    "ball",
    "block",
    "curly_wisp",
    "double_block",
    "fitted_into",
    "joined",
    "read_hair",
    "read_pbrt_curves",
    "scaled",
    "straight_bundle",
    "subsampled",
    "suggested_view",
    "translated",
    "turned_up",
    "wavy_bundle",
    "with_radius",
    "write_hair",
]
