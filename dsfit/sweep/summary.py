"""Medians along every axis of the design, as a Markdown table."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dsfit.experiment.design import Design, Range

_BINS = 4
_MOST_VALUES = 12
# kind -> the column that rows are told apart by, and what is averaged
_SHOWN = {
    "compare": ("method", ("excess", "samples_to_1_percent", "seconds_to_1_percent")),
    "transmittance": ("n", ("excess", "excess_cosine", "width_deg")),
    "amortise": ("group", ("excess_median", "excess_p95", "excess_worst")),
    "check": ("suite", ("p_value", "value", "bound")),
}


def markdown(record: dict[str, Any], table: Path, design: Design) -> str:
    """Counts, and for every value of every key (ranges in quarters) the median over all other keys and contexts."""
    import pyarrow.parquet as pq

    group, measures = _SHOWN["compare" if record["kind"] == "sweep" else record["kind"]]
    counts = record["counts"]
    lines = [
        f"# {record['title'] or record['name']}",
        "",
        f"{counts['points']} points, {counts['cells']} cells: {counts['done']} done, {counts['failed']} failed; "
        f"{counts['rows']} rows. Medians over everything else; ranges are cut into quarters.",
        "",
        f"| key | value | {group} | rows | " + " | ".join(measures) + " |",
        "|---|---|---|---:|" + "---:|" * len(measures),
    ]
    for key in design.keys:
        data = pq.read_table(table, columns=[key, group, "status", *measures], read_dictionary=[group, "status"])
        names, status = _codes(data[group]), _codes(data["status"])
        good = status.numbers == status.labels.index("ok") if "ok" in status.labels else np.zeros(len(data), bool)
        numbers = {m: data[m].to_numpy(zero_copy_only=False).astype(float) for m in measures}
        for label, here in _parts(data[key], design.space.get(key)):
            for code, name in enumerate(names.labels):
                chosen = good & here & (names.numbers == code)
                if not chosen.any():
                    continue
                cells = [_short(_median(numbers[m][chosen])) for m in measures]
                lines.append(f"| {key} | {label} | {name} | {int(chosen.sum())} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def _parts(column: Any, axis: Any) -> list[tuple[str, np.ndarray]]:
    """A key's values, or quarters of its range, with the rows of each."""
    if isinstance(axis, Range) and not (axis.integer and axis.high - axis.low < _MOST_VALUES):
        values = column.to_numpy(zero_copy_only=False).astype(float)
        cut = np.geomspace if axis.log else np.linspace
        edges = cut(axis.low, axis.high, _BINS + 1)
        which = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, _BINS - 1)
        return [(f"{edges[k]:.4g} to {edges[k + 1]:.4g}", which == k) for k in range(_BINS)]
    found = _codes(column)
    order = list(range(len(found.labels)))
    if isinstance(axis, Range):
        order.sort(key=lambda code: int(found.labels[code]))
    return [(found.labels[code], found.numbers == code) for code in order[:_MOST_VALUES]]


class _Codes(NamedTuple):
    """A column as whole numbers and what they stand for, in the order of their first appearance."""

    numbers: np.ndarray
    labels: list[str]


def _codes(column: Any) -> _Codes:
    import pyarrow as pa

    if pa.types.is_list(column.type):
        column = pa.chunked_array([pa.array([str(x) for x in chunk.to_pylist()]) for chunk in column.chunks])
    if pa.types.is_dictionary(column.type):
        encoded = column.unify_dictionaries().combine_chunks()
    else:
        encoded = column.combine_chunks().dictionary_encode()
    return _Codes(
        encoded.indices.fill_null(-1).to_numpy(zero_copy_only=False), [str(x) for x in encoded.dictionary.to_pylist()]
    )


def _median(values: np.ndarray) -> float:
    values = values[~np.isnan(values)]
    return float(np.median(values)) if len(values) else math.nan


def _short(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.3g}"
