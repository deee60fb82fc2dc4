"""The page of all experiments, and that of a sweep."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from dsfit.experiment import files
from dsfit.figures import state
from dsfit.figures.make import make
from dsfit.report import write_report
from dsfit.report.links import Place
from dsfit.report.page import Code, Fold, Page, Picture, Section, Table
from dsfit.report.write import make_page
from tests.report.reading import check_references, parse

Experiments = tuple[Path, Path]


def page_of(out: Path, root: Path) -> Page:
    return make_page(out, Place(out / "report.html"), root)


def section(page: Page, title: str) -> Section:
    return next(one for one in page.sections if one.title == title)


def words(page: Page) -> dict[str, str]:
    """State of each experiment, from the overview."""
    table = next(block for block in page.sections[0].blocks if isinstance(block, Table))
    return {row[0]: row[2] for row in table.rows}


def test_every_experiment_stands_as_it_is(experiments: Experiments) -> None:
    page = page_of(*experiments)
    expected = {
        "page_failed": "failed", "page_made": "up to date", "page_missing": "missing", "page_other": "other settings",
    }  # fmt: skip
    assert words(page) == expected
    assert page.verdict.state == "fail" and page.verdict.word == "1 of 4 failed"
    titles = [one.title for one in page.sections]
    assert titles == ["Overview", *(f"{name} <i>and</i> more" for name in expected), "Environment"]


def test_an_experiment_has_figures_tables_command_rules_and_latex(experiments: Experiments) -> None:
    page = page_of(*experiments)
    made = section(page, "page_made <i>and</i> more").blocks
    pictures = [block for block in made if isinstance(block, Picture)]
    assert [p.name for p in pictures] == ["Second", "First"]  # as drawn
    assert pictures[0].caption.startswith("The second figure's")
    assert pictures[1].caption == "" and "What page_made shows" in pictures[1].alt  # the text above says so already
    (table,) = [block for block in made if isinstance(block, Table)]
    assert table.rows == [["a|b <script>", "1.0"], ["c", "-20.5"]] and table.align == "lr"
    assert table.caption == "What the numbers are." and [link.name for link in table.links] == ["Markdown", "LaTeX"]
    assert [block.text for block in made if isinstance(block, Code)] == ["dsfit figures run page_made"]
    folds = {block.title: block.blocks for block in made if isinstance(block, Fold)}
    rules = next(block for block in folds["What “reproduced” means here"] if isinstance(block, Table))
    assert rules.rows[0] == ["values", "within 1e-09 (relative)"] and rules.rows[-1] == ["everything else", "equal"]
    latex = folds["LaTeX"][0]
    assert isinstance(latex, Code)
    assert r"\includegraphics[width=\linewidth]{page_made/figures/second.pdf}" in latex.text
    assert r"\input{page_made/tables/numbers.tex}" in latex.text and r"What page\_made shows, " in latex.text
    other = section(page, "page_other <i>and</i> more").blocks
    assert [block.text for block in other if isinstance(block, Code)] == ["dsfit figures run page_other --set n=4"]


def test_the_page_is_safe_whole_and_repeats(experiments: Experiments) -> None:
    out, root = experiments
    before = (out / "report.html").read_bytes()
    assert write_report(out, root=root).read_bytes() == before
    page, linked = parse(out / "report.html"), check_references(out / "report.html")
    assert len(page.all("script")) == 1 and "ValueError: </pre><script>alert(6)</script>" in page.text
    assert "exit 1: <b>no</b>" in page.text and "a|b <script>" in page.text
    assert {out / "manifest.json", out / "page_made" / "figures" / "first.pdf"} <= set(linked)
    assert str(out) not in before.decode() and str(root) not in before.decode()


def test_damage_and_change_are_told(experiments: Experiments, tmp_path: Path) -> None:
    root = experiments[1]
    out = Path(shutil.copytree(experiments[0], tmp_path / "out"))
    (out / "page_made" / "figures" / "first.png").write_bytes(b"no picture")
    (out / "page_other" / "data.json").write_text("{}")
    shutil.rmtree(out / "page_failed")
    page = page_of(out, root)
    assert words(page) == {
        "page_failed": "missing", "page_made": "not drawn", "page_missing": "missing", "page_other": "damaged",
    }  # fmt: skip
    for name in ("computed.json", "drawn.json"):
        path = out / "page_made" / name
        whole = json.loads(path.read_text())
        for key in [key for key in whole if key != "schema_version"]:
            for junk in ("x", {"a": {}}, [["a"]]):
                path.write_text(json.dumps({**whole, key: junk}))
                check_references(write_report(out, root=root))
        path.write_text(json.dumps(whole))
    (out / "manifest.json").write_text("{")
    assert "Overview" in parse(write_report(out, root=tmp_path)).text  # of a root without experiments


def test_code_that_has_changed_makes_it_out_of_date(
    experiments: Experiments, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from dsfit.figures import catalogue

    monkeypatch.setattr(catalogue, "sources_hash", lambda *a, **k: "another")
    assert words(page_of(*experiments))["page_made"] == "out of date"
    found = catalogue.find(experiments[1], "page_made")
    make(found, tmp_path, say=lambda what: None)
    assert words(page_of(tmp_path, experiments[1]))["page_made"] == "up to date"


@pytest.mark.parametrize(
    ("one", "state_", "word"),
    [
        ({"verdict": "agrees", "compared": {"close": 3}}, "pass", "reproduced"),
        ({"verdict": "agrees", "data": "of another run"}, "unclear", "not compared"),
        ({"verdict": "deviates", "deviating": {"<b>x": "2, not 1"}, "deviating_count": 30}, "fail", "deviates"),
        ({"verdict": "not compared", "reason": "no reference data"}, "unclear", "not compared"),
        ({"verdict": 3}, "unclear", "not compared"),
        (None, "unclear", "not compared"),
    ],
)
def test_what_verification_found(
    experiments: Experiments, tmp_path: Path, one: dict[str, object] | None, state_: str, word: str
) -> None:
    out = Path(shutil.copytree(experiments[0], tmp_path / "out"))
    hash_ = state.read_state(out / "page_made" / "computed.json")["data"]
    found = one if one is None or "data" in one else {**one, "data": hash_}
    files.write_json(out / "verify.json", {"schema_version": 1, "experiments": {"page_made": found}})
    page = page_of(out, experiments[1])
    table = next(block for block in page.sections[0].blocks if isinstance(block, Table))
    row = next(row for row in table.rows if row[0] == "page_made")
    assert row[3] == word and table.head[3] == "against stored data"
    text = parse(write_report(out, root=experiments[1])).text
    assert ("<b>x" in text) == (word == "deviates") and ("no reference data" in text) == ("reason" in (one or {}))
    (out / "verify.json").write_text("{")
    assert "verify.json: damaged" in parse(write_report(out, root=experiments[1])).text


def test_the_page_of_a_sweep(tmp_path: Path) -> None:
    record = {
        "schema_version": 1, "title": "<u>wide</u>", "name": "wide", "kind": "compare",
        "design": {"grid": {"fiber.eta": [1.4, 1.5]}},
        "counts": {"points": 1234, "cells": 1234, "done": 1232, "failed": 2, "rows": 2466},
        "failures": [
            {"cell": 3, "fate": "raised", "error": "</td><script>", "config": "failures/000003.toml"},
            {"cell": 9, "fate": "killed", "error": None, "config": "failures/000009.toml"},
        ],
        "provenance": {"seed": 5},
        "sessions": [{"started": "2026-01-01T00:00:00+00:00", "seconds": 3.5, "machines": "2 local processes"}],
    }  # fmt: skip
    (tmp_path / "config.toml").write_text("title = 'x'\n")
    (tmp_path / "cells.log").write_text("")
    assert "unfinished" in parse(write_report(tmp_path)).text
    files.write_json(tmp_path / "sweep.json", record)
    (tmp_path / "table.md").write_text("# <u>wide</u>\n\ncounts\n\n| key | value |\n|---|---:|\n| fiber.eta | 1.4 |\n")
    (tmp_path / "results.parquet").write_bytes(b"PAR1")
    (tmp_path / "failures").mkdir()
    (tmp_path / "failures" / "000003.toml").write_text("")
    page = parse(write_report(tmp_path))
    linked = {path.name for path in check_references(tmp_path / "report.html")}
    assert {"results.parquet", "000003.toml", "sweep.json"} <= linked and not page.all("u")
    assert all(text in page.text for text in ("2 cells failed", "1,234", "</td><script>", "fiber.eta", "read_parquet"))
    for key in list(record):
        for junk in (None, 3, "x", [], {"a": {}}, [["a"]]):
            if key != "schema_version":
                files.write_json(tmp_path / "sweep.json", {**record, key: junk})
                parse(write_report(tmp_path))
