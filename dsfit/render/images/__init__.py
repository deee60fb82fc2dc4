"""Finished images: layers in EXR, tone-mapped PNG, errors against a reference."""

from __future__ import annotations

from dsfit.render.images.errors import relative_squared_error, signed_error
from dsfit.render.images.flip import Flip, hdr_flip
from dsfit.render.images.layers import RenderImage, read_image, write_image
from dsfit.render.images.metrics import ImageErrors, image_errors
from dsfit.render.images.tonemap import ToneMap, luminance, write_png

__all__ = [
    "Flip",
    "ImageErrors",
    "RenderImage",
    "ToneMap",
    "hdr_flip",
    "image_errors",
    "luminance",
    "read_image",
    "relative_squared_error",
    "signed_error",
    "write_image",
    "write_png",
]
