"""HDR-FLIP: how different two images look when one flips between them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from dsfit.errors import as_number
from dsfit.render.images.errors import check_pair
from dsfit.render.images.layers import RenderImage
from dsfit.render.images.tonemap import luminance

PIXELS_PER_DEGREE = 67.0
"""A 0.7 m wide screen of 3840 pixels seen from 0.7 m, the default of the FLIP papers."""
_WHITE = 2.118872
"""What the ACES curve of the FLIP papers maps to 0.85."""


@dataclass(frozen=True)
class Flip:
    """Result of HDR-FLIP (P. Andersson, J. Nilsson, P. Shirley, T. Akenine-Möller, "Visualizing errors in rendered high
    dynamic range images", 2021), by the authors' package, with the ACES tone mapper.

    Attributes:
        mean: over all pixels, in [0, 1].
        covered: mean over the pixels that the reference covers.
        of_reference: mean over covered pixels that the reference has against itself with noise of its own variance
            added: about what a perfect image would score. nan where the variance is not known.
        map: `[H, W]`, float32.
        exposures: first and last exposure in stops, and how many.
        pixels_per_degree: assumed.
    """

    mean: float
    covered: float
    of_reference: float
    map: Tensor
    exposures: tuple[float, float, int]
    pixels_per_degree: float


def exposures(reference: RenderImage) -> tuple[float, float, int]:
    """First and last exposure in stops, and how many, as the paper has them, over covered pixels only: from
    log2(2.119 / largest luminance) to log2(2.119 / median luminance), a stop apart or less, at least two.

    The paper takes the median of the whole image. Where most of it is a black background, that is 0, and 24 exposures
    up to 2^24 result.
    """
    bright = luminance(reference.radiance.to(torch.float64))[reference.covered]
    bright = bright[bright > 0]
    if not len(bright):
        return 0.0, 0.0, 2
    first, last = (math.log2(_WHITE / float(y)) for y in (bright.max(), bright.median()))
    return first, last, max(2, math.ceil(last - first))


def hdr_flip(
    image: RenderImage,
    reference: RenderImage,
    *,
    pixels_per_degree: float = PIXELS_PER_DEGREE,
    seed: int = 0,
) -> Flip:
    """HDR-FLIP of linear radiance; negative radiance counts as black, one channel as grey.

    The exposures come from the reference alone, so images compared with the same one are judged alike.

    Args:
        pixels_per_degree: of visual angle, > 0.
        seed: of the noise for `of_reference`.

    Raises:
        InputError: sizes or channels that differ, radiance that is not finite, pixels_per_degree <= 0.
    """
    check_pair(image.radiance, reference.radiance)
    degree = as_number("pixels_per_degree", pixels_per_degree, 0.0, open_low=True)
    used, covered = exposures(reference), reference.covered
    errors = _evaluate(reference.radiance, image.radiance, used, degree)
    own = math.nan
    if reference.variance is not None and bool(torch.isfinite(reference.variance[covered]).all()):
        noise = torch.randn(reference.radiance.shape, generator=torch.Generator().manual_seed(seed))
        spread = torch.where(covered.unsqueeze(-1), reference.variance, 0.0).clamp(min=0).sqrt()
        noisy = _evaluate(reference.radiance, reference.radiance + spread * noise, used, degree)
        own = _mean(noisy[covered])
    return Flip(_mean(errors), _mean(errors[covered]), own, errors, used, degree)


def _mean(errors: Tensor) -> float:
    return float(errors.to(torch.float64).mean()) if errors.numel() else math.nan


def _evaluate(reference: Tensor, test: Tensor, exposures: tuple[float, float, int], degree: float) -> Tensor:
    import flip_evaluator

    first, last, count = exposures
    parameters = {"ppd": degree, "startExposure": first, "stopExposure": last, "numExposures": count}
    pair = []
    for image in (reference, test):
        values = image.detach().to(torch.float32).clamp(min=0).numpy()
        pair.append(np.array(np.broadcast_to(values, (*values.shape[:2], 3)), order="C"))
    # with all exposures given: finding them itself, the package ends the process on a black reference
    errors, _, _ = flip_evaluator.evaluate(
        *pair, "HDR", applyMagma=False, parameters={**parameters, "tonemapper": "ACES"}
    )
    return torch.from_numpy(np.array(errors, np.float32)[..., 0])
