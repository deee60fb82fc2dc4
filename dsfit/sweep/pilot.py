"""What a sweep would take, from a few of its cells."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import numpy as np

from dsfit.experiment.provenance import numbers_version
from dsfit.sweep.plan import Plan
from dsfit.sweep.slot import run_batch, start_again, stop_all
from dsfit.sweep.tasks import Batch

LINE_BYTES = 11  # of the log beside the JSON and the cell's number
_PARQUET_SHARE = 0.4  # bytes of the table over those of the log: measured with numbers without any pattern


@dataclass(frozen=True)
class Estimate:
    """What all cells take together.

    Attributes:
        cells: how many cells were timed, and `failed` of them.
        cell_seconds: mean and greatest of those timed.
        hours: CPU hours of all cells.
        log_bytes: of `cells.log`.
        rows: of the table.
    """

    cells: int
    failed: list[str]
    cell_seconds: tuple[float, float]
    hours: float
    log_bytes: int
    rows: int

    @property
    def table_bytes(self) -> int:
        """About so many bytes has the table."""
        return round(self.log_bytes * _PARQUET_SHARE)


def pilot(plan: Plan, count: int, timeout: float | None = None) -> Estimate:
    """Compute `count` cells, spread evenly over all, one after another in one process.

    The first cell of a process is not counted: it pays for imports and caches once.
    """
    chosen = sorted({int(x) for x in np.linspace(0, len(plan) - 1, min(count, len(plan)))})
    start_again()
    try:
        tasks = [plan.task(cell) for cell in (chosen[0], *chosen)]
        found = run_batch(Batch(plan.base, tasks, numbers_version(), timeout))[1:]
    finally:
        stop_all()
    seconds = [outcome["seconds"] for outcome in found]
    sizes = [len(json.dumps(outcome, separators=(",", ":"))) + LINE_BYTES + len(str(len(plan))) for outcome in found]
    rows = [len(outcome.get("rows", [0])) for outcome in found]
    failed = [f"cell {outcome['cell']}: {outcome['error']}" for outcome in found if "fate" in outcome]
    mean = float(np.mean(seconds))
    return Estimate(
        len(found), failed, (mean, max(seconds)), mean * len(plan) / 3600, round(np.mean(sizes) * len(plan)),
        round(np.mean(rows) * len(plan)),
    )  # fmt: skip


def describe(plan: Plan, shown: int = 5) -> list[str]:
    """Number of points and cells, and the first few points."""
    lines = [f"{len(plan.design)} points, {len(plan)} cells; columns of the design: {', '.join(plan.design.keys)}"]
    for point in range(min(shown, len(plan.design))):
        values: dict[str, Any] = plan.design.values(point)
        lines.append(f"  point {point}: " + ", ".join(f"{key} = {value}" for key, value in values.items()))
    return lines + (["  ..."] if len(plan.design) > shown else [])
