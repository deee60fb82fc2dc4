"""Pictures of every technique side by side, with maps of their errors."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dsfit.experiment.compare_render_summary import painted, reference_of
from dsfit.experiment.files import number
from dsfit.experiment.plots.style import new_figure, short
from dsfit.experiment.race_report import seconds
from dsfit.experiment.rundir import RunDirectory
from dsfit.render.images import ToneMap, relative_squared_error

_MOST_COLUMNS = 7
_LOW, _HIGH = 0.01, 1.0
_TITLES = {"equal_time": "as much as fits into {} of CPU time", "equal_samples": "{} directions per hit"}


def compare_pictures(directory: RunDirectory, result: dict[str, Any]) -> Iterator[tuple[str, Figure]]:
    """For equal time and for equal samples: a crop of every technique's picture, below it the map of its relative error
    (root of the relative square, logarithmic, 1 % to 100 %) and its numbers; the reference comes last. And the whole
    pictures."""
    cells = painted(result)
    arrays = {cell["index"]: directory.arrays(cell["index"]) for cell in (result["cells"][0], *cells)}
    reference = torch.from_numpy(arrays[0]["radiance"])
    covered = torch.from_numpy(arrays[0]["coverage"]) > 0
    render = result["config"]["render"]
    tone = ToneMap(render.get("exposure"), render["tone_map"]).fixed(reference, covered)
    for which, title in _TITLES.items():
        amount = result["config"]["compare"][which.replace("time", "seconds")]
        text = title.format(seconds(amount) if which == "equal_time" else amount)
        heading = f"{short(result['title'] or result['name'], 90)}: {text}"
        for name, window in (("crops", _window(reference, result)), ("pictures", (slice(None), slice(None)))):
            yield f"{which}-{name}", _sheet(cells, arrays, which, reference, tone, window, result, heading)


def _window(reference: torch.Tensor, result: dict[str, Any]) -> tuple[slice, slice]:
    height, width, _ = reference.shape
    left, top, right, bottom = (number(x) for x in result["config"]["compare"]["crop"])
    rows = slice(int(top * height), max(int(top * height) + 1, math.ceil(bottom * height)))
    return rows, slice(int(left * width), max(int(left * width) + 1, math.ceil(right * width)))


def _sheet(
    cells: list[dict[str, Any]], arrays: dict[int, dict[str, np.ndarray]], which: str, reference: torch.Tensor,
    tone: ToneMap, window: tuple[slice, slice], result: dict[str, Any], heading: str,
) -> Figure:  # fmt: skip
    facts = reference_of(result)
    count = len(cells) + 1
    lines = math.ceil(count / _MOST_COLUMNS)
    columns = math.ceil(count / lines)
    shape = reference[window].shape
    wide = 1.9
    tall = wide * shape[0] / shape[1]
    figure = new_figure(columns * wide + 0.9, lines * (2 * tall + 0.42) + 0.3)
    axes = figure.subplots(2 * lines, columns, squeeze=False)
    for axis in axes.flat:
        axis.set(xticks=[], yticks=[])
        axis.spines[:].set_visible(False)
    shown = None
    for k, cell in enumerate(cells):
        image = torch.from_numpy(arrays[cell["index"]][which])
        above, below = axes[2 * (k // columns)][k % columns], axes[2 * (k // columns) + 1][k % columns]
        _picture(above, image[window], tone, short(cell["technique"], 34))
        error = relative_squared_error(image, reference, number(facts["eps"])).sqrt()[window]
        shown = below.imshow(error.clamp_min(1e-6).numpy(), norm="log", cmap="magma", interpolation="nearest")
        shown.set_clim(_LOW, _HIGH)
        below.set_xlabel(_numbers(cell[which]), fontsize=6.5, labelpad=2)
    last = axes[2 * ((count - 1) // columns)][(count - 1) % columns]
    _picture(last, reference[window], tone, "reference")
    last.set_xlabel(f"own error {100 * number(facts['own_error']):.2g} %", fontsize=6.5, labelpad=2)
    if shown is not None:
        bar = figure.colorbar(shown, ax=axes, shrink=0.5, aspect=40, pad=0.01)
        bar.ax.tick_params(labelsize=6.5)
        bar.set_label("relative error", fontsize=7)
    figure.suptitle(heading, fontsize=9)
    return figure


def _picture(axis: Axes, image: torch.Tensor, tone: ToneMap, title: str) -> None:
    display = tone(image).expand(-1, -1, 3) if image.shape[-1] == 1 else tone(image)
    axis.imshow(display.clamp(0, 1).numpy(), interpolation="nearest")
    axis.set_title(title, fontsize=7, pad=2)


def _numbers(row: dict[str, Any]) -> str:
    error = f"{100 * number(row['error']):.3g} %"
    return f"error {error}, FLIP {number(row['flip']):.3f}\n{row['samples']} per hit, {seconds(row['seconds'])}"
