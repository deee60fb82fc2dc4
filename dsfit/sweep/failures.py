"""Cells that failed: for each a config that computes it again, alone and with the same random numbers, and what
happened."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np

from dsfit.errors import InputError
from dsfit.experiment import files
from dsfit.experiment.design import at_point
from dsfit.sweep.compute import work_at
from dsfit.sweep.log import CellLog
from dsfit.sweep.plan import Plan
from dsfit.sweep.tasks import Base, Task

MOST = 1000
"""So many failures get files of their own; all are in the log and the table."""


def write_failures(plan: Plan, log: CellLog, folder: Path) -> list[dict[str, Any]]:
    """Write `NUMBER.toml` and `NUMBER.txt` of every failed cell (the first `MOST`); returns number, fate, error and
    file of each."""
    if folder.is_dir():
        shutil.rmtree(folder)
    found = []
    for cell in np.flatnonzero(log.failed)[:MOST].tolist():
        outcome = log.get(cell)
        if outcome is None:
            continue
        task = plan.task(cell)
        path = folder / f"{cell:06d}.toml"
        words = "".join(c for c in outcome["error"][:200] if c.isprintable())
        heading = f"# Cell {cell} of the sweep {plan.name}: {outcome['fate']}: {words}"
        files.write_bytes(path, f"{heading}\n\n{files.to_toml(reproducing(plan.base, task))}".encode(errors="replace"))
        story = f"{outcome['fate']} after {outcome['attempts']} attempts: {outcome['error']}\n\n{outcome['traceback']}"
        files.write_bytes(path.with_suffix(".txt"), f"{story.rstrip()}\n".encode(errors="replace"))
        name = f"{folder.name}/{path.name}"
        found.append({"cell": cell, "fate": outcome["fate"], "error": outcome["error"], "config": name})
    return found


def reproducing(base: Base, task: Task) -> dict[str, Any]:
    """The tables of a config whose run computes this cell with the same random numbers.

    Its values of the design stay in `[sweep.grid]`, one for each key, because random numbers follow from them.
    Contexts (or suites) are cut down to the cell's own, unless the design varies them. A point whose values are not
    allowed gives the tables as they are, which are refused in the same way.
    """
    grid = {key: [value] for key, value in task.values.items()}
    try:
        config = base.config(task.values)
        work = work_at(config, task)
    except InputError:
        try:
            return {**at_point(base.raw, base.sources, task.values).data}
        except InputError:
            return {**base.raw.data, "sweep": {"grid": grid}}
    data = config.model_dump(exclude_none=True)
    swept = {key.split(".")[0] for key in task.values}
    context = work.get("context")
    if context and "contexts" not in swept:
        data["contexts"] = {name: [value] for name, value in context.items() if value is not None}
    if "suite" in work and "check" not in swept:
        data["check"]["suites"] = [work["suite"]]
    data["sweep"] = {"grid": grid}
    return data
