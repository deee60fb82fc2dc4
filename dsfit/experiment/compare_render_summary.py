"""What a comparison on an image comes to: one row per technique, times to equal errors and their ratios."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from dsfit.experiment.compare_render_curve import Time, ratio, time_to
from dsfit.experiment.files import number

HEURISTICS = ("single", "chapter", "stream_mix", "best_mix", "heuristic_mix")
"""Techniques made of the chapter's proposals: what "best heuristic" is taken from."""
_NO_TIME = Time(math.nan, "unknown")


def reference_of(result: dict[str, Any]) -> dict[str, Any]:
    """Facts of the reference."""
    return result["cells"][0]["reference"]


def painted(result: dict[str, Any]) -> list[dict[str, Any]]:
    """Cells of the techniques that ran."""
    return [cell for cell in result["cells"][1:] if "rungs" in cell]


def times(cell: dict[str, Any], target: float, *, counted: bool) -> Time:
    """Seconds until the technique's relative error is `target`; `counted` says whether its preparation is."""
    before = number(cell["prepare"]["seconds"]) if counted else 0.0
    seconds, errors = ([number(rung[key]) for rung in cell["rungs"]] for key in ("seconds", "error"))
    return time_to(target, seconds, errors, cell["uniforms"], before)


def honest(cell: dict[str, Any]) -> bool:
    """Whether the technique's error can be believed: neither biased nor decided by a few pixels."""
    return not cell["biased"] and not cell["heavy"]


def samples_light(cell: dict[str, Any]) -> bool:
    """Whether part of the technique's samples go to the light."""
    options = cell["options"]
    own = {"best_mix": options.get("light_sampling", True), "guided": options.get("lights", 1), "light": True}
    return number(cell["light"]) > 0 or bool(own.get(cell["kind"], False))


def rows(result: dict[str, Any]) -> list[dict[str, Any]]:
    """One row per technique.

    Fields: `name`, `kind`, `uniforms`, `light`, `failed` (why, or None), and for those that ran `prepare` (seconds),
    `per_sample` (seconds per direction, at the longest rung), `slope`, `equal_time` and `equal_samples` (samples,
    seconds, error, flip), `heavy`, `biased`, `darker` (1 - mean over the reference's, of the longest rung), and `to`:
    for every target `{prepared, counted, alike, heuristic, uniform}`, `Time`s: seconds without and with preparation,
    and how many times as long (prepared) others take: the best heuristic with the same points and, if this one has it,
    light sampling; the best heuristic with random points and without light sampling; uniform directions likewise.
    """
    cells, hits = painted(result), number(reference_of(result)["hits"])
    found = []
    for cell in result["cells"][1:]:
        row = {key: cell[key] for key in ("kind", "uniforms", "light")}
        row.update(name=cell["technique"], failed=cell.get("failed"))
        if "rungs" in cell:
            last = cell["rungs"][-1]
            row.update(
                prepare=number(cell["prepare"]["seconds"]),
                per_sample=number(last["seconds"]) / (hits * last["samples"]),
                slope=number(cell["slope"]),
                equal_time=cell["equal_time"],
                equal_samples=cell["equal_samples"],
                heavy=cell["heavy"],
                biased=cell["biased"],
                darker=-number(last["mean"]["difference"]),
                to={f"{t:g}": _target(cell, cells, number(t)) for t in result["config"]["compare"]["targets"]},
            )
        found.append(row)
    return found


def _target(cell: dict[str, Any], cells: list[dict[str, Any]], target: float) -> dict[str, Time]:
    own = times(cell, target, counted=False)

    def best(wanted: Callable[[dict[str, Any]], bool]) -> Time:
        others = [times(c, target, counted=False) for c in cells if c is not cell and honest(c) and wanted(c)]
        known = [t for t in others if t.how != "never"]
        return ratio(min(known, key=lambda t: t.seconds), own) if known else _NO_TIME

    def alike(c: dict[str, Any]) -> bool:
        return c["uniforms"] == cell["uniforms"] and samples_light(c) == samples_light(cell)

    def plain(c: dict[str, Any]) -> bool:
        return c["uniforms"] == "random" and not samples_light(c)

    return {
        "prepared": own,
        "counted": times(cell, target, counted=True),
        "alike": best(lambda c: c["kind"] in HEURISTICS and alike(c)),
        "heuristic": best(lambda c: c["kind"] in HEURISTICS and plain(c)),
        "uniform": best(lambda c: c["kind"] == "uniform" and plain(c)),
    }
