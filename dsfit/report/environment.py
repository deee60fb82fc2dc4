"""Where numbers came from, as facts: code, machine, seeds, sittings, load."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from dsfit.experiment.files import number
from dsfit.experiment.race_report import seconds as time_text

Fact = tuple[str, str]


def mapping(value: Any) -> Mapping[str, Any]:
    """The value if it is a table, else an empty one: stored files may hold anything."""
    return value if isinstance(value, Mapping) else {}


def items(value: Any) -> Sequence[Any]:
    """The value if it is a list, else an empty one."""
    return value if isinstance(value, list) else []


def duration(value: Any) -> str:
    """Seconds in words; empty for what is no time."""
    try:
        found = number(value)
    except (TypeError, ValueError):
        return ""
    return time_text(found) if math.isfinite(found) and value is not None else ""


def moment(value: Any) -> str:
    """An ISO time as people write it, to the minute."""
    text = str(value or "")
    return text[:16].replace("T", " ") + " UTC" if len(text) >= 16 and text.endswith("+00:00") else text


def commit(provenance: Mapping[str, Any]) -> str:
    """The commit in short, with a word if there were changes."""
    git = mapping(provenance.get("git"))
    if not git.get("commit"):
        return ""
    return str(git["commit"])[:12] + (" with changes" if git.get("changed") else "")


def facts(provenance: Mapping[str, Any], settings: Mapping[str, Any] | None = None) -> list[Fact]:
    """Everything that provenance says, by name; `settings` are more facts that come first."""
    machine, packages = mapping(provenance.get("machine")), mapping(provenance.get("packages"))
    versions = ", ".join(f"{name} {packages[name]}" for name in sorted(packages, key=str.lower) if packages[name])
    processor = str(machine.get("processor", ""))
    if processor and machine.get("cores"):
        processor += f", {machine['cores']} cores"
    found = [
        *((name, str(value)) for name, value in (settings or {}).items()),
        ("seed", _plain(provenance.get("seed"))),
        ("precision", _plain(provenance.get("dtype"))),
        ("dsfit", _plain(provenance.get("dsfit"))),
        ("commit", commit(provenance)),
        ("Python", _plain(provenance.get("python"))),
        ("packages", versions),
        ("system", _plain(machine.get("system"))),
        ("processor", processor),
    ]
    return [(name, value) for name, value in found if value]


def _plain(value: Any) -> str:
    return "" if value is None else str(value)


def sessions(provenance: Mapping[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Head and rows: one for each sitting that the run took."""
    rows = [
        [
            moment(one.get("started")),
            moment(one.get("finished")),
            duration(one.get("seconds")),
            _plain(one.get("workers")),
            _plain(one.get("cells_reused")),
        ]
        for one in map(mapping, items(provenance.get("sessions")))
    ]
    return ["started", "finished", "wall time", "processes", "cells taken over"], rows


def load(cells: Sequence[Any]) -> str:
    """How much of the machine the timed cells had, if they watched; empty if not."""
    watches = [mapping(mapping(cell).get("watch")) for cell in cells]
    shares = [100 * number(w["cpu_share"]) for w in watches if isinstance(w.get("cpu_share"), int | float)]
    loads = [number(w["load"][0]) for w in watches if items(w.get("load"))]
    if not shares:
        return ""
    average = f"; load average {min(loads):.1f} to {max(loads):.1f}" if loads else ""
    return f"{min(shares):.0f} to {max(shares):.0f} % of a core while timing{average}"
