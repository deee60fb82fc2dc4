"""`results.parquet`: all rows of a sweep in the order of its cells, made from the log a piece at a time.

Columns: `cell` and `point` (numbers from 0), one for every key of the design under its dotted name, those of the kind
of config (`rows.columns`), `status` ("ok" or "failed"), `error`, and last what was measured, with "seconds" in its
name. A cell that failed has one row.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dsfit.errors import InputError
from dsfit.experiment.design import Choices, Design, Range
from dsfit.sweep.log import CellLog
from dsfit.sweep.plan import Plan
from dsfit.sweep.rows import CONTEXT, columns

if TYPE_CHECKING:
    import pyarrow

_PIECE = 10_000  # rows held at a time


def require_parquet() -> None:
    """Refuse to begin where the table could not be written.

    Raises:
        InputError: pyarrow is not installed.
    """
    try:
        import pyarrow.parquet  # noqa: F401
    except ImportError:
        raise InputError("results.parquet", "no pyarrow", "the package `pyarrow` to be installed") from None


def key_types(design: Design) -> dict[str, str]:
    """The kind of column of every key, as in `rows.Columns`; "json" for what has no other place."""
    found = {key: _type_of(values) for key, values in design.grid.items()}
    for key, axis in design.space.items():
        if isinstance(axis, Range):
            found[key] = "int" if axis.integer else "float"
        elif isinstance(axis, Choices):
            found[key] = _type_of(axis.values)
    return found


def _type_of(values: list[Any]) -> str:
    def is_number(value: Any) -> bool:
        return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 2**63

    if all(isinstance(value, bool) for value in values):
        return "bool"
    if all(isinstance(value, str) for value in values):
        return "text"
    if all(is_number(value) for value in values):
        return "int" if all(isinstance(value, int) for value in values) else "float"
    if all(isinstance(value, list) and all(is_number(x) for x in value) for value in values):
        return "floats"
    return "json"


def schema(plan: Plan) -> pyarrow.Schema:
    """Names and types of all columns."""
    import pyarrow as pa

    types = {
        "int": pa.int64(), "float": pa.float64(), "bool": pa.bool_(), "text": pa.string(), "json": pa.string(),
        "floats": pa.list_(pa.float64()), "texts": pa.list_(pa.string()),
    }  # fmt: skip
    own = columns(plan.config.kind)
    names = {"cell": "int", "point": "int", **key_types(plan.design)}
    names |= {name: what for name, what in own.items() if "seconds" not in name}
    names |= {"status": "text", "error": "text"}
    names |= {name: what for name, what in own.items() if "seconds" in name} | {"cell_seconds": "float"}
    return pa.schema([(name, types[what]) for name, what in names.items()])


def write_table(plan: Plan, log: CellLog, path: Path) -> int:
    """Write the table of all cells in the log through a temporary file; returns the number of rows."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    shape, rows = schema(plan), 0
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with pq.ParquetWriter(temporary, shape, compression="zstd") as writer:
            for piece in _pieces(plan, log, shape.names):
                writer.write_table(pa.Table.from_pydict(piece, schema=shape))
                rows += len(piece["cell"])
        with open(temporary, "rb") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    return rows


def _pieces(plan: Plan, log: CellLog, names: list[str]) -> Iterator[dict[str, list[Any]]]:
    """Columns of some ten thousand rows at a time."""
    piece: dict[str, list[Any]] = {name: [] for name in names}
    for row in _rows(plan, log):
        for name in names:
            piece[name].append(row.get(name))
        if len(piece["cell"]) >= _PIECE:
            yield piece
            piece = {name: [] for name in names}
    if piece["cell"]:
        yield piece


def _rows(plan: Plan, log: CellLog) -> Iterator[dict[str, Any]]:
    own = list(columns(plan.config.kind))
    types = key_types(plan.design)
    known: tuple[int, dict[str, Any]] = (-1, {})
    for cell in range(len(plan)):
        outcome = log.get(cell)
        if outcome is None:
            continue
        task = plan.task(cell)
        if known[0] != task.point:
            known = (task.point, {key: _plain(value, types[key]) for key, value in task.values.items()})
        shared = {"cell": cell, "point": task.point, **known[1], "cell_seconds": outcome["seconds"]}
        if "fate" in outcome:
            place = zip((name for name in own if name in CONTEXT), outcome["context"] or [], strict=False)
            yield {**shared, **dict(place), "status": "failed", "error": f"{outcome['fate']}: {outcome['error']}"}
        for row in outcome.get("rows", []):
            yield {**shared, **dict(zip(own, row, strict=True)), "status": "ok"}


def _plain(value: Any, what: str) -> Any:
    if what == "json":
        return json.dumps(value, sort_keys=True, default=str)
    if what == "float":
        return float(value)
    return [float(x) for x in value] if what == "floats" else value
