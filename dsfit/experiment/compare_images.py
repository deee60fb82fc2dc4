"""`dsfit compare-images`: the errors of one image file against another."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.table import Table

from dsfit.errors import InputError
from dsfit.experiment.about import About, about, digest
from dsfit.render.images import Flip, ImageErrors, RenderImage, hdr_flip, image_errors, read_image
from dsfit.render.images.metrics import Corrected


@dataclass(frozen=True)
class Comparison:
    """An image, its reference, the errors, and where their maps are."""

    image: RenderImage
    reference: RenderImage
    errors: ImageErrors
    flip: Flip
    picture: Path


def compare_files(image: Path, reference: Path, out: Path | None = None) -> Comparison:
    """Compare two EXR files and draw the maps of the errors.

    Args:
        image: judged.
        reference: judged against; its layers "variance" and "A" (coverage), if there, say what its own error is and
            which pixels count.
        out: folder of the picture; left out, that of the image.

    Raises:
        InputError: a file that cannot be read, sizes or channels that differ, radiance that is not finite.
        OSError: a folder that cannot be written to.
    """
    pair = read_image(image), read_image(reference)
    first, second = (tuple(one.radiance.shape) for one in pair)
    if first != second:
        sizes = [f"{w} x {h} pixels, {c} channel{'s' if c > 1 else ''}" for h, w, c in (first, second)]
        raise InputError(str(image), sizes[0], f"the size and channels of {reference}: {sizes[1]}")
    errors, flip = image_errors(*pair), hdr_flip(*pair)
    folder = image.parent if out is None else out
    names = image.stem, reference.stem
    if names[0] == names[1]:  # image.exr of two runs
        names = tuple(f"{path.resolve().parent.name}-{path.stem}" for path in (image, reference))
    picture = folder / f"{names[0]}-against-{names[1]}.png"
    title = " against ".join(names)
    source = about(title, data=digest(path.read_bytes() for path in (image, reference)))
    _draw(pair, errors, flip, title, picture, source)
    return Comparison(*pair, errors, flip, picture)


def _draw(
    pair: tuple[RenderImage, RenderImage], errors: ImageErrors, flip: Flip, title: str, path: Path, source: About
) -> None:
    from dsfit.experiment.plots.render_maps import error_maps
    from dsfit.experiment.plots.style import styled, write_figure

    with styled():
        write_figure(error_maps(*pair, errors.eps, flip, title), path, source)


def rows(found: Comparison) -> list[tuple[str, str, str, str]]:
    """Name, value, the reference's share in it, and the value without that share."""
    e, f = found.errors, found.flip
    trimmed = f"relative MSE without the worst 0.1 % ({e.trimmed_pixels} pixels)"
    return [
        ("MSE", _short(e.mse.measured), _short(e.mse.of_reference), _within(e.mse)),
        ("RMSE", _short(e.rmse), _short(math.sqrt(e.mse.of_reference)), _short(e.mse.root)),
        (f"relative MSE, eps {e.eps:.3g}", _short(e.relative.measured), _short(e.relative.of_reference),
         _within(e.relative)),
        (trimmed, _short(e.trimmed), "-", "-"),
        ("variance that the image states", _short(e.predicted), "-", "-"),
        ("FLIP, covered pixels", _short(f.covered), _short(f.of_reference), "-"),
        ("FLIP, all pixels", _short(f.mean), "-", "-"),
        ("mean radiance: image, reference", _short(e.mean_image), _short(e.mean_reference), "-"),
    ]  # fmt: skip


def _short(value: float) -> str:
    if math.isnan(value):
        return "-"
    return f"{value:.4g}" if value == 0 or 1e-3 <= abs(value) < 1e4 else f"{value:.3e}"


def _within(value: Corrected) -> str:
    if math.isnan(value.value):
        return "-"
    return f"{_short(value.value)} ± {_short(value.standard_error)}"


def table(found: Comparison) -> Table:
    """The errors as a rich table, with what they mean below it."""
    made = Table(caption=caption(found), caption_justify="left")
    made.add_column("", overflow="fold")
    for name in ("measured", "of the reference", "without it"):
        made.add_column(name, justify="right", no_wrap=True)
    for row in rows(found):
        made.add_row(*row)
    return made


def caption(found: Comparison) -> str:
    """What the numbers are, in words."""
    first, last, count = found.flip.exposures
    lines = [
        f"{found.errors.pixels} pixels that the reference covers; means over pixels and channels. "
        "± one standard error.",
        f"HDR-FLIP: {count} exposures from {first:+.2f} to {last:+.2f} stops (from the reference), ACES, "
        f"{found.flip.pixels_per_degree:g} pixels per degree; the reference's: against itself with its own noise.",
    ]
    if found.reference.variance is None:
        lines.append("The reference does not state its variance: its own error is in all numbers.")
    return "\n".join([*lines, *_kinship(found.image.attributes, found.reference.attributes)])


def _kinship(image: Mapping[str, Any], reference: Mapping[str, Any]) -> list[str]:
    """What the files say about themselves that matters to the numbers."""
    if "dsfit.run" not in image or "dsfit.run" not in reference:
        return []
    if image["dsfit.run"] == reference["dsfit.run"]:
        return ["Both are of the same run: their noise is the same."]
    if any(image.get(key) != reference.get(key) for key in ("dsfit.seed", "dsfit.subsamples")):
        return ["Seeds or rays per pixel differ: the difference of the rays' places is in all numbers, too."]
    return []
