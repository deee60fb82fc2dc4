"""What is known of an experiment in an output directory: what it was made from, and the hashes of what it made.

OUT/manifest.json               all experiments: state, seconds, files with their hashes
OUT/NAME/data.npz data.json     what was computed
OUT/NAME/settings.toml          with these settings
OUT/NAME/computed.json          from this code, when, where; written last
OUT/NAME/figures/*.png *.pdf    drawn from the data
OUT/NAME/tables/*.md *.tex
OUT/NAME/drawn.json             from this data and code; written last
OUT/NAME/files/                 whatever else the experiment keeps: run directories, images
OUT/NAME/log.txt                what the last attempt said
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

from dsfit.errors import InputError
from dsfit.experiment import files
from dsfit.figures.data import SCHEMA_VERSION, data_hash


def file_hash(path: Path) -> str:
    """SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def read_state(path: Path) -> dict[str, Any]:
    """`computed.json` or `drawn.json`, empty if missing or damaged."""
    try:
        return files.read_json(path, SCHEMA_VERSION)
    except InputError:
        return {}


def write_state(path: Path, state: dict[str, Any]) -> None:
    """Write `computed.json` or `drawn.json`."""
    files.write_json(path, {"schema_version": SCHEMA_VERSION, **state})


def is_computed(folder: Path, key: str) -> bool:
    """Whether the data are there, whole, and made from what `key` stands for."""
    state = read_state(folder / "computed.json")
    try:
        return state.get("key") == key and state.get("data") == data_hash(folder)
    except OSError:
        return False


def is_drawn(folder: Path, key: str) -> bool:
    """Whether figures and tables are there, whole, and made from what `key` stands for."""
    state = read_state(folder / "drawn.json")
    try:
        return state.get("key") == key and all(file_hash(folder / name) == h for name, h in state["files"].items())
    except (OSError, KeyError, AttributeError):
        return False


def write_manifest(out: Path) -> dict[str, Any]:
    """Collect the state of every experiment below `out` into `manifest.json`; returns it."""
    found: dict[str, Any] = {}
    for path in sorted(out.glob("*/computed.json")):
        folder = path.parent
        computed, drawn = read_state(path), read_state(folder / "drawn.json")
        if not computed:
            continue
        data = {name: file_hash(folder / name) for name in ("data.json", "data.npz") if (folder / name).is_file()}
        found[folder.name] = {"computed": computed, "drawn": drawn, "files": {**data, **drawn.get("files", {})}}
    manifest = {"schema_version": SCHEMA_VERSION, "experiments": found}
    files.write_json(out / "manifest.json", manifest)
    return manifest
