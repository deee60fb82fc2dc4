"""From radiance to a PNG: exposure, a tone curve, the sRGB transfer function."""

from __future__ import annotations

import io
import os
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from dsfit.errors import InputError, as_number, check_choice

CURVES = ("srgb", "filmic")
PERCENTILE = 0.99


def luminance(radiance: Tensor) -> Tensor:
    """Relative luminance `[..]` of linear sRGB `[.., 3]` (ITU-R BT.709: 0.2126 R + 0.7152 G + 0.0722 B), or of one
    channel `[.., 1]`."""
    if radiance.shape[-1] == 1:
        return radiance[..., 0]
    return radiance @ torch.tensor([0.2126, 0.7152, 0.0722], dtype=radiance.dtype)


@dataclass(frozen=True)
class ToneMap:
    """display = transfer(curve(exposure x radiance)), each channel on its own.

    `curve`: "srgb" clips to [0, 1]; "filmic" is y (2.51 y + 0.03) / (y (2.43 y + 0.59) + 0.14) with y = 0.6 x, clipped,
    a fit to the ACES curve (K. Narkowicz, "ACES Filmic Tone Mapping Curve", 2015), which HDR-FLIP sees through, too:
    contrast at the foot, a soft shoulder.
    `transfer` is that of sRGB (IEC 61966-2-1): 12.92 y up to y = 0.0031308, 1.055 y^(1/2.4) - 0.055 above.

    Args:
        exposure: factor on the radiance, > 0. Left out, 1 over the 99th percentile of the luminance of covered pixels
            (1 where that is 0), which "srgb" shows as white and "filmic" as 67 % of it (linear).
        curve: "srgb" or "filmic".

    Raises:
        InputError: an exposure that is not a number > 0, or an unknown curve.
    """

    exposure: float | None = None
    curve: str = "filmic"

    def __post_init__(self) -> None:
        check_choice("tonemap.curve", self.curve, CURVES)
        if self.exposure is not None:
            object.__setattr__(self, "exposure", as_number("tonemap.exposure", self.exposure, 0.0, open_low=True))

    def fixed(self, radiance: Tensor, covered: Tensor | None = None) -> ToneMap:
        """This tone map with the exposure that it chooses for an image `[H, W, C]` (given to others of a series, all
        are shown alike).

        Raises:
            InputError: radiance that is not finite.
        """
        _check(radiance)
        if self.exposure is not None:
            return self
        values = luminance(radiance.to(torch.float64))
        values = values.flatten() if covered is None else values[covered]
        if not len(values):
            return ToneMap(1.0, self.curve)
        rank = max(1, -int(-PERCENTILE * len(values) // 1))  # torch.quantile takes no more than 2^24 numbers
        white = float(torch.kthvalue(values, rank).values)
        return ToneMap(1.0 / white if white > 0 else 1.0, self.curve)

    def __call__(self, radiance: Tensor, covered: Tensor | None = None) -> Tensor:
        """Display values in [0, 1] of radiance `[H, W, C]`, in its dtype. Negative radiance is shown as black.

        Raises:
            InputError: radiance that is not finite.
        """
        exposure = self.fixed(radiance, covered).exposure
        x = (radiance * exposure).clamp(min=0.0)
        if self.curve == "filmic":
            y = 0.6 * x.clamp(max=1e6)  # white long before; beyond, the squares overflow
            x = y * (2.51 * y + 0.03) / (y * (2.43 * y + 0.59) + 0.14)
        return transfer(x.clamp(max=1.0))

    def describe(self) -> str:
        """The formula in one line."""
        exposure = "1 / 99th percentile of the luminance" if self.exposure is None else f"{self.exposure:.6g}"
        curve = "filmic (Narkowicz 2015)" if self.curve == "filmic" else "clipped"
        return f"exposure {exposure}, {curve}, sRGB transfer"


def transfer(linear: Tensor) -> Tensor:
    """The sRGB transfer function (IEC 61966-2-1) on [0, 1]."""
    high = 1.055 * linear.clamp(min=0.0031308) ** (1 / 2.4) - 0.055
    return torch.where(linear <= 0.0031308, 12.92 * linear, high)


def write_png(path: str | os.PathLike[str], display: Tensor, text: dict[str, str] | None = None) -> Path:
    """Write display values `[H, W, 3]` or `[H, W, 1]` in [0, 1] as an 8-bit PNG, round(255 x); whole or not at all.

    Args:
        text: what the file says about itself (tEXt chunks).

    Raises:
        InputError: another shape, or values that are not finite.
    """
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    from dsfit.experiment.files import write_bytes

    if display.ndim != 3 or display.shape[2] not in (1, 3) or 0 in display.shape:
        raise InputError("png", tuple(display.shape), "shape [H, W, 3] or [H, W, 1], not empty")
    _check(display)
    pixels = (display.detach().to(torch.float64).clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    about = PngInfo()
    for key, value in (text or {}).items():
        about.add_text(key, value)
    buffer = io.BytesIO()
    Image.fromarray(pixels if pixels.shape[2] == 3 else pixels[..., 0]).save(buffer, "png", pnginfo=about)
    write_bytes(path, buffer.getvalue())
    return Path(path)


def _check(radiance: Tensor) -> None:
    bad = ~torch.isfinite(radiance)
    if bool(bad.any()):
        row, column = (int(k) for k in torch.nonzero(bad)[0][:2])
        found = f"{int(bad.any(-1).sum())} pixels that are not finite, the first in row {row}, column {column}"
        raise InputError("image", found, "finite radiance")
