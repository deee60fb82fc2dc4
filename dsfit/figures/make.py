"""Makes one experiment: computes what is out of date, then draws what is out of date."""

from __future__ import annotations

import hashlib
import importlib.util
import json
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from dsfit.errors import InputError
from dsfit.experiment import about, files, provenance
from dsfit.experiment.sections import Section
from dsfit.figures import state
from dsfit.figures.catalogue import Entry
from dsfit.figures.data import data_hash, read_data, write_data
from dsfit.figures.experiment import Used, Work


@dataclass(frozen=True)
class Look:
    """How figures are made.

    Attributes:
        width_mm: their width.
        pgf: whether they are written as PGF too.
    """

    width_mm: float = 150.0
    pgf: bool = False


def make(
    entry: Entry,
    out: Path,
    overrides: Sequence[str] = (),
    *,
    say: Callable[[str], None],
    force: bool = False,
    only_draw: bool = False,
    look: Look | None = None,
) -> dict[str, Any]:
    """Compute and draw; returns what was done: `{"computed": bool, "drawn": bool, "seconds": float}`.

    Args:
        entry: the experiment.
        out: directory of all experiments; this one's folder is below it.
        overrides: `key=value` changes of its settings.
        say: told what goes on.
        force: compute anew.
        only_draw: draw the data that are there, whatever code and settings made them.
        look: width and formats of figures.

    Raises:
        InputError: settings are wrong, a package is missing, or there are no data to draw.
    """
    clock, folder = time.perf_counter(), out / entry.name
    computed = False if only_draw else compute(entry, folder, overrides, say, force)
    if not state.has_data(folder):
        raise InputError(str(folder), "no whole data", "a folder in which `dsfit figures run` has computed")
    drawn = draw(entry, folder, say, look or Look(), force)
    return {"computed": computed, "drawn": drawn, "seconds": round(time.perf_counter() - clock, 3)}


def is_up_to_date(
    entry: Entry, out: Path, overrides: Sequence[str] = (), *, only_draw: bool = False, look: Look | None = None
) -> bool:
    """Whether `make` would find nothing to do."""
    folder = out / entry.name
    there = state.has_data(folder) and (only_draw or is_computed(entry, folder, entry.settings(overrides)))
    return there and state.is_drawn(folder, drawing_key(entry, folder, look or Look()))


def is_computed(entry: Entry, folder: Path, settings: Section) -> bool:
    """Whether the data are there, whole, and made from this code, these settings, and files that are as they were."""
    found = state.read_state(folder / state.COMPUTED)
    if found.get("key") != data_key(entry, settings) or not state.has_data(folder):
        return False
    return Used(**found.get("used", {})).is_unchanged(entry.root)


def compute(entry: Entry, folder: Path, overrides: Sequence[str], say: Callable[[str], None], force: bool) -> bool:
    """Compute unless the data are up to date; returns whether it did. Data of before stay until the new ones are
    there."""
    settings = entry.settings(overrides)
    if not force and is_computed(entry, folder, settings):
        return False
    if missing := [name for name in entry.experiment.needs if importlib.util.find_spec(name) is None]:
        raise InputError(f"packages of {entry.name}", f"{', '.join(missing)} missing", "the extra `bench` installed")
    key, plain = data_key(entry, settings), settings.model_dump(mode="json")
    kept = folder / "files"
    if force:
        shutil.rmtree(kept, ignore_errors=True)
    kept.mkdir(parents=True, exist_ok=True)
    started, clock, processor = provenance.now(), time.perf_counter(), time.process_time()
    work = Work(kept, entry.root, say)
    data = entry.experiment.compute(settings, work)
    seconds, cpu = time.perf_counter() - clock, time.process_time() - processor
    (folder / state.COMPUTED).unlink(missing_ok=True)
    found = write_data(folder, data)
    files.write_bytes(folder / "settings.toml", files.to_toml(settings.model_dump(exclude_none=True)).encode())
    of_data = state.hashes(folder, [folder / name for name in (*state.DATA, "settings.toml")])
    record = {
        "key": key,
        "data": found,
        "settings": plain,
        "used": asdict(work.used),
        "started": started,
        "seconds": round(seconds, 3),
        "cpu_seconds": round(cpu, 3),
        "provenance": provenance.provenance(),
        "files": {**of_data, **state.hashes(folder, [path for path in kept.rglob("*") if _is_kept(path)])},
    }
    state.write_state(folder / state.COMPUTED, record)
    return True


