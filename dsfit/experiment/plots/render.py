"""Figures of a rendering: scatter counts, variance and time per pixel."""

from __future__ import annotations

from collections.abc import Iterator

from matplotlib.figure import Figure

from dsfit.experiment.plots.render_maps import layer_map
from dsfit.experiment.rundir import RunDirectory
from dsfit.render.images import read_image


def render(directory: RunDirectory) -> Iterator[tuple[str, Figure]]:
    """Maps of n, variance and time from the run's image."""
    image = read_image(directory.path / "image.exr")
    covered = image.covered
    if image.n is not None:
        yield "n", layer_map(image.n, covered, "fibres that the light has passed, n")
    if image.variance is not None:
        yield "variance", layer_map(image.variance.mean(-1), covered, "variance of the pixel's radiance", log=True)
    if image.time is not None:
        yield "time", layer_map(image.time * 1e3, covered, "CPU time per pixel / ms")
