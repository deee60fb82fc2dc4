"""How far a sweep is: a bar on a terminal, elsewhere a plain line now and then."""

from __future__ import annotations

import sys
import time
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from dsfit.sweep.drive import Counts

_FIRST_LINE, _GROWTH, _LAST_LINE = 5.0, 1.3, 120.0  # seconds until the first line, between the last ones


class SweepProgress:
    """Shows `Counts` on standard error."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._start = time.monotonic()
        self._done_at_start: int | None = None
        self._wait, self._next = _FIRST_LINE, _FIRST_LINE
        self._bar = Progress(
            TextColumn("{task.description}", markup=False), BarColumn(bar_width=30), MofNCompleteColumn(),
            TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn(),
            TextColumn("{task.fields[what]}", style="dim", markup=False),
            console=Console(stderr=True), transient=True, disable=not sys.stderr.isatty(), speed_estimate_period=600,
        )  # fmt: skip
        self._task = self._bar.add_task(name, total=None, what="")

    def validated(self, done: int, total: int) -> None:
        """`done` of `total` points are validated."""
        self._bar.update(self._task, total=total, completed=done, what="checking points")

    def __call__(self, counts: Counts) -> None:
        """Show how far it is."""
        finished, elapsed = counts.done + counts.failed, time.monotonic() - self._start
        if self._done_at_start is None:
            self._done_at_start = finished
        trouble = f"{counts.failed} failed, {counts.again} tried again" if counts.failed + counts.again else ""
        self._bar.update(self._task, total=counts.total, completed=finished, what=trouble)
        if not sys.stderr.isatty() and elapsed >= self._next:
            self._wait = min(self._wait * _GROWTH, _LAST_LINE)
            self._next = elapsed + self._wait
            self.line(f"{finished} of {counts.total} cells, {_duration(elapsed)}{self._left(counts, finished, elapsed)}"
                      + (f", {trouble}" if trouble else ""))  # fmt: skip

    def _left(self, counts: Counts, finished: int, elapsed: float) -> str:
        made = finished - (self._done_at_start or 0)
        return f", about {_duration(elapsed / made * (counts.total - finished))} left" if made > 0 else ""

    def line(self, text: str) -> None:
        """One plain line."""
        print(f"{self._name}: {text}", file=sys.stderr, flush=True)

    def __enter__(self) -> SweepProgress:
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()


def _duration(seconds: float) -> str:
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"
