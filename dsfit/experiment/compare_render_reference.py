"""The reference image of a comparison: its own error from independent passes, and a second technique that checks it."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dsfit.errors import InputError
from dsfit.experiment import files
from dsfit.experiment.rundir import RunDirectory
from dsfit.render.images import RenderImage

LEVEL = 1e-4
"""The reference and its check differ where differences as large have a smaller probability than this."""
_BLOCKS = 8
_FEWEST = 16


def reference_image(
    key: str, directory: RunDirectory, make: Callable[[], tuple[RenderImage, dict[str, Any]]]
) -> tuple[RenderImage, dict[str, Any]]:
    """The reference of this key: from the run directory, or made and stored there."""
    stem = f"reference-{hashlib.sha256(key.encode()).hexdigest()[:12]}"
    arrays, facts = directory.path / "cells" / f"{stem}.npz", directory.path / "cells" / f"{stem}.json"
    try:
        stored = {name: torch.from_numpy(value) for name, value in files.read_arrays(arrays).items()}
        return RenderImage(**stored), files.read_json(facts, 1)["facts"]
    except (InputError, KeyError, TypeError):
        pass
    image, found = make()
    files.write_arrays(arrays, {name: getattr(image, name).numpy() for name in image.layers})
    files.write_json(facts, {"schema_version": 1, "facts": found})
    return image, found


def own_error(image: RenderImage, eps: float) -> float:
    """Root mean relative variance of the reference over covered pixels: the error that any image measured against it
    has at least."""
    covered = image.covered
    assert image.variance is not None
    r, variance = (x[covered].to(torch.float64) for x in (image.radiance, image.variance))
    return math.sqrt(float((variance / (r.square() + eps)).mean()))


def agreement(reference: RenderImage, check: RenderImage) -> dict[str, Any]:
    """Whether two images of independent techniques have the same expectation.

    Means of the whole picture and of 8 x 8 blocks, per channel, are compared in units of their standard errors, from
    the variances of both images' pixels. Blocks with fewer than 16 covered pixels are left out. Fields: `difference`
    (check over reference - 1, all pixels, mean of channels), `standard_error` of it, `p_value` (the least of all
    comparisons, with Sidak's correction), `largest_z`, `blocks`, `verdict` ("agree" or "differ").
    """
    covered = reference.covered
    assert reference.variance is not None and check.variance is not None
    difference = (check.radiance - reference.radiance).to(torch.float64) * covered.unsqueeze(-1)
    variance = (check.variance + reference.variance).to(torch.float64) * covered.unsqueeze(-1)
    total = (reference.radiance.to(torch.float64) * covered.unsqueeze(-1)).sum((0, 1))
    z = [difference.sum((0, 1)) / variance.sum((0, 1)).clamp_min(1e-300).sqrt()]
    blocks = [block for block in _blocks(*covered.shape) if int(covered[block].sum()) >= _FEWEST]
    for block in blocks:
        z.append(difference[block].sum((0, 1)) / variance[block].sum((0, 1)).clamp_min(1e-300).sqrt())
    largest = float(torch.cat(z).abs().max())
    p = _sidak(math.erfc(largest / math.sqrt(2)), sum(map(len, z)))
    relative = difference.sum((0, 1)) / total.clamp_min(1e-300)
    error = variance.sum((0, 1)).sqrt() / total.clamp_min(1e-300)
    return {
        "difference": float(relative.mean()),
        "standard_error": float(error.square().mean().sqrt()),
        "p_value": p,
        "largest_z": largest,
        "blocks": len(blocks),
        "verdict": "agree" if p > LEVEL else "differ",
    }


def _blocks(height: int, width: int) -> list[tuple[slice, slice]]:
    rows, columns = (np.linspace(0, size, min(_BLOCKS, size) + 1).astype(int) for size in (height, width))
    return [
        (slice(int(a), int(b)), slice(int(c), int(d)))
        for a, b in zip(rows, rows[1:], strict=False)
        for c, d in zip(columns, columns[1:], strict=False)
    ]


def _sidak(p: float, count: int) -> float:
    return -math.expm1(count * math.log1p(-min(p, 1 - 1e-16)))


def centred(image: Tensor, reference: RenderImage) -> dict[str, float]:
    """Whether an image without known variance is off the reference as a whole.

    Differences of pixels are independent and, without bias, have mean 0: their spread over pixels gives the standard
    error of their mean. Fields: `difference` (image over reference - 1), `standard_error`, `z` (the largest of the
    channels). The reference's error is in the spread.
    """
    covered = reference.covered
    d = (image - reference.radiance)[covered].to(torch.float64)
    total = reference.radiance[covered].to(torch.float64).sum(0).clamp_min(1e-300)
    error = d.square().sum(0).sqrt()
    z = d.sum(0).abs() / error.clamp_min(1e-300)
    return {
        "difference": float((d.sum(0) / total).mean()),
        "standard_error": float((error / total).square().mean().sqrt()),
        "z": float(z.max()),
    }
