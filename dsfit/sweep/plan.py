"""The cells of a sweep, by number, without holding them: points of the design times contexts (or parts of checks)."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dsfit.experiment.cells import work_of
from dsfit.experiment.design import Choices, Design, design_of
from dsfit.experiment.reader import RawConfig
from dsfit.experiment.schema import Config
from dsfit.experiment.validation import load_base
from dsfit.sweep.tasks import Base, Task

KINDS = ("compare", "sweep", "transmittance", "amortise", "check")
MAX_CELLS = 10_000_000
VALIDATED = 10_000
"""Points beyond this many are validated when their turn comes; before the start, this many spread over all of them."""
SENT_BYTES = 2**20
"""Files up to this size that the config names are sent to the workers; larger ones have to be there."""


@dataclass(frozen=True)
class Plan:
    """All cells of a sweep.

    Attributes:
        name: stem of the config file.
        config: the config without any value of the design.
        base: what workers get.
        design: the points.
        ends: number of the cell after each point's last, `[points]`.
    """

    name: str
    config: Config
    base: Base
    design: Design
    ends: np.ndarray

    def __len__(self) -> int:
        return int(self.ends[-1])

    def task(self, cell: int) -> Task:
        """The cell of this number."""
        point = int(np.searchsorted(self.ends, cell, side="right"))
        first = int(self.ends[point - 1]) if point else 0
        return Task(cell, point, self.design.values(point), cell - first)


def make_plan(
    path: str | Path, overrides: Sequence[str] = (), say: Callable[[int, int], None] = lambda done, total: None
) -> Plan:
    """Read a config, and validate the points of its design: all of them up to 10^4, otherwise 10^4 spread over them.

    Args:
        path: TOML file.
        overrides: `key=value` changes.
        say: told how many points are validated, of how many.

    Raises:
        ConfigError: the config, its design, or one of the points is wrong.
    """
    raw, config = load_base(path, overrides)
    if config.kind not in KINDS:
        raise raw.error(("kind",), f"one of {', '.join(map(repr, KINDS))} in a sweep")
    design = design_of(raw, config.sweep)
    if not design.keys:
        raise raw.error(("sweep",), "a [sweep.grid] or a [sweep.space]", {})
    base = _base(raw, design)
    counts = _counts(base, design, say)
    ends = np.cumsum(counts)
    if ends[-1] > MAX_CELLS:
        raise raw.error(("sweep",), f"at most {MAX_CELLS} cells (these are {ends[-1]})")
    return Plan(raw.name, config, base, design, ends)


def _base(raw: RawConfig, design: Design) -> Base:
    shared = raw.copy()
    shared.data.pop("sweep")
    if shared.data.get("kind") == "sweep":
        shared.data["kind"] = "compare"
    return Base(shared, design.sources, dict(_files([shared.data, design.grid, design.space])))


def _files(node: Any) -> Iterator[tuple[str, bytes]]:
    """Files that the tables or the design name, as far as they are small; their paths are absolute by now."""
    if isinstance(node, Choices):
        node = node.values
    if isinstance(node, dict | list):
        for value in node.values() if isinstance(node, dict) else node:
            yield from _files(value)
    elif isinstance(node, str) and os.path.isabs(node):
        path, colon, _ = node.rpartition(":")
        for name in {node, path} if colon else {node}:
            if os.path.isfile(name) and os.path.getsize(name) <= SENT_BYTES:
                yield name, Path(name).read_bytes()


def _counts(base: Base, design: Design, say: Callable[[int, int], None]) -> np.ndarray:
    """Cells of every point, `[points]`."""
    counts = np.full(len(design), -1, dtype=np.int64)
    chosen = np.unique(np.linspace(0, len(design) - 1, min(len(design), VALIDATED)).astype(np.int64))
    known: dict[str, int] = {}
    deciding = [key for key in design.keys if key.split(".")[0] in ("contexts", "check")]
    for done, point in enumerate(chosen.tolist()):
        values = design.values(point)
        config = base.config(values)
        counts[point] = sum(1 for _ in work_of(config, first=point == 0))
        if point:
            known[_shape(values, deciding)] = int(counts[point])
        say(done + 1, len(chosen))
    if len(chosen) < len(design):
        if not deciding:
            counts[1:] = counts[-1]
        for point in np.flatnonzero(counts < 0).tolist():
            values = design.values(point)
            shape = _shape(values, deciding)
            if shape not in known:
                known[shape] = sum(1 for _ in work_of(base.config(values), first=False))
            counts[point] = known[shape]
    return counts


def _shape(values: dict[str, Any], deciding: list[str]) -> str:
    """Equal for points with equally many cells: of contexts, only the lengths of lists count."""

    def counted(key: str, value: Any) -> Any:
        if key.split(".")[0] != "contexts" or isinstance(value, str | dict):
            return value
        return len(value) if isinstance(value, list) else 0

    return json.dumps([counted(key, values[key]) for key in deciding], sort_keys=True, default=str)
