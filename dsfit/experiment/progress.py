"""Progress bars on the terminal; silent where there is none."""

from __future__ import annotations

import sys
from types import TracebackType

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Column

# what there is no room for, so that the times are whole
_SHORTENED = Column(ratio=1, no_wrap=True, overflow="ellipsis")


class BarProgress:
    """A `runner.Progress` that draws one bar over the cells and says what each busy cell is doing."""

    def __init__(self, title: str) -> None:
        console = Console(stderr=True)
        self._bar = Progress(
            SpinnerColumn(),
            TextColumn("{task.description}", markup=False),
            BarColumn(bar_width=20),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            TextColumn("{task.fields[what]}", style="dim", markup=False, table_column=_SHORTENED),
            console=console,
            transient=True,
            expand=True,
            disable=not sys.stderr.isatty(),
        )
        self._task = self._bar.add_task(title, total=None, what="")
        self._busy: dict[int, str] = {}

    def start(self, total: int, done: int) -> None:
        """`done` of `total` cells were there already."""
        self._bar.update(self._task, total=total, completed=done, what="starting")

    def step(self, index: int, what: str) -> None:
        """Cell `index` now does `what`."""
        self._busy[index] = what
        self._show()

    def finish(self, index: int) -> None:
        """Cell `index` is written."""
        self._busy.pop(index, None)
        self._bar.advance(self._task)
        self._show()

    def _show(self) -> None:
        self._bar.update(self._task, what="  ".join(f"{i}: {what}" for i, what in sorted(self._busy.items())))

    def __enter__(self) -> BarProgress:
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()
