"""The rows that a README has for experiments."""

from __future__ import annotations

from collections.abc import Sequence

from dsfit.figures.catalogue import Entry
from dsfit.figures.rules import Estimate, Measured
from dsfit.figures.table import Table

_HEAD = ("name", "what it shows", "command", "minutes", "statistical", 'what "reproduced" means')


def markdown_rows(entries: Sequence[Entry]) -> str:
    """A table in Markdown: name, what it shows, command, minutes on one core, which values are statistical, and what
    "reproduced" means for each."""
    rows = []
    for entry in entries:
        rules = entry.experiment.reproduces
        statistical = [f"`{pattern}`" for pattern, rule in rules.items() if isinstance(rule, Estimate)]
        measured = [f"`{pattern}` (measured)" for pattern, rule in rules.items() if isinstance(rule, Measured)]
        rows.append([
            f"`{entry.name}`", entry.experiment.shows, f"`dsfit figures run {entry.name}`",
            f"{entry.experiment.minutes:g}", ", ".join([*statistical, *measured]) or "nothing", _reproduced(entry),
        ])  # fmt: skip
    return Table("experiments", "", _HEAD, rows, "lllrll").markdown().rstrip()


def _reproduced(entry: Entry) -> str:
    said: dict[str, list[str]] = {}
    for pattern, rule in entry.experiment.reproduces.items():
        said.setdefault(str(rule), []).append(f"`{pattern}`")
    return "; ".join([*(f"{', '.join(names)} {rule}" for rule, names in said.items()), "all else equal"])
