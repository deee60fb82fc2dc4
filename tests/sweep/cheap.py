"""Sweeps whose cells take some hundredths of a second, and machines that compute without processes."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import pandas

from dsfit.sweep.tasks import Batch

SCENE = """
kind = "check"
title = "cheap"
[bsdf]
azimuthal = "simplified"
precision = "exact"
[contexts]
theta_r_deg = [0, 30]
n = [0]
[check]
suites = ["chi_square"]
proposals = ["uniform"]
[check.chi_square]
samples = 500
cells = [3, 2]
[output]
plots = false
"""
SOBOL = """
[sweep]
design = "sobol"
points = 12
[sweep.space]
"contexts.theta_r_deg.0" = { low = -80.0, high = 80.0 }
"contexts.n.0" = { low = 0, high = 3, integer = true }
"""


def config(folder: Path, sweep: str = SOBOL, scene: str = SCENE) -> Path:
    """A config file with 12 points of two cells each."""
    path = folder / "cheap.toml"
    path.write_text(scene + sweep)
    return path


class FakeMachines:
    """Machines that answer at once, with what `answer` makes of a batch (or raise what it raises)."""

    name = "fake"

    def __init__(self, answer: Callable[[Batch], list[dict[str, Any]]], slots: int = 2) -> None:
        self.answer, self.count, self.batches = answer, slots, list[Batch]()

    def slots(self) -> int:
        return self.count

    def submit(self, batch: Batch) -> Future[list[dict[str, Any]]]:
        self.batches.append(batch)
        future: Future[list[dict[str, Any]]] = Future()
        try:
            future.set_result(self.answer(batch))
        except BaseException as error:
            future.set_exception(error)
        return future

    def lost(self) -> str:
        return ""

    def close(self) -> None:
        pass


def rows_of(cell: int) -> dict[str, Any]:
    """The outcome of a cell that went well, in the columns of a check."""
    row = [0.0, 0.0, 0.0, None, "chi_square", "", "uniform", f"case {cell}", 0.5, None, None, None, ""]
    return {"cell": cell, "context": row[:4], "rows": [row], "seconds": 0.01}


def measured(path: Path) -> pandas.DataFrame:
    """The deterministic columns of a table."""
    table = pandas.read_parquet(path / "results.parquet")
    return table[[name for name in table if "seconds" not in name]]
