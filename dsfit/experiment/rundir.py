"""A run directory: what is in it, and which cells are done.

config.toml        the resolved config; `dsfit run` takes it again
provenance.json    versions, seed, dtype, machine, git state, times
cells/0003.json    numbers of one cell (one context of one grid point); written last, so it marks the cell as done
cells/0003.npz     its maps and raw estimates
proposals/0003-NAME.npz   its fitted proposals (`dsfit.load_proposal`)
result.json        everything in one file; written last, so it marks the run as finished
image.exr  image.png      of a rendering
table.md  figures/*.png  figures/*.pdf
images/*.exr  images/*.png   what was rendered
report.html        all of it on one page
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from dsfit.errors import InputError
from dsfit.experiment import files
from dsfit.experiment.schema import SCHEMA_VERSION

_OWN = (
    "config.toml", "provenance.json", "result.json", "table.md", "image.exr", "image.png", "cells", "proposals",
    "figures", "images", "report.html",
)  # fmt: skip


class RunFailure(RuntimeError):
    """A run that could not be finished; what was done stays and is used by the next attempt."""


def slug(name: str) -> str:
    """A method's name as part of a file name."""
    return re.sub(r"[^A-Za-z0-9._-]+", "-", name).strip(".-") or "method"


class RunDirectory:
    """Reads and writes the parts of one run directory; see the module's docstring."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)

    def cell_path(self, index: int, suffix: str = "json") -> Path:
        """File of a cell."""
        return self.path / "cells" / f"{index:04d}.{suffix}"

    def proposal_path(self, index: int, method: str) -> Path:
        """File of a cell's fitted proposal."""
        return self.path / "proposals" / f"{index:04d}-{slug(method)}.npz"

    def cell(self, index: int, identity: dict[str, Any]) -> dict[str, Any] | None:
        """A finished cell, or None if it is missing, damaged, or belongs to something else: then it is computed
        anew."""
        try:
            data = files.read_json(self.cell_path(index), SCHEMA_VERSION)
            files.read_arrays(self.cell_path(index, "npz"))
        except InputError:
            return None
        return data if data.get("identity") == identity else None

    def write_cell(self, index: int, data: dict[str, Any], arrays: dict[str, np.ndarray]) -> None:
        """Write a cell; its JSON comes last and marks it as done."""
        files.write_arrays(self.cell_path(index, "npz"), arrays)
        files.write_json(self.cell_path(index), {"schema_version": SCHEMA_VERSION, **data})

    def arrays(self, index: int) -> dict[str, np.ndarray]:
        """Arrays of a cell."""
        return files.read_arrays(self.cell_path(index, "npz"))

    def result(self) -> dict[str, Any]:
        """result.json.

        Raises:
            InputError: there is none (an unfinished run or no run directory at all), or it is damaged.
        """
        try:
            there = (self.path / "result.json").exists()
        except (OSError, ValueError) as error:  # a name too long, a folder that may not be read
            reason = getattr(error, "strerror", None) or str(error)
            raise InputError(str(self.path), reason, "the directory of a finished run") from None
        if not there:
            unfinished = (self.path / "config.toml").exists()
            state = "an unfinished run: give its config to `dsfit run` again" if unfinished else "no result.json there"
            raise InputError(str(self.path), state, "the directory of a finished run")
        return files.read_json(self.path / "result.json", SCHEMA_VERSION)

    def finished(self) -> dict[str, Any] | None:
        """result.json, or None if the run is not finished or its result is damaged."""
        try:
            return self.result()
        except InputError:
            return None

    def write_json(self, name: str, data: dict[str, Any]) -> None:
        """Write a JSON file of the run."""
        files.write_json(self.path / name, {"schema_version": SCHEMA_VERSION, **data})

    def provenance(self) -> dict[str, Any]:
        """provenance.json, empty if there is none yet."""
        try:
            return files.read_json(self.path / "provenance.json", SCHEMA_VERSION)
        except InputError:
            return {}

    def clear(self) -> None:
        """Remove what a run writes, and nothing else."""
        for name in _OWN:
            target = self.path / name
            if target.is_dir() and not target.is_symlink():
                shutil.rmtree(target)
            else:
                target.unlink(missing_ok=True)

    @contextlib.contextmanager
    def lock(self) -> Iterator[None]:
        """Keep a second process out of this directory while the first one writes (where the system has file locks).

        Raises:
            RunFailure: another process holds it.
        """
        try:
            import fcntl
        except ImportError:  # pragma: no cover (Windows)
            yield
            return
        self.path.mkdir(parents=True, exist_ok=True)
        handle = os.open(self.path / ".lock", os.O_RDWR | os.O_CREAT)
        try:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                raise RunFailure(f"{self.path}: another `dsfit run` is at work here") from None
            yield
        finally:
            os.close(handle)
