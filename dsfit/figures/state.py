"""What is known of an experiment in an output directory: what it was made from, and the hashes of what it made.

OUT/manifest.json               all experiments: state, settings, seconds, files with their hashes, captions
OUT/thesis.tex                  a document with every figure and table
OUT/NAME/data.npz data.json     what was computed
OUT/NAME/settings.toml          with these settings
OUT/NAME/computed.json          from this code, when, where; written last
OUT/NAME/figures/*.png *.pdf    drawn from the data, at wish *.pgf
OUT/NAME/tables/*.md *.tex
OUT/NAME/drawn.json             from this data and code; written last
OUT/NAME/failed.json            why the last attempt came to nothing, if it did
OUT/NAME/files/                 whatever else the experiment keeps: run directories, images
OUT/NAME/log.txt                what the last attempt said
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from dsfit.errors import InputError
from dsfit.experiment import files
from dsfit.figures.data import SCHEMA_VERSION, data_hash

COMPUTED, DRAWN, FAILED = "computed.json", "drawn.json", "failed.json"
DATA = ("data.json", "data.npz")


def file_hash(path: Path) -> str:
    """SHA-256 of a file."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def hashes(folder: Path, paths: list[Path]) -> dict[str, str]:
    """SHA-256 of files by their names within the folder, sorted."""
    return {path.relative_to(folder).as_posix(): file_hash(path) for path in sorted(paths)}


def read_state(path: Path) -> dict[str, Any]:
    """A state file, empty if missing or damaged."""
    try:
        return files.read_json(path, SCHEMA_VERSION)
    except InputError:
        return {}


def write_state(path: Path, state: dict[str, Any]) -> None:
    """Write a state file."""
    files.write_json(path, {"schema_version": SCHEMA_VERSION, **state})


def in_order(drawn: Any) -> list[str]:
    """Names of figures or tables of a state file, whose keys are sorted, in the order in which they were drawn; those
    of unknown place last."""

    def place(name: str) -> tuple[int, str]:
        found = drawn[name].get("place") if isinstance(drawn[name], dict) else None
        return (found if isinstance(found, int) else sys.maxsize, name)

    return sorted(drawn, key=place) if isinstance(drawn, dict) else []


def has_data(folder: Path) -> bool:
    """Whether data are there that belong together: the state file written last names their hash."""
    try:
        return read_state(folder / COMPUTED).get("data") == data_hash(folder)
    except OSError:
        return False


def is_drawn(folder: Path, key: str) -> bool:
    """Whether figures and tables are there, whole, and made from what `key` stands for."""
    state = read_state(folder / DRAWN)
    try:
        return state.get("key") == key and all(file_hash(folder / name) == h for name, h in state["files"].items())
    except (OSError, KeyError, AttributeError):
        return False


@contextlib.contextmanager
def lock(folder: Path, waiting: Callable[[], None] = lambda: None) -> Iterator[int]:
    """Keep other processes out of a folder until the block ends, or wait until they are done (where the system has
    file locks); yields the lock's file descriptor.

    A process that inherits the descriptor holds the lock too, so that it stays while either lives.

    Args:
        folder: is made if it is not there.
        waiting: called again and again while another process holds the lock; what it raises ends the waiting.
    """
    try:
        import fcntl
    except ImportError:  # pragma: no cover (Windows)
        yield -1
        return
    folder.mkdir(parents=True, exist_ok=True)
    handle = os.open(folder / ".lock", os.O_RDWR | os.O_CREAT)
    try:
        while True:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except OSError:
                waiting()
                time.sleep(0.1)
        yield handle
    finally:
        os.close(handle)
