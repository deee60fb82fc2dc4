"""The error of an image in numbers, the reference's own error included."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from dsfit.errors import InputError, as_number
from dsfit.render.images.errors import check_pair, default_eps
from dsfit.render.images.layers import RenderImage

TRIMMED = 0.001
"""Share of the pixels, the worst, that the trimmed error leaves out."""


@dataclass(frozen=True)
class Corrected:
    """A mean square error against a noisy reference, and what is left of it without the reference's noise.

    E|x - r|^2 = |E x - E r|^2 + var x + var r for independent x and r: the reference's own variance is in every error
    measured against it, and is subtracted here. Relative errors have r also below the fraction: their correction holds
    to first order in var r / (r^2 + eps).

    Attributes:
        measured: mean over covered pixels and channels, as it comes out.
        of_reference: mean of the reference's own share; nan where its variance is not known.
        value: measured - of_reference; may be negative where the image is as good as the reference.
        standard_error: of `value`, from its spread over pixels, taken as independent. It includes the spread of the
            true errors between pixels, so it is too large rather than too small.
    """

    measured: float
    of_reference: float
    value: float
    standard_error: float

    @property
    def root(self) -> float:
        """Square root of `value`, 0 where that is negative."""
        return math.sqrt(max(self.value, 0.0)) if not math.isnan(self.value) else math.nan


@dataclass(frozen=True)
class ImageErrors:
    """Errors of an image against a reference, over the pixels that the reference covers.

    Attributes:
        pixels: number of pixels.
        mse: of radiance, mean over pixels and channels.
        rmse: square root of `mse.measured`.
        relative: mean of (x - r)^2 / (r^2 + eps).
        eps: in it.
        trimmed: the relative error without the worst 0.1 % of the pixels (at least one); not corrected, because
            trimming cuts the reference's noise too.
        trimmed_pixels: how many that are.
        predicted: mean of the image's own variance, to be compared with `mse.value`; nan where it is not known. Both
            agree where the image is unbiased and its variance well estimated.
        mean_image, mean_reference: mean radiance over pixels and channels.
    """

    pixels: int
    mse: Corrected
    rmse: float
    relative: Corrected
    eps: float
    trimmed: float
    trimmed_pixels: int
    predicted: float
    mean_image: float
    mean_reference: float


def image_errors(image: RenderImage, reference: RenderImage, *, eps: float | None = None) -> ImageErrors:
    """Errors of an image against a reference of the same size, in float64.

    Args:
        image: its `variance`, if there, is compared with the error.
        reference: an independent image; its `coverage` says which pixels count, its `variance` what its own error is.
        eps: > 0; left out, 0.01 times the mean of the reference's squares.

    Raises:
        InputError: sizes or channels that differ, radiance that is not finite, no covered pixel, eps <= 0.
    """
    check_pair(image.radiance, reference.radiance)
    covered = reference.covered
    if not bool(covered.any()):
        raise InputError("reference.coverage", "0 everywhere", "a reference that covers at least one pixel")
    x, r = (one.radiance[covered].to(torch.float64) for one in (image, reference))
    own = _chosen(reference.variance, covered)
    eps = default_eps(reference.radiance, covered) if eps is None else as_number("eps", eps, 0.0, open_low=True)
    square, scale = (x - r).square(), r.square() + eps
    relative = (square / scale).mean(-1)
    cut = math.ceil(TRIMMED * len(relative))
    kept = torch.sort(relative).values[: len(relative) - cut]
    predicted = _chosen(image.variance, covered)
    mse = _corrected(square.mean(-1), own)
    return ImageErrors(
        pixels=len(x),
        mse=mse,
        rmse=math.sqrt(mse.measured),
        relative=_corrected(relative, None if own is None else own / scale),
        eps=eps,
        trimmed=float(kept.mean()) if len(kept) else math.nan,
        trimmed_pixels=cut,
        predicted=math.nan if predicted is None else float(predicted.mean()),
        mean_image=float(x.mean()),
        mean_reference=float(r.mean()),
    )


def _chosen(variance: Tensor | None, covered: Tensor) -> Tensor | None:
    """Variances `[P, C]` of covered pixels; None where any of them is not known."""
    if variance is None:
        return None
    chosen = variance[covered].to(torch.float64)
    return chosen if bool(torch.isfinite(chosen).all()) else None


def _corrected(measured: Tensor, own: Tensor | None) -> Corrected:
    """From the measured error `[P]` of every pixel and the reference's share `[P, C]` of it."""
    mean = float(measured.mean())
    if own is None:
        return Corrected(mean, math.nan, math.nan, math.nan)
    share = own.mean(-1)
    left = measured - share
    error = float(left.std()) / math.sqrt(len(left)) if len(left) > 1 else math.nan
    return Corrected(mean, float(share.mean()), float(left.mean()), error)
