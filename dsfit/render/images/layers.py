"""A rendered image with everything known about its pixels, as one EXR file."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from dsfit.errors import InputError
from dsfit.scene.exr import ExrImage, read_exr, write_exr

_COLORS = {1: ("Y",), 3: ("R", "G", "B")}
_PLANES = {"samples": "samples", "n": "n", "time": "time", "coverage": "A", "depth": "depth"}
"""Layers of one value per pixel, and the names of their channels."""


@dataclass(frozen=True)
class RenderImage:
    """Layers of a rendering; row 0 is the top one, C is 3 (R, G, B) or 1 (Y).

    Attributes:
        radiance: `[H, W, C]`, linear; premultiplied by coverage where the background is black.
        variance: `[H, W, C]`, of the pixel's value (not of one sample); nan where it was not estimated.
        samples: `[H, W]`, directions evaluated in the pixel.
        n: `[H, W]`, mean scatter count hint of the pixel's hits; 0 or nan where there is none.
        time: `[H, W]`, seconds: the tile's, shared out by samples.
        coverage: `[H, W]` in [0, 1], the share of the pixel's rays that met a fibre.
        depth: `[H, W]`, mean distance of the hits from the camera.
        attributes: where the image came from, as `str`, `float` or `int` of 32 bits.
    """

    radiance: Tensor
    variance: Tensor | None = None
    samples: Tensor | None = None
    n: Tensor | None = None
    time: Tensor | None = None
    coverage: Tensor | None = None
    depth: Tensor | None = None
    attributes: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        shape = tuple(self.radiance.shape)
        if len(shape) != 3 or shape[2] not in _COLORS or 0 in shape:
            raise InputError("image.radiance", shape, "shape [H, W, 3] or [H, W, 1], not empty")
        for name in self.layers:
            wanted = shape if name in ("radiance", "variance") else shape[:2]
            if tuple(getattr(self, name).shape) != wanted:
                raise InputError(f"image.{name}", tuple(getattr(self, name).shape), f"shape {list(wanted)}")

    @property
    def layers(self) -> tuple[str, ...]:
        """Names of the layers that are there."""
        names = [f.name for f in fields(self) if f.name != "attributes"]
        return tuple(name for name in names if getattr(self, name) is not None)

    @property
    def height(self) -> int:
        """Pixels from top to bottom."""
        return self.radiance.shape[0]

    @property
    def width(self) -> int:
        """Pixels from left to right."""
        return self.radiance.shape[1]

    @property
    def covered(self) -> Tensor:
        """`[H, W]` bool: pixels where a fibre was met; all of them if the coverage is not known."""
        if self.coverage is None:
            return torch.ones(self.radiance.shape[:2], dtype=torch.bool)
        return self.coverage > 0


def write_image(path: str | os.PathLike[str], image: RenderImage) -> Path:
    """Write all layers as float32 channels of one EXR file: R, G, B (or Y), variance.R .. variance.B, samples, n, time,
    A (coverage), depth; whole or not at all.

    float32 keeps samples exact to 2^24 per pixel. Nothing is stored as half floats: variances of 1e-6 would lose all
    but a few bits.

    Raises:
        InputError: an attribute that EXR cannot keep, or a directory that cannot be written to.
    """
    names = _COLORS[image.radiance.shape[2]]
    channels: dict[str, Tensor] = {}
    for layer in image.layers:
        values = getattr(image, layer).detach().to(torch.float32)
        if layer in ("radiance", "variance"):
            prefix = "" if layer == "radiance" else "variance."
            channels.update({prefix + name: values[..., k] for k, name in enumerate(names)})
        else:
            channels[_PLANES[layer]] = values
    return write_exr(path, channels, image.attributes)


def read_image(path: str | os.PathLike[str]) -> RenderImage:
    """Read an image of `write_image`, or any EXR image with R, G, B or Y: layers that it lacks are None.

    Raises:
        InputError: the file is missing or damaged, or has neither R, G, B nor Y.
    """
    found = read_exr(path)
    for names in reversed(_COLORS.values()):
        if set(names) <= set(found.channels):
            break
    else:
        raise InputError(f"EXR file {str(path)!r}", list(found.channels), "an image with channels R, G, B or Y")
    variance = tuple(f"variance.{name}" for name in names)
    planes = {layer: _plane(found, name) for layer, name in _PLANES.items()}
    return RenderImage(
        torch.stack([_plane(found, name) for name in names], -1),
        torch.stack([_plane(found, name) for name in variance], -1) if set(variance) <= set(found.channels) else None,
        **planes,
        attributes=found.metadata,
    )


def _plane(image: ExrImage, name: str) -> Tensor | None:
    return image.pixels[..., image.channels.index(name)] if name in image.channels else None
