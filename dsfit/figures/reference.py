"""Reference data of experiments: what they computed once, with settings and where it came from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dsfit.errors import InputError
from dsfit.experiment import about, files
from dsfit.figures import state
from dsfit.figures.catalogue import Entry
from dsfit.figures.data import SCHEMA_VERSION, Data, read_data

LARGEST = 1_000_000


@dataclass(frozen=True)
class Reference:
    """Stored data, the settings that they were computed with, and where they come from."""

    data: Data
    settings: Mapping[str, Any]
    origin: Mapping[str, Any]


def read(folder: Path) -> Reference:
    """Read what `store` wrote.

    Raises:
        InputError: a file is missing or damaged.
    """
    content = files.read_json(folder / "data.json", SCHEMA_VERSION)
    if not {"settings", "origin"} <= content.keys():
        raise InputError(str(folder / "data.json"), "no settings", "a file that `dsfit figures accept` wrote")
    return Reference(read_data(folder), content["settings"], content["origin"])


def store(entry: Entry, folder: Path, against: Path) -> int:
    """Store an experiment's data as `AGAINST/NAME/data.npz` and `data.json`; returns their bytes.

    Raises:
        InputError: there are no whole data, the last attempt failed, or a file is above 1 MB.
    """
    if not state.has_data(folder) or state.read_state(folder / state.FAILED):
        raise InputError(str(folder), "no whole data, or a failure after them", "a folder with a finished experiment")
    computed = state.read_state(folder / state.COMPUTED)
    data = read_data(folder)
    origin = about.about(
        entry.name,
        computed["provenance"],
        machine=computed["provenance"]["machine"],
        data=computed["data"][:16],
        computed=computed["started"],
        seconds=computed["seconds"],
    )
    content = {"record": data.record, "settings": computed["settings"], "origin": origin}
    arrays, plain = (folder / "data.npz").read_bytes(), _json(content)
    for name, size in (("data.npz", len(arrays)), ("data.json", len(plain))):
        if size > LARGEST:
            raise InputError(str(folder / name), f"{size} bytes", f"at most {LARGEST} bytes for reference data")
    files.write_bytes(against / entry.name / "data.npz", arrays)
    files.write_bytes(against / entry.name / "data.json", plain)
    return len(arrays) + len(plain)


def _json(content: dict[str, Any]) -> bytes:
    return files.json_bytes({"schema_version": SCHEMA_VERSION, **content})
