"""A race as arrays: what its curves, tables and winners are made from, and back again."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from dsfit.experiment.files import number

FIELDS = ("samples", "seconds", "value", "low", "high", "heavy")
"""Of every rung: samples per context; seconds; root mean square of the relative error and the ends of its 95 %
interval; whether one estimate decides it. Rungs that were timed only have no error."""
ROW = ("at_seconds", "predicted_variance", "contexts", "subset")
"""Of the stream, or of a context: seconds of work per context, variance of a sample by quadrature; of the stream the
number of contexts, and on how many the peer ran."""


def pack(cells: list[dict[str, Any]]) -> tuple[dict[str, np.ndarray], list[dict[str, Any]]]:
    """Arrays `points` `[peers, rows, rungs, fields]`, `rows` `[peers, rows, fields]` (row 0: the stream; nan: nothing
    there), `prepare` `[peers]`, and what is known of each peer."""
    names = list(dict.fromkeys(cell["peer"] for cell in cells))
    found: list[list[dict[str, Any] | None]] = []
    peers, prepare = [], []
    for name in names:
        own = {cell["group"]: cell for cell in cells if cell["peer"] == name}
        first = next(iter(own.values()))
        contexts = own.get("contexts", {}).get("contexts") or []
        found.append([own.get("stream", {}).get("stream"), *contexts])
        skipped = next((cell["skipped"] for cell in own.values() if cell.get("skipped")), None)
        verdicts = [cell["verdict"] for cell in own.values() if "verdict" in cell]
        peers.append({"name": name, "kind": first["kind"], "uniforms": first["uniforms"], "skipped": skipped})
        peers[-1]["biased"] = "biased" in verdicts
        seconds = [number(cell["prepare"]["seconds"]) for cell in own.values() if "prepare" in cell]
        prepare.append(seconds[0] if seconds else math.nan)
    rows = max(len(own) for own in found)
    rungs = max(len(_rungs(row)) for own in found for row in own if row)
    points = np.full((len(names), rows, rungs, len(FIELDS)), np.nan, np.float32)
    facts = np.full((len(names), rows, len(ROW)), np.nan)
    for k, own in enumerate(found):
        for j, row in enumerate(own):
            if row:
                steps = _rungs(row)
                points[k, j, : len(steps)] = steps
                facts[k, j] = [number(row.get(key, math.nan)) for key in ROW]
    return {"points": points, "rows": facts, "prepare": np.array(prepare)}, peers


def _rungs(row: dict[str, Any] | None) -> list[list[float]]:
    if not row:
        return []
    measured = [
        [p["samples"], _seconds(p), *(number(p["rmse"][key]) for key in ("value", "low", "high")), p["rmse"]["heavy"]]
        for p in row["points"]
    ]
    timed = [[p["samples"], _seconds(p), *[math.nan] * 4] for p in row.get("scouts", [])]
    return [*measured, *timed]


def _seconds(point: dict[str, Any]) -> float:
    found = point["seconds"]
    return number(found[1] if isinstance(found, list) else found)


def unpack(arrays: dict[str, np.ndarray], peers: list[dict[str, Any]], contexts: list[Any]) -> list[dict[str, Any]]:
    """Cells as `dsfit.experiment.race_summary` reads them; `contexts` are the single contexts, as dicts."""
    cells = []
    for k, peer in enumerate(peers):
        verdict = {} if peer["skipped"] else {"verdict": "biased" if peer["biased"] else "unbiased"}
        base = {"peer": peer["name"], "kind": peer["kind"], "uniforms": peer["uniforms"], "skipped": peer["skipped"]}
        base |= {**verdict, "prepare": {"seconds": float(arrays["prepare"][k])}}
        if (row := _row(arrays, k, 0)) is not None:
            cells.append({**base, "group": "stream", "stream": row})
        single = [_row(arrays, k, j) for j in range(1, arrays["rows"].shape[1])]
        found = [{**row, "context": context} for row, context in zip(single, contexts, strict=True) if row is not None]
        if found or row is None:
            cells.append({**base, "group": "contexts", "contexts": found or None})
    return cells


def _row(arrays: dict[str, np.ndarray], k: int, j: int) -> dict[str, Any] | None:
    facts = dict(zip(ROW, (float(x) for x in arrays["rows"][k, j]), strict=True))
    if math.isnan(facts["at_seconds"]):
        return None
    points, scouts = [], []
    for values in arrays["points"][k, j]:
        rung = dict(zip(FIELDS, (float(x) for x in values), strict=True))
        if math.isnan(rung["samples"]):
            continue
        point = {"samples": int(rung["samples"]), "seconds": rung["seconds"]}
        if math.isnan(rung["heavy"]):
            scouts.append(point)
        else:
            point["rmse"] = {"heavy": bool(rung["heavy"]), **{key: rung[key] for key in ("value", "low", "high")}}
            points.append(point)
    for key in ("contexts", "subset"):
        facts[key] = 0 if math.isnan(facts[key]) else int(facts[key])
    if math.isnan(facts["predicted_variance"]):
        del facts["predicted_variance"]
    return {**facts, "points": points, "scouts": scouts}
