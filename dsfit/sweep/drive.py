"""Hands out cells and takes their outcomes: never more than a few batches per worker at once, failures again a stated
number of times, and no cell or outcome held longer than it takes to write it down."""

from __future__ import annotations

import math
import queue
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, Future
from dataclasses import dataclass, field
from typing import Any

from dsfit.experiment.provenance import numbers_version
from dsfit.experiment.rundir import RunFailure
from dsfit.sweep.executors import Machines
from dsfit.sweep.log import CellLog
from dsfit.sweep.slot import Stopped, Unable
from dsfit.sweep.tasks import Base, Batch, Task

IN_FLIGHT = 3
"""Batches handed out per worker thread."""
BATCH_SECONDS = 2.0
"""Cells are put together until they take about this long: a worker that is lost takes no more with it."""
_MOST = 500
_PATIENCE = 120.0  # seconds without any worker before the sweep gives up
_UNABLE = 3  # batches in a row that no worker could begin


@dataclass
class Counts:
    """How far a sweep is: cells with rows, failed ones, attempts beyond the first, and CPU seconds of cells."""

    total: int
    done: int = 0
    failed: int = 0
    again: int = 0
    cell_seconds: float = 0.0
    most_in_flight: int = 0


@dataclass
class Drive:
    """A sweep at work.

    Attributes:
        task_of: a cell's task, by number.
        base: what tasks share.
        log: where outcomes go.
        machines: where cells are computed.
        retries: how many times a cell that failed is tried again.
        timeout: seconds that a cell may take.
        tell: told after every batch.
    """

    task_of: Callable[[int], Task]
    base: Base
    log: CellLog
    machines: Machines
    retries: int = 1
    timeout: float | None = None
    tell: Callable[[Counts], None] = lambda counts: None
    counts: Counts = field(init=False)
    _arrived: queue.SimpleQueue[tuple[list[Task], Future[Any]]] = field(init=False, default_factory=queue.SimpleQueue)
    _again: deque[Task] = field(init=False, default_factory=deque)
    _attempts: dict[int, int] = field(init=False, default_factory=dict)
    _mean: float | None = field(init=False, default=None)
    _unable: int = field(init=False, default=0)
    _left: int = field(init=False, default=0)  # not handed out yet

    def run(self) -> Counts:
        """Compute every cell that the log does not have.

        Raises:
            RunFailure: the workers are gone, or cannot compute at all; what is done is in the log.
        """
        done = self.log.done
        self.counts = Counts(len(done), int(done.sum()))
        todo = _missing(done)
        self._left = remaining = self.counts.total - self.counts.done
        flying = 0
        last_seen = time.monotonic()
        while remaining:
            slots = self.machines.slots()
            last_seen = time.monotonic() if slots else last_seen
            while flying < IN_FLIGHT * slots and (tasks := self._next(todo, slots)):
                self._submit(tasks)
                flying += 1
            self.counts.most_in_flight = max(self.counts.most_in_flight, flying)
            self._check(last_seen)
            try:
                tasks, future = self._arrived.get(timeout=1.0)
            except queue.Empty:
                self.tell(self.counts)
                continue
            flying -= 1
            remaining -= self._take(tasks, future)
            self.tell(self.counts)
        return self.counts

    def _next(self, todo: Iterator[int], slots: int) -> list[Task]:
        """The next batch: a cell that failed before is on its own, so that nothing else goes down with it."""
        if self._again:
            return [self._again.popleft()]
        size = 1
        if self._mean is not None:
            size = max(1, min(_MOST, int(BATCH_SECONDS / max(self._mean, 1e-9)), math.ceil(self._left / (4 * slots))))
        tasks = [self.task_of(cell) for _, cell in zip(range(size), todo, strict=False)]
        self._left -= len(tasks)
        return tasks

    def _submit(self, tasks: list[Task]) -> None:
        try:
            future = self.machines.submit(Batch(self.base, tasks, numbers_version(), self.timeout))
        except Exception as error:  # whatever a connection that is breaking raises
            raise RunFailure(f"{self.machines.name}: {type(error).__name__}: {error}") from None
        future.add_done_callback(lambda done: self._arrived.put((tasks, done)))

    def _check(self, last_seen: float) -> None:
        if reason := self.machines.lost():
            raise RunFailure(reason)
        if time.monotonic() - last_seen > _PATIENCE:
            raise RunFailure(f"no workers for {_PATIENCE:g} s")

    def _take(self, tasks: list[Task], future: Future[Any]) -> int:
        """Write down what came; returns how many cells are finished by it."""
        try:
            outcomes = future.result()
        except (Unable, Stopped) as error:
            self._unable += 1
            if isinstance(error, Stopped) or self._unable >= _UNABLE:
                raise RunFailure(str(error)) from None
            self._again.extend(tasks)
            return 0
        except (Exception, CancelledError) as error:  # the batch was lost on its way, or took its workers with it
            if reason := self.machines.lost():
                raise RunFailure(reason) from None
            if len(tasks) > 1:
                self._again.extend(tasks)  # which of them is to blame is seen when each is alone
                return 0
            message = f"the worker was lost: {type(error).__name__}: {error}"
            outcomes = [{"cell": tasks[0].cell, "context": None, "seconds": 0.0, "fate": "died", "error": message,
                         "traceback": ""}]  # fmt: skip
        self._unable = 0
        return sum(self._one(task, outcome) for task, outcome in zip(tasks, outcomes, strict=True))

    def _one(self, task: Task, outcome: dict[str, Any]) -> bool:
        """Write a cell down, unless it is to be tried again."""
        seconds = outcome["seconds"]
        self.counts.cell_seconds += seconds
        self._mean = seconds if self._mean is None else 0.9 * self._mean + 0.1 * seconds
        if "fate" in outcome:
            attempts = self._attempts.get(task.cell, 0) + 1
            if attempts <= self.retries:
                self._attempts[task.cell] = attempts
                self._again.append(task)
                self.counts.again += 1
                return False
            self._attempts.pop(task.cell, None)
            outcome = {**outcome, "attempts": attempts}
            self.counts.failed += 1
        else:
            self._attempts.pop(task.cell, None)
            self.counts.done += 1
        self.log.add(outcome)
        return True


def _missing(done: Any) -> Iterator[int]:
    for cell, there in enumerate(done):
        if not there:
            yield cell
