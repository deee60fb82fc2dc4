"""The page of a sweep's directory."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dsfit.errors import InputError
from dsfit.experiment import files
from dsfit.experiment.files import to_toml
from dsfit.report import environment, markdown
from dsfit.report.environment import items, mapping
from dsfit.report.links import Place
from dsfit.report.page import Block, Code, Facts, Page, Section, Table, Text, Verdict
from dsfit.report.run import asked

_SCHEMA_VERSION = 1
_MOST_FAILURES = 200
_OPEN = 'import pandas\n\ntable = pandas.read_parquet("results.parquet")\ntable[table.status == "ok"]\n'


def sweep_page(folder: Path, place: Place) -> Page:
    """The page of a sweep: finished, or unfinished."""
    try:
        record, problem = files.read_json(folder / "sweep.json", _SCHEMA_VERSION), ""
    except InputError as error:
        record, problem = {}, f"sweep.json: {error.value}. `dsfit sweep` with the same config goes on from there."
    counts, provenance = mapping(record.get("counts")), mapping(record.get("provenance"))
    verdict = _verdict(counts) if record else Verdict("fail", "unfinished", [problem])
    sections = [
        Section("result", "What came out", [verdict, *_tables(folder, place, record)]),
        Section("failures", "Failures", _failures(folder, place, record)),
        Section("asked", "What was asked", [*_design(record), *asked(folder, place, "dsfit sweep config.toml")]),
        Section("environment", "Environment", _environment(record, provenance)),
        Section("files", "Files", [_files(folder, place)], printed=False),
    ]
    title = str(record.get("title") or record.get("name") or folder.absolute().name)
    return Page("Sweep", title, verdict, _facts(folder, record, counts), [s for s in sections if s.blocks])


def _verdict(counts: Mapping[str, Any]) -> Verdict:
    cells, done, failed = (counts.get(key) for key in ("cells", "done", "failed"))
    told = f"{done} of {cells} cells are done, {failed} failed."
    if failed:
        return Verdict("fail", f"{failed} cells failed", [f"{told} They are rows of the table too, with their status."])
    good = cells is not None and cells == done
    return Verdict("pass" if good else "unclear", "complete" if good else "not complete", [told])


def _tables(folder: Path, place: Place, record: Mapping[str, Any]) -> list[Block]:
    links = [place.link(folder / "table.md", "Markdown", " ")]
    try:
        text = (folder / "table.md").read_bytes().decode(errors="replace")
    except OSError as error:
        return [Text([f"table.md cannot be read ({error.strerror})."])] if record else []
    title = str(record.get("title") or record.get("name") or "")
    blocks = markdown.blocks(text, title, links)
    if (folder / "results.parquet").is_file():
        blocks += [Text(["All rows are in `results.parquet`, which pandas and polars open:"]), Code(_OPEN, "Python")]
    return blocks


def _failures(folder: Path, place: Place, record: Mapping[str, Any]) -> list[Block]:
    failures = [mapping(one) for one in items(record.get("failures"))]
    if not failures:
        return []
    rows = [[str(one.get(key, "")) for key in ("cell", "fate", "error", "config")] for one in failures[:_MOST_FAILURES]]
    notes = ["Each config computes its cell again, alone and with the same random numbers: `dsfit run CONFIG`."]
    table = Table(
        "Cells that failed", ["cell", "fate", "error", "config"], rows, "rlll", notes,
        left_out=len(failures) - len(rows),
    )  # fmt: skip
    return [table, place.files(sorted(folder.glob("failures/*.toml"))[:20], folder)]


def _design(record: Mapping[str, Any]) -> list[Block]:
    design = mapping(record.get("design"))
    return [Code(to_toml({"sweep": dict(design)}), "design")] if design else []


def _environment(record: Mapping[str, Any], provenance: Mapping[str, Any]) -> list[Block]:
    head = ["started", "machines", "wall time", "time of cells", "cells taken over", "tried again"]
    rows = [
        [
            environment.moment(one.get("started")),
            str(one.get("machines", "none")),
            environment.duration(one.get("seconds")),
            environment.duration(one.get("cell_seconds")),
            str(one.get("cells_reused", "")),
            str(one.get("tried_again", "")),
        ]
        for one in map(mapping, items(record.get("sessions")))
    ]
    facts = environment.facts(provenance)
    blocks: list[Block] = [Facts(facts)] if facts else []
    if rows:
        blocks.append(Table("Sittings", head, rows[: markdown.MOST_ROWS], "llrrrr"))
    return blocks


def _files(folder: Path, place: Place) -> Block:
    names = ("results.parquet", "table.md", "sweep.json", "config.toml", "cells.log")
    return place.files([folder / name for name in names], folder)


def _facts(folder: Path, record: Mapping[str, Any], counts: Mapping[str, Any]) -> list[tuple[str, str]]:
    provenance = mapping(record.get("provenance"))
    seconds = [one.get("seconds") for one in map(mapping, items(record.get("sessions")))]
    known = [float(x) for x in seconds if isinstance(x, int | float)]
    found = [
        ("sweep", folder.absolute().name),
        ("kind of cells", str(record.get("kind") or "")),
        *((key, f"{counts[key]:,}") for key in ("points", "cells", "rows") if isinstance(counts.get(key), int)),
        ("wall time", environment.duration(sum(known)) if known else ""),
        ("seed", "" if provenance.get("seed") is None else str(provenance["seed"])),
        ("commit", environment.commit(provenance)),
    ]
    return [(name, value) for name, value in found if value]
