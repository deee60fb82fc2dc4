"""What travels to the workers, in plain data."""

from __future__ import annotations

import functools
import hashlib
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dsfit.experiment.reader import RawConfig

if TYPE_CHECKING:
    from dsfit.experiment.schema import Config


@dataclass(frozen=True)
class Base:
    """What all cells of a sweep share.

    Attributes:
        raw: the tables, without the sweep.
        sources: where the values of each key of the design were written.
        files: path -> content of what the tables name, for workers that cannot read it; big ones are left out.
    """

    raw: RawConfig
    sources: dict[str, str]
    files: dict[str, bytes] = field(default_factory=dict)

    def config(self, values: dict[str, Any]) -> Config:
        """The config with these values.

        Raises:
            ConfigError: they are not allowed.
        """
        from dsfit.experiment.design import at_point
        from dsfit.experiment.validation import validate

        changed = at_point(self.raw, self.sources, values)
        for path, content in self.files.items():
            place = _place(path, content)
            if place != path:
                changed.data = _renamed(changed.data, path, place)
        return validate(changed)


@functools.lru_cache(maxsize=64)
def _place(path: str, content: bytes) -> str:
    """Where this content can be read here: at its path, or in a temporary folder."""
    from dsfit.experiment.files import write_bytes

    for place in (Path(path), _temporary(path, content)):
        try:
            if place.read_bytes() == content:
                return str(place)
        except OSError:
            continue
    write_bytes(place, content)
    return str(place)


def _temporary(path: str, content: bytes) -> Path:
    folder = Path(tempfile.gettempdir()) / "dsfit-sweep" / hashlib.sha256(content).hexdigest()[:24]
    return folder / Path(path).name  # the name may be shown in results


def _renamed(node: Any, old: str, new: str) -> Any:
    """The tables with one path instead of another, also before the colon of `file.py:function`."""
    if isinstance(node, dict):
        return {key: _renamed(value, old, new) for key, value in node.items()}
    if isinstance(node, list):
        return [_renamed(value, old, new) for value in node]
    if isinstance(node, str) and (node == old or node.startswith(f"{old}:")):
        return new + node[len(old) :]
    return node


@dataclass(frozen=True)
class Task:
    """One cell: its number, its point's number and values, and which of the point's cells it is."""

    cell: int
    point: int
    values: dict[str, Any]
    part: int


@dataclass(frozen=True)
class Batch:
    """Cells that are computed one after another.

    Attributes:
        base: what they share.
        tasks: the cells.
        version: `numbers_version()` of the code that numbers have to come from.
        timeout: seconds after which a cell is given up, or None.
    """

    base: Base
    tasks: list[Task]
    version: str
    timeout: float | None = None
