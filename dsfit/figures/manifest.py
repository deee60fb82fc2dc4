"""One file that lists everything in an output directory, with hashes that can be checked."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from dsfit.experiment import files, provenance
from dsfit.figures import state
from dsfit.figures.data import SCHEMA_VERSION, data_hash
from dsfit.figures.thesis import thesis

MANIFEST, THESIS = "manifest.json", "thesis.tex"


def write_manifest(out: Path) -> dict[str, Any]:
    """Collect the state of every experiment below `out` into `manifest.json`, and write `thesis.tex`; returns the
    manifest.

    `experiments.NAME` holds `computed` (settings, code, packages, machine, seconds), `drawn` (title, what "reproduced"
    means, captions), `files` with their SHA-256, `state` in words, and `failure` of the last attempt.
    """
    with state.lock(out):
        folders = sorted({path.parent for name in (state.COMPUTED, state.FAILED) for path in out.glob(f"*/{name}")})
        found = {folder.name: _experiment(folder) for folder in folders}
        complete = {name: one["drawn"] for name, one in found.items() if one["state"] == COMPLETE}
        files.write_bytes(out / THESIS, thesis(complete).encode())
        manifest = {
            "schema_version": SCHEMA_VERSION,
            "dsfit": provenance.code_version(),
            "experiments": found,
            "files": state.hashes(out, [out / THESIS]),
        }
        files.write_json(out / MANIFEST, manifest)
    return manifest


COMPLETE = "complete"


def _experiment(folder: Path) -> dict[str, Any]:
    computed, drawn = state.read_state(folder / state.COMPUTED), state.read_state(folder / state.DRAWN)
    failed = state.read_state(folder / state.FAILED)
    known = {**computed.get("files", {}), **drawn.get("files", {})}
    return {
        "state": _state(folder, computed, drawn),
        "failure": failed.get("failure"),
        "computed": {k: v for k, v in computed.items() if k not in ("files", "schema_version")},
        "drawn": {k: v for k, v in drawn.items() if k not in ("files", "schema_version")},
        "files": dict(sorted(known.items())),
    }


def _state(folder: Path, computed: dict[str, Any], drawn: dict[str, Any]) -> str:
    if not computed:
        return "not computed"
    try:
        whole = data_hash(folder) == computed["data"]
    except (OSError, KeyError):
        whole = False
    if not whole:
        return "data damaged"
    if not drawn:
        return "not drawn"
    return COMPLETE if drawn.get("data") == computed["data"] else "drawn from other data"


def check_manifest(out: Path) -> tuple[int, list[str]]:
    """How many files were checked, and what differs from `manifest.json`, empty if nothing does: files that are missing
    or changed, and figures and tables that it does not list.

    Raises:
        InputError: there is no manifest, or it is damaged.
    """
    manifest = files.read_json(out / MANIFEST, SCHEMA_VERSION)
    listed = dict(manifest["files"])
    for name, one in manifest["experiments"].items():
        listed.update({f"{name}/{path}": found for path, found in one["files"].items()})
    wrong = []
    for path, found in listed.items():
        if not (out / path).is_file():
            wrong.append(f"{path}: missing")
        elif state.file_hash(out / path) != found:
            wrong.append(f"{path}: changed")
    for folder in ("figures", "tables"):
        extra = [path.relative_to(out).as_posix() for path in sorted(out.glob(f"*/{folder}/*"))]
        wrong += [f"{path}: not in the manifest" for path in extra if path not in listed]
    return len(listed), wrong
