"""Makes one experiment: computes what is out of date, then draws what is out of date."""

from __future__ import annotations

import hashlib
import importlib.util
import json
import shutil
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from dsfit.errors import InputError
from dsfit.experiment import files, provenance
from dsfit.figures import state
from dsfit.figures.catalogue import Entry
from dsfit.figures.data import data_hash, read_data, write_data
from dsfit.figures.experiment import Work


def make(
    entry: Entry,
    out: Path,
    overrides: Sequence[str] = (),
    *,
    say: Callable[[str], None],
    force: bool = False,
    only_draw: bool = False,
    width_mm: float = 150.0,
) -> dict[str, Any]:
    """Compute and draw; returns what was done: `{"computed": bool, "drawn": bool, "seconds": float}`.

    Args:
        entry: the experiment.
        out: directory of all experiments; this one's folder is below it.
        overrides: `key=value` changes of its settings.
        say: told what goes on.
        force: compute anew.
        only_draw: draw the data that are there, whatever code and settings made them.
        width_mm: width of figures.

    Raises:
        InputError: settings are wrong, a package is missing, or there are no data to draw.
    """
    clock, folder = time.perf_counter(), out / entry.name
    computed = False if only_draw else compute(entry, folder, overrides, say, force)
    if only_draw and not (folder / "data.json").is_file():
        raise InputError(str(folder), "no data", "a folder in which `dsfit figures run` has computed")
    drawn = draw(entry, folder, say, width_mm, force)
    return {"computed": computed, "drawn": drawn, "seconds": round(time.perf_counter() - clock, 3)}


def compute(entry: Entry, folder: Path, overrides: Sequence[str], say: Callable[[str], None], force: bool) -> bool:
    """Compute unless the data are up to date; returns whether it did."""
    settings = entry.settings(overrides)
    plain = settings.model_dump(mode="json")
    key = _key([entry.name, plain, entry.numbers_version()])
    if not force and state.is_computed(folder, key):
        say("up to date")
        return False
    if missing := [name for name in entry.experiment.needs if importlib.util.find_spec(name) is None]:
        raise InputError(f"packages of {entry.name}", f"{', '.join(missing)} missing", "the extra `bench` installed")
    kept = folder / "files"
    if force:
        shutil.rmtree(kept, ignore_errors=True)
    kept.mkdir(parents=True, exist_ok=True)
    (folder / "computed.json").unlink(missing_ok=True)
    started, clock, processor = provenance.now(), time.perf_counter(), time.process_time()
    data = entry.experiment.compute(settings, Work(kept, entry.root, say))
    found = write_data(folder, data)
    files.write_bytes(folder / "settings.toml", files.to_toml(settings.model_dump(exclude_none=True)).encode())
    record = {
        "key": key,
        "data": found,
        "settings": plain,
        "started": started,
        "seconds": round(time.perf_counter() - clock, 3),
        "cpu_seconds": round(time.process_time() - processor, 3),
        "provenance": provenance.provenance(),
    }
    state.write_state(folder / "computed.json", record)
    return True


def draw(entry: Entry, folder: Path, say: Callable[[str], None], width_mm: float, force: bool) -> bool:
    """Draw and tabulate unless that is up to date; returns whether it did."""
    from dsfit.experiment.plots.style import styled
    from dsfit.figures.page import Page

    key = _key([entry.name, data_hash(folder), entry.drawing_version(), width_mm])
    if not force and state.is_drawn(folder, key):
        return False
    say("drawing")
    data, page, written = read_data(folder), Page(width_mm), []
    (folder / "drawn.json").unlink(missing_ok=True)
    for name in ("figures", "tables"):
        shutil.rmtree(folder / name, ignore_errors=True)
    with styled():
        for name, figure in entry.drawing.figures(data, page).items():
            written += page.save(figure, folder / "figures", name)
    for table in entry.drawing.tables(data):
        written.append(folder / "tables" / f"{table.name}.md")
        files.write_bytes(written[-1], table.markdown().encode())
    hashes = {path.relative_to(folder).as_posix(): state.file_hash(path) for path in written}
    state.write_state(folder / "drawn.json", {"key": key, "width_mm": width_mm, "files": hashes})
    return True


def _key(what: list[Any]) -> str:
    return hashlib.sha256(json.dumps(what, sort_keys=True).encode()).hexdigest()[:16]
