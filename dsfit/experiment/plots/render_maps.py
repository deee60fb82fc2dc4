"""False-colour maps of rendered images."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from torch import Tensor

from dsfit.experiment.plots.style import new_figure
from dsfit.render.images import Flip, RenderImage, relative_squared_error, signed_error

_EMPTY = "#d9d9d9"
_HEIGHT = 4.2
_DECADES = 4


def layer_map(values: Tensor, covered: Tensor, title: str, *, log: bool = False) -> Figure:
    """One layer `[H, W]` over covered pixels, grey elsewhere; from the 1st to the 99th percentile (0 to the 99th of
    the layer's own values where it has zeros), stated at the bar's ends by arrows."""
    figure = new_figure(*_size(values.shape, 1))
    shown = _masked(values, covered)
    _panel(figure, figure.subplots(), shown, title, _log_range(shown) if log else _plain_range(shown), "viridis")
    return figure


def error_maps(image: RenderImage, reference: RenderImage, eps: float, flip: Flip, title: str) -> Figure:
    """Signed error of luminance, relative squared error and FLIP of an image, over what the reference covers; the
    ranges are in the titles."""
    covered = reference.covered
    figure = new_figure(*_size(covered.shape, 3))
    axes = figure.subplots(1, 3)
    signed = _masked(signed_error(image.radiance, reference.radiance), covered)
    high = float(np.nanpercentile(np.abs(signed.compressed()), 99)) if signed.count() else 0.0
    high = high if high > 0 else 1.0
    text = f"luminance, image − reference\n±{high:.2g} (99th percentile)"
    _panel(figure, axes[0], signed, text, Normalize(-high, high), "RdBu_r")
    relative = _masked(relative_squared_error(image.radiance, reference.radiance, eps), covered)
    norm = _log_range(relative)
    text = f"(image − reference)² / (reference² + {eps:.2g})\n{norm.vmin:.1e} to {norm.vmax:.1e}"
    _panel(figure, axes[1], relative, text, norm, "viridis")
    flips = _masked(flip.map, covered)
    most = float(np.percentile(flips.compressed(), 99)) if flips.count() else 1.0
    high = next((x for x in (0.05, 0.1, 0.2, 0.5) if x >= most), 1.0)
    text = f"HDR-FLIP, {flip.pixels_per_degree:g} pixels per degree\n0 to {high:g}"
    _panel(figure, axes[2], flips, text, Normalize(0, high), "magma")
    figure.suptitle(title, fontsize=10)
    return figure


def _size(shape: torch.Size, panels: int) -> tuple[float, float]:
    """Inches for images of this shape side by side, with room for bars and titles."""
    height, width = shape
    one = min(max(_HEIGHT * width / height, 1.8), 9.0)
    return panels * (one + 0.9), min(_HEIGHT, one * height / width) + 0.8


def _masked(values: Tensor, covered: Tensor) -> np.ma.MaskedArray:
    array = values.detach().to(torch.float64).numpy()
    return np.ma.masked_array(array, mask=~(covered.numpy() & np.isfinite(array)))


def _plain_range(values: np.ma.MaskedArray) -> Normalize:
    if not values.count():
        return Normalize(0.0, 1.0)
    low, high = (float(x) for x in np.percentile(values.compressed(), [1, 99]))
    low = 0.0 if low < 0.2 * high else low
    return Normalize(low, high if high > low else low + 1.0)


def _log_range(values: np.ma.MaskedArray) -> Normalize:
    """Decades below the 99.5th percentile, at most four."""
    positive = values.compressed()
    positive = positive[positive > 0]
    if not len(positive):
        return LogNorm(1e-4, 1.0)
    low, high = (float(x) for x in np.percentile(positive, [1, 99.5]))
    high = 10.0 ** math.ceil(math.log10(high))
    low = max(10.0 ** math.floor(math.log10(low)), high * 10.0**-_DECADES)
    return LogNorm(low, high)


def _panel(figure: Figure, axes: Axes, values: Any, title: str, norm: Normalize, colours: str) -> None:
    import matplotlib

    if isinstance(norm, LogNorm):
        values = np.ma.masked_array(np.maximum(values.filled(norm.vmin), norm.vmin), mask=values.mask)
    picture = axes.imshow(
        values, norm=norm, cmap=matplotlib.colormaps[colours].with_extremes(bad=_EMPTY), interpolation="nearest"
    )
    axes.set_axis_off()
    axes.set_title(title)
    figure.colorbar(picture, ax=axes, shrink=0.9, aspect=30, extend=_beyond(values, norm))


def _beyond(values: Any, norm: Normalize) -> str:
    """Which ends of the bar have values beyond them."""
    if not values.count():
        return "neither"
    low, high = values.min() < norm.vmin, values.max() > norm.vmax
    return "both" if low and high else "min" if low else "max" if high else "neither"
