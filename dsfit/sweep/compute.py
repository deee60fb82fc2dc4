"""Computes one cell and says what became of it, in plain data."""

from __future__ import annotations

import itertools
import json
import time
import traceback
from typing import Any

from dsfit.experiment.cells import Job, compute_job, label_of, work_of
from dsfit.experiment.schema import Config
from dsfit.sweep.rows import context_of, rows
from dsfit.sweep.tasks import Base, Task

Outcome = dict[str, Any]
"""`cell`, `seconds`, `context`, and either `rows` or `fate` ("raised", "timed out", "died"), `error`, `traceback`."""


def compute(base: Base, task: Task) -> Outcome:
    """The rows of a cell, or why there are none."""
    clock = time.perf_counter()
    outcome: Outcome = {"cell": task.cell, "context": None}
    try:
        config = _config(_Key(base, json.dumps(task.values, sort_keys=True)), base, task.values)
        work = work_at(config, task)
        outcome["context"] = context_of(config.kind, work)
        identity = {"grid": task.values, **work}
        job = Job(task.cell, label_of(config, identity), identity, config)
        data, _ = compute_job(None, job, lambda what: None)
        outcome["rows"] = rows(config.kind, data)
    except (Exception, SystemExit) as error:  # a user's code may do anything
        message = f"{type(error).__name__}: {error}"
        outcome.update(fate="raised", error=message, traceback=traceback.format_exc())
    return {**outcome, "seconds": time.perf_counter() - clock}


def work_at(config: Config, task: Task) -> dict[str, Any]:
    """What tells the task's cell from the others of its point."""
    return next(itertools.islice(iter(work_of(config, first=task.point == 0)), task.part, None))


class _Key:
    """A base and values that equal others if the base is the same object and the values read the same."""

    def __init__(self, base: Base, text: str) -> None:
        self.base, self.text = base, text

    def __hash__(self) -> int:
        return hash(self.text)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Key) and self.base is other.base and self.text == other.text


_last: dict[_Key, Config] = {}


def _config(key: _Key, base: Base, values: dict[str, Any]) -> Config:
    """The point's config; the last one is kept, because a point's cells come one after another."""
    if key not in _last:
        _last.clear()
        _last[key] = base.config(values)
    return _last[key]