def draw(entry: Entry, folder: Path, say: Callable[[str], None], look: Look, force: bool = False) -> bool:
    """Draw and tabulate unless that is up to date; returns whether it did. Old pictures stay until all new ones are
    there."""
    key = drawing_key(entry, folder, look)
    if not force and state.is_drawn(folder, key):
        return False
    say("drawing")
    fresh = folder / ".drawing"
    shutil.rmtree(fresh, ignore_errors=True)
    data = read_data(folder)
    figures = draw_figures(entry, data, fresh / "figures", look, source(entry, folder))
    tables = write_tables(entry, data, fresh / "tables")
    (folder / state.DRAWN).unlink(missing_ok=True)
    for name in ("figures", "tables"):
        shutil.rmtree(folder / name, ignore_errors=True)
        if (fresh / name).is_dir():
            (fresh / name).rename(folder / name)
    shutil.rmtree(fresh, ignore_errors=True)
    written = [folder / file for one in (*figures.values(), *tables.values()) for file in one["files"]]
    record = {
        "key": key,
        "data": data_hash(folder),
        **asdict(look),
        **entry.description(),
        "figures": figures,
        "tables": tables,
        "files": state.hashes(folder, written),
    }
    state.write_state(folder / state.DRAWN, record)
    return True


def draw_figures(entry: Entry, data: Any, folder: Path, look: Look, origin: about.About) -> dict[str, dict[str, Any]]:
    """Write every figure; returns caption, files and place in the order of drawing of each, by name."""
    from dsfit.experiment.plots.style import styled
    from dsfit.figures.page import Page

    page, found = Page(look.width_mm), {}
    captions = getattr(entry.drawing, "captions", lambda data: {})(data)
    with styled():
        for name, figure in entry.drawing.figures(data, page).items():
            written = page.save(figure, folder, name, {**origin, "figure": name}, pgf=look.pgf)
            caption = captions.get(name, entry.experiment.shows)
            files_of = [f"figures/{path.name}" for path in written]
            found[name] = {"caption": caption, "files": files_of, "place": len(found)}
    return found


def write_tables(entry: Entry, data: Any, folder: Path) -> dict[str, dict[str, Any]]:
    """Write every table as Markdown and LaTeX; returns caption, files and place in the order of each, by name."""
    found = {}
    for table in entry.drawing.tables(data):
        label = f"tab:{entry.name}:{table.name}"
        for suffix, text in (("md", table.markdown()), ("tex", table.latex(label))):
            files.write_bytes(folder / f"{table.name}.{suffix}", text.encode())
        names = [f"tables/{table.name}.{suffix}" for suffix in ("md", "tex")]
        found[table.name] = {"caption": table.caption, "files": names, "place": len(found)}
    return found


def source(entry: Entry, folder: Path) -> dict[str, Any]:
    """What figures say of where they come from: the data's settings, hash and code, and the code that draws."""
    computed = state.read_state(folder / state.COMPUTED)
    return about.about(
        entry.name,
        computed["provenance"],
        settings=about.plain_hash(computed["settings"]),
        data=computed["data"][:16],
        drawing=entry.drawing_version(),
    )


def data_key(entry: Entry, settings: Section) -> str:
    """Stands for code and settings."""
    return _key([entry.name, settings.model_dump(mode="json"), entry.numbers_version()])


def drawing_key(entry: Entry, folder: Path, look: Look) -> str:
    """Stands for data, code, look and captions."""
    return _key([entry.name, data_hash(folder), entry.drawing_version(), asdict(look), entry.description()])


def _is_kept(path: Path) -> bool:
    return path.is_file() and not path.name.startswith(".")


def _key(what: list[Any]) -> str:
    return hashlib.sha256(json.dumps(what, sort_keys=True).encode()).hexdigest()[:16]
