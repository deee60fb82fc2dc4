"""How an experiment of `dsfit figures` stands: up to date, out of date, failed, damaged or missing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dsfit.errors import InputError
from dsfit.experiment.files import to_toml
from dsfit.figures import state
from dsfit.figures.catalogue import Entry, find, names
from dsfit.report.environment import mapping
from dsfit.report.page import Verdict

_LOG_LINES, _LOG_BYTES = 40, 6000


@dataclass(frozen=True)
class Standing:
    """An experiment in an output directory.

    Attributes:
        name: of the experiment and its folder.
        folder: its folder, which need not be there.
        told: what is told of it: title, shows, minutes, needs, and `reproduces` in words by pattern; of the folder
            `experiments`, or else of what was drawn.
        computed, drawn: what the folder says of itself; empty where that is missing or damaged.
        verdict: how it stands.
        changes: settings that differ from the experiment's config, as `key=value`.
        log: the end of what a failed attempt said.
    """

    name: str
    folder: Path
    told: Mapping[str, Any]
    computed: Mapping[str, Any]
    drawn: Mapping[str, Any]
    verdict: Verdict
    changes: tuple[str, ...] = ()
    log: str = ""

    @property
    def title(self) -> str:
        """Its heading."""
        return str(self.told.get("title") or self.name)


@dataclass(frozen=True)
class _Found:
    """What the folder says, before it is judged."""

    folder: Path
    entry: Entry | None = None
    problem: str = ""
    computed: Mapping[str, Any] = field(default_factory=dict)
    drawn: Mapping[str, Any] = field(default_factory=dict)
    failed: Mapping[str, Any] = field(default_factory=dict)


def standings(out: Path, root: Path) -> list[Standing]:
    """All experiments that the root declares or the directory holds, by name."""
    held = {path.parent.name for name in (state.COMPUTED, state.FAILED, "log.txt") for path in out.glob(f"*/{name}")}
    declared = set(names(root))
    return [_standing(out / name, root if name in declared else None) for name in sorted(held | declared)]


def _standing(folder: Path, root: Path | None) -> Standing:
    entry, problem = None, ""
    if root is not None:
        try:
            entry = find(root, folder.name)
        except Exception as error:  # a module of the folder may do anything while it is imported
            problem = str(error)[:300]
    states = {name: mapping(state.read_state(folder / f"{name}.json")) for name in ("computed", "drawn", "failed")}
    found = _Found(folder, entry, problem, **states)
    verdict, changes = _judge(found)
    log = _log(folder) if verdict.state == "fail" else ""
    return Standing(folder.name, folder, _told(found), found.computed, found.drawn, verdict, changes, log)


def _told(found: _Found) -> Mapping[str, Any]:
    if found.entry is None:
        return found.drawn
    return {**found.entry.description(), "needs": list(found.entry.experiment.needs)}


def _judge(found: _Found) -> tuple[Verdict, tuple[str, ...]]:
    if found.failed:
        earlier = " What is shown is of an earlier attempt." if found.computed else ""
        return Verdict("fail", "failed", [f"{found.failed.get('failure') or 'no reason given'}.{earlier}"]), ()
    if not found.computed:
        if (found.folder / "log.txt").is_file():
            return Verdict("fail", "not finished", ["It was begun, and has not come to its end."]), ()
        problem = [found.problem + "."] if found.problem else ["It has not been computed here."]
        return Verdict("unclear", "missing", problem), ()
    if not state.has_data(found.folder):
        return Verdict("fail", "damaged", ["The data are not those that were computed."]), ()
    if not found.drawn or not state.is_drawn(found.folder, found.drawn.get("key", "")):
        return Verdict("fail", "not drawn", ["Figures or tables are missing, or not those that were drawn."]), ()
    if found.entry is None:
        return Verdict("none", "made", [found.problem + "."] if found.problem else []), ()
    return _fresh(found, found.entry)


def _fresh(found: _Found, entry: Entry) -> tuple[Verdict, tuple[str, ...]]:
    """Whether what is there is what the experiment would make now; and the settings that were changed."""
    from dsfit.figures.make import is_computed

    try:
        settings = entry.settings()
    except (InputError, OSError) as error:
        return Verdict("unclear", "made", [f"Its settings cannot be read: {error}."]), ()
    now, then = settings.model_dump(mode="json"), mapping(found.computed.get("settings"))
    differing = sorted(key for key in then if key not in now or then[key] != now[key])
    changes = tuple(to_toml({key: then[key]}).strip().replace(" = ", "=", 1) for key in differing)
    if changes:
        return Verdict("unclear", "other settings", [f"Changed: {', '.join(changes)}."]), changes
    try:
        fresh = is_computed(entry, found.folder, settings)
    except (TypeError, ValueError, AttributeError):  # a damaged state file
        fresh = False
    if not fresh:
        return Verdict("unclear", "out of date", ["Code or files that decide the numbers have changed since."]), ()
    return Verdict("pass", "up to date"), ()


def _log(folder: Path) -> str:
    try:
        with open(folder / "log.txt", "rb") as file:
            file.seek(max(0, (folder / "log.txt").stat().st_size - _LOG_BYTES))
            lines = file.read().decode(errors="replace").splitlines()
    except OSError:
        return ""
    return "\n".join(lines[-_LOG_LINES:])
