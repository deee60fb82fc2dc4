"""What a sweep has done so far: one file to which a line is added for every finished cell.

`NUMBER CRC32 JSON` is a line. It is written with one call, so that a kill at any time leaves whole lines and at most a
part of one at the end, which is cut off when the sweep goes on; a line whose checksum is wrong counts as missing. A
later line of the same cell replaces an earlier one. Only the places of the lines are held in memory: 8 bytes per cell.
"""

from __future__ import annotations

import json
import os
import time
import zlib
from pathlib import Path
from typing import Any

import numpy as np

_SYNC_SECONDS = 5.0


class CellLog:
    """The finished cells of a sweep of `size` cells."""

    def __init__(self, path: Path, size: int) -> None:
        """Read which cells there are, and get ready to add others."""
        self.path = path
        self._places = np.full(size, -1, dtype=np.int64)  # of each cell's line; -1: none
        self._failed = np.zeros(size, dtype=bool)
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = open(path, "a+b")  # noqa: SIM115  (open as long as the log is)
        self._synced = time.monotonic()
        self._end = self._read()
        if self._end < self._file.seek(0, os.SEEK_END):
            self._file.truncate(self._end)

    def _read(self) -> int:
        """Find the lines; returns where the last whole one ends."""
        end = 0
        self._file.seek(0)
        for line in self._file:
            if not line.endswith(b"\n"):
                break
            entry = _parsed(line)
            if entry is not None and 0 <= entry[0] < len(self._places):
                self._note(entry[0], end, b'"fate"' in entry[1])
            end += len(line)
        return end

    def _note(self, cell: int, place: int, failed: bool) -> None:
        self._places[cell] = place
        self._failed[cell] = failed

    def add(self, outcome: dict[str, Any]) -> None:
        """Add a cell's outcome; it survives the end of this process at once, and that of the machine in a few
        seconds."""
        body = json.dumps(outcome, separators=(",", ":")).encode()
        line = b"%d %08x %s\n" % (outcome["cell"], zlib.crc32(body), body)
        self._file.write(line)
        self._file.flush()
        self._note(outcome["cell"], self._end, "fate" in outcome)
        self._end += len(line)
        if time.monotonic() - self._synced > _SYNC_SECONDS:
            self.sync()

    def sync(self) -> None:
        """Make sure that all lines are on the disk."""
        os.fsync(self._file.fileno())
        self._synced = time.monotonic()

    def get(self, cell: int) -> dict[str, Any] | None:
        """A cell's outcome, or None."""
        if self._places[cell] < 0:
            return None
        self._file.seek(int(self._places[cell]))
        entry = _parsed(self._file.readline())
        return None if entry is None else json.loads(entry[1])

    @property
    def done(self) -> np.ndarray:
        """Which cells have rows, `[size]`."""
        return (self._places >= 0) & ~self._failed

    @property
    def failed(self) -> np.ndarray:
        """Which cells have failed, `[size]`."""
        return (self._places >= 0) & self._failed

    @property
    def bytes(self) -> int:
        """Length of the file."""
        return self._end

    def close(self) -> None:
        """Write everything to the disk and close."""
        self.sync()
        self._file.close()


def _parsed(line: bytes) -> tuple[int, bytes] | None:
    """Number and JSON of a line; None if it is damaged."""
    try:
        number, checksum, body = line.rstrip(b"\n").split(b" ", 2)
        return (int(number), body) if zlib.crc32(body) == int(checksum, 16) else None
    except ValueError:
        return None
