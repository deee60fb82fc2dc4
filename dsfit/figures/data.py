"""What an experiment stores: named arrays and a record of plain values, in two files whose bytes repeat."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from dsfit.experiment import files

SCHEMA_VERSION = 1


@dataclass(frozen=True)
class Data:
    """Results of an experiment.

    Attributes:
        arrays: name to array.
        record: plain values (numbers, strings, lists, tables); numbers that repeat only in distribution or that are
            seconds belong under keys that the experiment's rules name.
    """

    arrays: Mapping[str, np.ndarray] = field(default_factory=dict)
    record: Mapping[str, Any] = field(default_factory=dict)

    def values(self) -> Iterator[tuple[str, Any]]:
        """Every array, and every leaf of the record under its dotted key; a list of numbers is one leaf."""
        yield from self.arrays.items()
        yield from _leaves("", self.record)


def _leaves(prefix: str, value: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(value, Mapping):
        for key in sorted(value, key=str):
            yield from _leaves(f"{prefix}.{key}" if prefix else str(key), value[key])
    elif isinstance(value, list | tuple) and any(isinstance(item, Mapping | list | tuple) for item in value):
        for k, item in enumerate(value):
            yield from _leaves(f"{prefix}.{k}", item)
    else:
        yield prefix, value


def write_data(folder: Path, data: Data) -> str:
    """Write `data.npz` and `data.json`; returns the SHA-256 of their contents."""
    files.write_arrays(folder / "data.npz", {name: np.asarray(data.arrays[name]) for name in sorted(data.arrays)})
    files.write_json(folder / "data.json", {"schema_version": SCHEMA_VERSION, "record": data.record})
    return data_hash(folder)


def read_data(folder: Path) -> Data:
    """Read what `write_data` wrote; numbers that JSON lacks come back as the strings "nan", "inf" and "-inf".

    Raises:
        InputError: a file is missing or damaged.
    """
    record = files.read_json(folder / "data.json", SCHEMA_VERSION)["record"]
    return Data(files.read_arrays(folder / "data.npz"), record)


def data_hash(folder: Path) -> str:
    """SHA-256 over both data files."""
    digest = hashlib.sha256()
    for name in ("data.npz", "data.json"):
        digest.update((folder / name).read_bytes())
    return digest.hexdigest()
