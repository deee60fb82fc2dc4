"""The log of finished cells, and handing them out: with machines that answer at once."""

from __future__ import annotations

import json
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dsfit.experiment.reader import RawConfig
from dsfit.experiment.rundir import RunFailure
from dsfit.sweep.drive import IN_FLIGHT, Drive
from dsfit.sweep.executors import Machines
from dsfit.sweep.log import CellLog
from dsfit.sweep.slot import Unable
from dsfit.sweep.tasks import Base, Batch, Task
from tests.sweep.cheap import FakeMachines, rows_of

BASE = Base(RawConfig("a", "a.toml", {}), {})


def drive(log: CellLog, machines: Machines, **options: Any) -> Drive:
    return Drive(lambda cell: Task(cell, cell, {}, 0), BASE, log, machines, **options)


def answers(tried: list[int], fail: Callable[[int, int], bool] = lambda cell, attempt: False) -> Any:
    """Outcomes of cells; `fail(cell, attempt)` says which fail. Every attempt is added to `tried`."""

    def answer(batch: Batch) -> list[dict[str, Any]]:
        found = []
        for task in batch.tasks:
            tried.append(task.cell)
            if fail(task.cell, tried.count(task.cell)):
                trouble = {"fate": "raised", "error": "ValueError: no", "traceback": "line 1"}
                found.append({"cell": task.cell, "context": None, "seconds": 0.01, **trouble})
            else:
                found.append(rows_of(task.cell))
        return found

    return answer


# ---- the log ----


def test_the_log_keeps_what_was_added_and_the_last_word_counts(tmp_path: Path) -> None:
    log = CellLog(tmp_path / "cells.log", 5)
    strange = {**rows_of(3), "rows": [[float("nan"), float("inf"), None, 'a "fate" \n\u2028 b', 0.1 + 0.2]]}
    failure = {"cell": 1, "context": None, "seconds": 0.0, "fate": "died", "error": "x\ny", "traceback": "", "n": 1}
    for outcome in (strange, failure, rows_of(0)):
        log.add(outcome)
    assert log.done.tolist() == [True, False, False, True, False] and log.failed.tolist() == [0, 1, 0, 0, 0]
    log.add(rows_of(1))
    log.close()
    again = CellLog(tmp_path / "cells.log", 5)
    assert again.done.tolist() == [True, True, False, True, False] and not again.failed.any()
    np.testing.assert_equal(again.get(3), strange)
    assert again.get(1) == rows_of(1) and again.get(2) is None


@pytest.mark.parametrize("cut", [1, 20, 60])
def test_a_line_cut_short_is_dropped_and_the_log_goes_on(tmp_path: Path, cut: int) -> None:
    path = tmp_path / "cells.log"
    log = CellLog(path, 4)
    for cell in (2, 0):
        log.add(rows_of(cell))
    log.close()
    path.write_bytes(path.read_bytes()[:-cut])
    log = CellLog(path, 4)
    assert log.done.tolist() == [False, False, True, False]
    log.add(rows_of(3))
    log.close()
    log = CellLog(path, 4)
    assert log.done.tolist() == [False, False, True, True] and log.get(3) == rows_of(3)


def test_damaged_lines_count_as_missing(tmp_path: Path) -> None:
    path = tmp_path / "cells.log"
    log = CellLog(path, 4)
    for cell in range(4):
        log.add(rows_of(cell))
    log.close()
    lines = path.read_bytes().splitlines(keepends=True)
    lines[1] = lines[1].replace(b"case 1", b"case 7")  # its checksum does not fit any more
    lines[2] = b"\xff\x00 damage\n"
    body = json.dumps(rows_of(9)).encode()
    lines.append(b"9 %08x %s\n" % (zlib.crc32(body), body))  # of no cell of this sweep
    path.write_bytes(b"".join(lines))
    assert CellLog(path, 4).done.tolist() == [True, False, False, True]


# ---- handing out ----


def test_every_cell_is_computed_once_in_order_with_few_batches_at_once(tmp_path: Path) -> None:
    log, tried = CellLog(tmp_path / "log", 500), list[int]()
    machines = FakeMachines(answers(tried), slots=3)
    counts = drive(log, machines).run()
    assert tried == list(range(500)) and log.done.all()
    assert (counts.done, counts.failed, counts.again) == (500, 0, 0) and counts.most_in_flight == 3 * IN_FLIGHT
    sizes = [len(batch.tasks) for batch in machines.batches]
    assert sizes[: 3 * IN_FLIGHT] == [1] * 9 and max(sizes) > 10 and sizes[-1] == 1  # grows, then small again
    assert not machines.batches[len(machines.batches) :] and drive(log, machines).run().done == 500


def test_failures_are_tried_again_and_then_kept_while_others_go_on(tmp_path: Path) -> None:
    log, tried = CellLog(tmp_path / "log", 40), list[int]()
    machines = FakeMachines(answers(tried, lambda cell, attempt: cell == 7 or (cell == 9 and attempt <= 2)))
    counts = drive(log, machines, retries=2).run()
    assert (counts.done, counts.failed, counts.again) == (39, 1, 4)
    assert tried.count(7) == tried.count(9) == 3 and np.flatnonzero(log.failed).tolist() == [7]
    assert log.get(7)["attempts"] == 3 and log.get(7)["error"] == "ValueError: no"
    again: list[int] = []
    assert drive(log, FakeMachines(answers(again)), retries=2).run().done == 40 and again == [7]


def test_a_batch_that_is_lost_is_done_cell_by_cell_and_the_one_to_blame_is_found(tmp_path: Path) -> None:
    log, tried = CellLog(tmp_path / "log", 300), list[int]()
    fine = answers(tried)

    def deadly(batch: Batch) -> list[dict[str, Any]]:
        if any(task.cell == 150 for task in batch.tasks):
            raise OSError("KilledWorker")
        return fine(batch)

    counts = drive(log, FakeMachines(deadly), retries=1).run()
    assert (counts.done, counts.failed) == (299, 1) and sorted(tried) == [c for c in range(300) if c != 150]
    assert log.get(150)["fate"] == "died" and "KilledWorker" in log.get(150)["error"]


def test_workers_that_cannot_begin_end_the_sweep_and_nothing_is_lost(tmp_path: Path) -> None:
    log, tried = CellLog(tmp_path / "log", 30), list[int]()
    fine, unable = answers(tried), []

    def changing(batch: Batch) -> list[dict[str, Any]]:
        if len(tried) > 10:
            unable.append(batch)
            raise Unable("dsfit 1 on this worker, dsfit 2 here")
        return fine(batch)

    with pytest.raises(RunFailure, match="dsfit 1 on this worker"):
        drive(log, FakeMachines(changing)).run()
    assert log.done.sum() == len(tried) and unable


def test_a_scheduler_that_is_gone_ends_the_sweep(tmp_path: Path) -> None:
    log = CellLog(tmp_path / "log", 30)
    machines = FakeMachines(answers([]))
    machines.lost = lambda: "the Dask scheduler is gone"  # type: ignore[method-assign]
    with pytest.raises(RunFailure, match="scheduler is gone"):
        drive(log, machines).run()
