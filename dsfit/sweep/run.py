"""A sweep from its plan to its table; what is there already is kept.

DIR/config.toml        the resolved config; `dsfit sweep` takes it again
DIR/cells.log          what every finished cell left, added line by line
DIR/results.parquet    the table; written when no cell is missing
DIR/table.md           medians along every axis of the design
DIR/sweep.json         design, counts, seconds, versions, machines; written last, so it marks the sweep as finished
DIR/failures/000123.toml 000123.txt    a config that computes a failed cell again, and what happened
"""

from __future__ import annotations

import hashlib
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from dsfit.errors import InputError
from dsfit.experiment import files, provenance
from dsfit.experiment.render import peak_memory
from dsfit.experiment.rundir import RunDirectory
from dsfit.sweep import rows
from dsfit.sweep.drive import Counts, Drive
from dsfit.sweep.executors import Machines, versions
from dsfit.sweep.failures import write_failures
from dsfit.sweep.log import CellLog
from dsfit.sweep.plan import Plan
from dsfit.sweep.summary import markdown
from dsfit.sweep.table import require_parquet, write_table

SCHEMA_VERSION = 1
_OWN = ("config.toml", "cells.log", "results.parquet", "table.md", "sweep.json", "failures")


def sweep_directory(plan: Plan, out: Path | None = None) -> Path:
    """`<output.dir or out>/<config name>-<id>`; the id stands for the config, the code and the columns."""
    source = hashlib.sha256(Path(rows.__file__).read_bytes()).hexdigest()
    identity = hashlib.sha256(f"{provenance.run_id(plan.config)} {source}".encode()).hexdigest()[:12]
    name = "".join(c if c.isalnum() or c in "._-" else "-" for c in plan.name) or "sweep"
    return Path(out if out is not None else plan.config.output.dir) / f"{name}-{identity}"


def read_record(path: Path) -> dict[str, Any]:
    """`sweep.json`; empty if there is none or it is damaged."""
    try:
        return files.read_json(path / "sweep.json", SCHEMA_VERSION)
    except InputError:
        return {}


def run_sweep(
    plan: Plan,
    path: Path,
    machines: Callable[[], Machines],
    *,
    retries: int = 1,
    timeout: float | None = None,
    force: bool = False,
    tell: Callable[[Counts], None] = lambda counts: None,
) -> dict[str, Any]:
    """Compute the cells that are missing or failed, and write everything; returns the record (`sweep.json`).

    Args:
        plan: the cells.
        path: the sweep's directory.
        machines: makes what computes; called only if there is something to compute.
        retries: how many times a failed cell is tried again.
        timeout: seconds that a cell may take.
        force: throw away what an earlier attempt left.
        tell: told after every batch.

    Raises:
        RunFailure: another process holds the directory, or the workers are gone; what is done is kept.
        InputError: pyarrow is not installed.
    """
    require_parquet()
    path.mkdir(parents=True, exist_ok=True)
    with RunDirectory(path).lock():
        if force:
            clear(path)
        old = read_record(path)
        log = CellLog(path / "cells.log", len(plan))
        try:
            if log.done.all() and old.get("counts", {}).get("done") == len(plan) and _is_whole(path):
                return old
            return _run(plan, path, log, old, machines, retries, timeout, tell)
        finally:
            log.close()


def _is_whole(path: Path) -> bool:
    return (path / "results.parquet").is_file() and (path / "table.md").is_file()


def _run(
    plan: Plan, path: Path, log: CellLog, old: dict[str, Any], machines: Callable[[], Machines], retries: int,
    timeout: float | None, tell: Callable[[Counts], None],
) -> dict[str, Any]:  # fmt: skip
    started, clock, reused = provenance.now(), time.perf_counter(), int(log.done.sum())
    dumped = plan.config.model_dump(exclude_none=True)
    files.write_bytes(path / "config.toml", files.to_toml(dumped).encode())
    session: dict[str, Any] = {"started": started, "cells_reused": reused, "retries": retries, "timeout": timeout}
    counts = Counts(len(plan), reused)
    if reused < len(plan):
        where = machines()
        session["machines"] = where.name
        try:
            counts = Drive(plan.task, plan.base, log, where, retries, timeout, tell).run()
        finally:
            where.close()
            log.sync()
    session.update(
        seconds=round(time.perf_counter() - clock, 3), cell_seconds=counts.cell_seconds, tried_again=counts.again,
        most_in_flight=counts.most_in_flight,
    )  # fmt: skip
    clock = time.perf_counter()
    failures = write_failures(plan, log, path / "failures")
    row_count = write_table(plan, log, path / "results.parquet")
    record = {
        "schema_version": SCHEMA_VERSION,
        "name": plan.name,
        "title": plan.config.title,
        "kind": plan.config.kind,
        "design": dumped["sweep"],
        "columns_of_the_design": plan.design.keys,
        "counts": {
            "points": len(plan.design), "cells": len(plan), "done": int(log.done.sum()),
            "failed": int(log.failed.sum()), "rows": row_count,
        },
        "failures": failures,
        "bytes": {"log": log.bytes, "table": (path / "results.parquet").stat().st_size},
        "provenance": {**provenance.provenance(), "seed": plan.config.estimate.seed, "sweep": versions()},
    }  # fmt: skip
    files.write_bytes(path / "table.md", markdown(record, path / "results.parquet", plan.design).encode())
    session.update(collecting_seconds=round(time.perf_counter() - clock, 3), peak_memory=peak_memory())
    record["sessions"] = [*old.get("sessions", []), session]
    files.write_json(path / "sweep.json", record)
    return record


def clear(path: Path) -> None:
    """Remove what a sweep writes, and nothing else."""
    for name in _OWN:
        target = path / name
        if target.is_dir() and not target.is_symlink():
            shutil.rmtree(target)
        else:
            target.unlink(missing_ok=True)
