"""Reads rows of what `throughput.py` measured; nothing is computed here but rates."""

from __future__ import annotations

from typing import Any

import numpy as np

TASKS = {"eval": "eval", "log_prob": "pdf", "sample": "sample", "fused": "sample + pdf + eval"}
LABELS = {
    "Mitsuba": "Mitsuba 3 hair",
    "Mitsuba, scalar": "Mitsuba 3 hair, scalar",
    "kernel, compiled": "kernel, compiled",
    "kernel, eager": "kernel, eager",
    "float64": "dsfit, float64",
}
Rows = dict[tuple[str, str, str, int, int], dict[str, Any]]


def index(record: dict[str, Any]) -> Rows:
    """Rows by library, task, layout, directions as asked for (a power of ten), threads."""
    return {(row["library"], row["task"], row["layout"], _asked(row), row["threads"]): row for row in record["rows"]}


def clock(row: dict[str, Any]) -> dict[str, float]:
    """Seconds of a call: on the processor for one thread, which others hardly disturb, else wall time."""
    return row["processor"] if row["threads"] == 1 else row["wall"]


def rate(row: dict[str, Any], which: str = "median") -> float:
    """Million directions per second."""
    return row["count"] / max(clock(row)[which], 1e-12) / 1e6


def _asked(row: dict[str, Any]) -> int:
    return 10 ** round(float(np.log10(max(row["count"], 1)))) if row["task"] != "prepare" else row["count"]


def mitsuba(record: dict[str, Any]) -> str:
    """Name of Mitsuba's rows that others are compared with, of which there are none if it is missing."""
    names = {row["library"] for row in record["rows"]}
    return "Mitsuba" if "Mitsuba" in names else "Mitsuba, scalar"


def base(record: dict[str, Any], rows: Rows, task: str, count: int, threads: int) -> dict[str, Any] | None:
    """Mitsuba's row for this task; its eval takes contexts in, so it is what `prepare + eval` is compared with too."""
    name = mitsuba(record)
    layout = "all different" if name == "Mitsuba" else "one context"
    return rows.get((name, task.removeprefix("prepare + "), layout, count, threads))


def of_task(record: dict[str, Any], library: str, task: str, layout: str, threads: int = 1) -> list[dict[str, Any]]:
    """All rows of a contender, by the number of directions."""
    key = (library, task, layout, threads)
    rows = [row for row in record["rows"] if (row["library"], row["task"], row["layout"], row["threads"]) == key]
    return sorted(rows, key=lambda row: row["count"])


def measured(record: dict[str, Any], task: str) -> float:
    """Nanoseconds per direction of the compiled kernel for the most directions, each with its own context, as the
    limits are counted; nan if it was not timed."""
    rows = of_task(record, "kernel, compiled", task, "all different")
    return 1e3 / rate(rows[-1]) if rows else float("nan")


def libraries(record: dict[str, Any]) -> list[str]:
    """Those that are drawn, of those that are there; Mitsuba's first."""
    names = {row["library"] for row in record["rows"]}
    return [name for name in (mitsuba(record), "kernel, compiled", "kernel, eager", "float64") if name in names]


def layout_of(library: str) -> str:
    """How directions share contexts where libraries are compared."""
    return "one context" if library == "Mitsuba, scalar" else "all different"
