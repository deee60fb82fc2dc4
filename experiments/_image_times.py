"""Ladders and times to equal error of a comparison on an image, as arrays."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from dsfit.experiment.compare_render_curve import Time
from dsfit.experiment.files import number

CURVE = ("samples", "seconds", "error", "standard_error")
TIMES = ("prepared", "counted", "alike", "heuristic", "uniform")
"""Seconds to the error without and with preparation; and how many times as long others take, as in
`dsfit.experiment.compare_render_summary.rows`."""
HOWS = ("unknown", "measured", "extrapolated", "at most", "more", "never")


def pack_curves(cells: list[dict[str, Any]]) -> np.ndarray:
    """`[techniques, rungs, CURVE]`, nan where there are no more rungs."""
    most = max(len(cell["rungs"]) for cell in cells)
    found = np.full((len(cells), most, len(CURVE)), np.nan, np.float32)
    for k, cell in enumerate(cells):
        for j, rung in enumerate(cell["rungs"]):
            error = number(rung["error"])
            spread = number(rung["relative"]["standard_error"]) / (2 * error) if error > 0 else math.nan
            found[k, j] = [rung["samples"], number(rung["seconds"]), error, spread]
    return found


def pack_times(rows: list[dict[str, Any]], targets: list[Any]) -> np.ndarray:
    """`[techniques, targets, TIMES, 2]`: the number, and the index of how it was found in HOWS."""
    found = np.zeros((len(rows), len(targets), len(TIMES), 2))
    for k, row in enumerate(rows):
        for j, target in enumerate(targets):
            times = row["to"][f"{number(target):g}"]
            found[k, j] = [[times[key].seconds, HOWS.index(times[key].how)] for key in TIMES]
    return found


def unpack_time(pair: np.ndarray) -> Time:
    """One of those times."""
    return Time(float(pair[0]), HOWS[int(pair[1])])
