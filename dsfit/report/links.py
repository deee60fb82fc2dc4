"""Links from a page to files beside it."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from dsfit.report.page import Files, Link

MOST_FILES = 400
"""Files that a list shows."""

_WHAT = {
    "config.toml": "the config, resolved",
    "settings.toml": "the settings",
    "provenance.json": "versions, machine, seed, sessions",
    "result.json": "every number",
    "table.md": "the tables as Markdown",
    "data.npz": "arrays",
    "data.json": "numbers and names",
    "computed.json": "made from what, when and where",
    "drawn.json": "hashes of figures and tables",
    "manifest.json": "every file with its hash",
    "verify.json": "comparison with stored data",
    "failed.json": "why the last attempt came to nothing",
    "thesis.tex": "a document with every figure and table",
    "sweep.json": "design, counts, seconds, versions, machines",
    "results.parquet": "all rows",
    "cells.log": "what every finished cell left",
    "log.txt": "what the last attempt said",
    "image.exr": "radiance, variance, counts and times, float32",
}
_SUFFIX = {
    ".pdf": "for print",
    ".pgf": "for LaTeX",
    ".tex": "for LaTeX",
    ".md": "Markdown",
    ".exr": "float32 image",
    ".npz": "arrays",
    ".parquet": "table",
    ".csv": "table",
}


@dataclass(frozen=True)
class Place:
    """Where the page will be; links are relative to it."""

    page: Path

    def link(self, path: Path, name: str = "", what: str = "") -> Link:
        """A link to a file or folder."""
        relative = Path(os.path.relpath(path.absolute(), self.page.absolute().parent)).as_posix()
        what = what or _WHAT.get(path.name, _SUFFIX.get(path.suffix, ""))
        return Link(quote(os.fsencode(relative)), name or path.name, what, _size(path))

    def files(self, paths: Iterable[Path], base: Path) -> Files:
        """Those of the files that are there, named relative to `base`."""
        found = [path for path in paths if path.is_file()]
        shown = [self.link(path, path.relative_to(base).as_posix()) for path in found[:MOST_FILES]]
        return Files(shown, left_out=len(found) - len(shown))


def _size(path: Path) -> str:
    try:
        return size(path.stat().st_size) if path.is_file() else ""
    except OSError:
        return ""


def size(count: float) -> str:
    """Bytes in words."""
    for unit in ("B", "kB", "MB"):
        if count < 1000:
            return f"{count:.0f} {unit}" if unit == "B" or count >= 10 else f"{count:.1f} {unit}"
        count /= 1000
    return f"{count:.1f} GB"
