"""Figures of a run. They read the run directory's data only; nothing is computed here."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from dsfit.experiment.about import about_run
from dsfit.experiment.plots.checks import checks
from dsfit.experiment.plots.convergence import convergence
from dsfit.experiment.plots.excess import excess_bars, excess_grid
from dsfit.experiment.plots.maps import maps
from dsfit.experiment.plots.style import save, spread, styled
from dsfit.experiment.rundir import RunDirectory

__all__ = ["draw_all"]


def draw_all(directory: RunDirectory, result: dict[str, Any]) -> list[Path]:
    """Draw every figure that this kind of experiment has; returns the files written."""
    written: list[Path] = []
    source = about_run(directory, result)
    with styled():
        for name, figure in _figures(directory, result):
            written += save(figure, directory.path / "figures", name, source)
    return written


def _figures(directory: RunDirectory, result: dict[str, Any]) -> Iterator[tuple[str, Figure]]:
    if result["kind"] == "transmittance":
        from dsfit.experiment.plots.transmittance import transmittance

        yield from transmittance(directory, result)
        return
    if result["kind"] == "check":
        yield from checks(directory, result)
        return
    if result["kind"] == "race":
        from dsfit.experiment.plots.race import race

        yield "race", race(result)
        return
    if result["kind"] == "amortise":
        from dsfit.experiment.plots.amortise import amortise

        yield "amortised", amortise(directory, result)
        return
    if result["kind"] == "render":
        from dsfit.experiment.plots.render import render

        yield from render(directory)
        return
    if result["kind"] == "compare_render":
        from dsfit.experiment.plots.compare_render import compare_curves
        from dsfit.experiment.plots.compare_render_pictures import compare_pictures

        yield "curves", compare_curves(result)
        yield from compare_pictures(directory, result)
        return
    yield "convergence", convergence(result)
    yield "excess", excess_bars(result)
    if result["kind"] == "sweep" and (grid := excess_grid(result)) is not None:
        yield "sweep", grid
    for index in spread(len(result["cells"]), result["config"]["output"]["maps"]):
        yield f"maps-{index:04d}", maps(result["cells"][index], directory.arrays(index))
