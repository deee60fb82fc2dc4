"""Maps of the error of an image against a reference."""

from __future__ import annotations

import torch
from torch import Tensor

from dsfit.errors import InputError
from dsfit.render.images.tonemap import luminance

EPS_SHARE = 0.01
"""The default eps of relative errors, in units of the reference's mean square over covered pixels."""


def check_pair(image: Tensor, reference: Tensor) -> None:
    """Refuse images that cannot be compared.

    Raises:
        InputError: shapes that differ, or numbers that are not finite.
    """
    if image.ndim != 3 or image.shape != reference.shape:
        allowed = f"the size and channels of the reference, {_size(reference)}"
        raise InputError("image", _size(image), allowed)
    for name, values in (("image", image), ("reference", reference)):
        bad = ~torch.isfinite(values).all(-1)
        if bool(bad.any()):
            row, column = torch.nonzero(bad)[0].tolist()
            found = f"{int(bad.sum())} pixels that are not finite, the first in row {row}, column {column}"
            raise InputError(name, found, "finite radiance")


def _size(image: Tensor) -> str:
    if image.ndim != 3:
        return f"shape {list(image.shape)}"
    count = image.shape[2]
    return f"{image.shape[1]} x {image.shape[0]} pixels with {count} channel{'s' if count != 1 else ''}"


def default_eps(reference: Tensor, covered: Tensor | None = None) -> float:
    """0.01 x mean of the reference's squares over covered pixels (1 where that is 0): the same picture at twice the
    brightness has the same relative errors."""
    chosen = reference.to(torch.float64).flatten(0, 1) if covered is None else reference.to(torch.float64)[covered]
    square = float(chosen.square().mean()) if chosen.numel() else 0.0
    return EPS_SHARE * square if square > 0 else 1.0


def signed_error(image: Tensor, reference: Tensor) -> Tensor:
    """Luminance of image - reference, `[H, W]`, in float64."""
    check_pair(image, reference)
    return luminance(image.to(torch.float64) - reference.to(torch.float64))


def relative_squared_error(image: Tensor, reference: Tensor, eps: float) -> Tensor:
    """Mean over channels of (image - reference)^2 / (reference^2 + eps), `[H, W]`, in float64 (F. Rousselle, C. Knaus,
    M. Zwicker, "Adaptive sampling and reconstruction using greedy error minimization", 2011)."""
    check_pair(image, reference)
    ref = reference.to(torch.float64)
    return ((image.to(torch.float64) - ref).square() / (ref.square() + eps)).mean(-1)
