"""What every experiment by name must keep to: settings, rules, drawings, tables, reference data."""

from __future__ import annotations

import ast
import dataclasses
import importlib.util
import math
import shutil
import subprocess
import tomllib
from pathlib import Path

import numpy as np
import pytest

from dsfit.figures import Close, Data, Estimate, Measured, agreement, reference
from dsfit.figures.catalogue import Entry, find, names
from dsfit.figures.data import read_data, write_data
from dsfit.figures.experiment import Work
from dsfit.figures.latex import escape
from dsfit.figures.make import Look, draw_figures, write_tables
from dsfit.figures.page import Page
from dsfit.figures.thesis import thesis
from dsfit.figures.verify import compare, error_name, matches, rules_of

ROOT = Path(__file__).resolve().parents[2]
REFERENCE = ROOT / "experiments" / "reference"
NAMES = names(ROOT)
each = pytest.mark.parametrize("name", NAMES)


def entry_of(name: str) -> Entry:
    """The experiment, unless this installation lacks its packages."""
    tree = ast.parse((ROOT / "experiments" / f"{name}.py").read_bytes())
    call = next(node for node in ast.walk(tree) if getattr(getattr(node, "func", None), "id", "") == "Experiment")
    needs = next((ast.literal_eval(word.value) for word in call.keywords if word.arg == "needs"), ())
    if missing := [package for package in needs if importlib.util.find_spec(package) is None]:
        pytest.skip(f"without {', '.join(missing)}")
    return find(ROOT, name)


def stored(name: str) -> reference.Reference:
    """Its reference data."""
    if not (REFERENCE / name / "data.json").is_file():
        pytest.skip(f"no reference data of {name}")
    return reference.read(REFERENCE / name)


@each
def test_it_says_what_it_shows_and_takes(name: str):
    experiment = entry_of(name).experiment
    assert experiment.title.strip() and len(experiment.shows) > 20 and 0 < experiment.minutes < 600
    assert experiment.small, "no settings for a trial"


@each
def test_its_settings_are_all_written_out_with_a_comment_each(name: str):
    entry = entry_of(name)
    entry.settings()
    entry.settings(entry.experiment.small)
    text = entry.config.read_text()
    fields = entry.experiment.settings.model_fields
    # what may be left out stands there as a comment, for TOML has no null
    absent = {key for key, field in fields.items() if field.default is None and f"\n# {key} =" in text}
    assert set(tomllib.loads(text)) == set(fields) - absent
    assert not (bare := uncommented(text)), bare


def uncommented(text: str) -> list[str]:
    """Lines with a setting that neither end with a comment nor stand below one, alone or in a group."""
    found, told, inside = [], False, False
    for line in text.splitlines():
        if inside:
            inside = not line.rstrip().endswith("]") and "]  #" not in line
        elif line.startswith("#") or line.startswith("["):
            told = True
        elif not line.strip():
            told = False
        else:
            inside = line.rstrip().endswith("[")
            if not told and "#" not in line and not inside:
                found.append(line)
    return found


@each
def test_it_computes_without_drawing(name: str):
    tree = ast.parse((ROOT / "experiments" / f"{name}.py").read_bytes())
    imported = [node.module or "" for node in tree.body if isinstance(node, ast.ImportFrom)]
    imported += [alias.name for node in tree.body if isinstance(node, ast.Import) for alias in node.names]
    assert not [module for module in imported if module.startswith(("matplotlib", "dsfit.experiment.plots"))]
    drawing = entry_of(name).drawing
    assert callable(drawing.figures) and callable(drawing.tables)


@each
def test_reference_data_are_small_of_these_settings_and_held_to_every_rule(name: str):
    entry, found = entry_of(name), stored(name)
    for path in (REFERENCE / name).iterdir():
        assert path.stat().st_size <= reference.LARGEST, path.name
    assert found.settings == entry.settings().model_dump(mode="json")
    values = dict(found.data.values())
    governing = rules_of(values, entry.experiment.reproduces)
    for pattern, rule in entry.experiment.reproduces.items():
        assert any(matches(pattern, value) is not None for value in values), f"{pattern} fits no value"
        if isinstance(rule, Estimate):
            held = [value for value, (_, first) in governing.items() if first == pattern]
            assert all(error_name(rule, pattern, value) in values for value in held), pattern
    same = compare(found.data, found.data, entry.experiment.reproduces)
    assert same["verdict"] == "agrees", same["deviating"]


@each
def test_it_draws_reference_data_as_wide_as_the_page(name: str):
    from dsfit.experiment.plots.style import styled

    entry, data, page = entry_of(name), stored(name).data, Page(150.0)
    with styled():
        figures = entry.drawing.figures(data, page)
    for one in figures.values():
        assert one.get_size_inches()[0] == pytest.approx(page.width)
        assert one.get_size_inches()[1] < 235 / 25.4, "higher than a page"
    tables = entry.drawing.tables(data)
    assert figures or tables
    captions = getattr(entry.drawing, "captions", lambda data: {})(data)
    assert set(captions) == set(figures), "a caption for every figure"
    for text in captions.values():
        assert len(text) > 80 and "[U+" not in escape(text) and not {"nan", "inf", "nan."} & set(text.split())
    for table in tables:
        assert table.caption.strip() and table.rows and all(isinstance(x, str) for row in table.rows for x in row)
        assert "[U+" not in table.latex()


@pytest.mark.slow
@each
def test_it_draws_reference_data_twice_with_the_same_bytes(name: str, tmp_path: Path):
    entry, data = entry_of(name), stored(name).data
    for one in ("a", "b"):
        draw_figures(entry, data, tmp_path / one, Look(), {"name": name, "dsfit": "1"})
        write_tables(entry, data, tmp_path / one)
    first = {path.name: path.read_bytes() for path in (tmp_path / "a").iterdir()}
    assert first == {path.name: path.read_bytes() for path in (tmp_path / "b").iterdir()}


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="no pdflatex")
def test_a_thesis_of_all_reference_data_compiles(tmp_path: Path):
    found = {}
    for name in NAMES:
        if not (REFERENCE / name / "data.json").is_file():
            continue
        entry, data = find(ROOT, name), reference.read(REFERENCE / name).data
        figures = draw_figures(entry, data, tmp_path / name / "figures", Look(), {"name": name, "dsfit": "1"})
        tables = write_tables(entry, data, tmp_path / name / "tables")
        found[name] = {**entry.description(), "figures": figures, "tables": tables}
    if not found:
        pytest.skip("no reference data")
    (tmp_path / "thesis.tex").write_text(thesis(found))
    for _ in range(2):
        command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "thesis.tex"]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, timeout=600)
        log = done.stdout.decode(errors="replace")
        assert done.returncode == 0, log[-2000:]
    assert "undefined" not in log and "multiply defined" not in log


def changed(value: object, by: float) -> object:
    """A value whose first finite number is another one."""
    held = agreement.numbers(value)
    if held is None or not np.isfinite(held).any():
        return None
    spot = np.flatnonzero(np.isfinite(held).ravel())[0]
    if isinstance(value, np.ndarray):
        other = value.copy()
        other.reshape(-1)[spot] += np.asarray(by, dtype=np.float64).astype(value.dtype)
        return None if np.array_equal(other, value, equal_nan=True) else other
    other = list(value) if isinstance(value, list) else [value]
    other[spot] += int(math.ceil(by)) if isinstance(other[spot], int) else by
    return other if isinstance(value, list) else other[0]


@pytest.mark.slow
@each
def test_a_trial_repeats_draws_and_planted_changes_are_found(name: str, tmp_path: Path):
    entry = entry_of(name)
    settings, found = entry.settings(entry.experiment.small), []
    for one in ("a", "b"):
        folder = tmp_path / one
        (folder / "files").mkdir(parents=True)
        write_data(folder, entry.experiment.compute(settings, Work(folder / "files", ROOT, lambda what: None)))
        found.append(read_data(folder))
    # a trial has too little data for its numbers to mean much
    rules = {
        pattern: dataclasses.replace(rule, most=math.inf) if isinstance(rule, Estimate) else rule
        for pattern, rule in entry.experiment.reproduces.items()
    }
    same = compare(found[1], found[0], rules)
    assert same["verdict"] == "agrees", same["deviating"]
    draw_figures(entry, found[0], tmp_path / "figures", Look(), {"name": name, "dsfit": "1"})
    write_tables(entry, found[0], tmp_path / "tables")

    values, planted = dict(found[0].values()), 0
    for value, (rule, pattern) in rules_of(values, rules).items():
        if isinstance(rule, Measured | str) or agreement.numbers(values[value]) is None:
            continue
        by = 1.0
        if isinstance(rule, Close):
            by = 10 * (rule.atol + rule.rtol * float(np.nanmax(np.abs(agreement.numbers(values[value])), initial=1.0)))
        if isinstance(rule, Estimate):
            error = agreement.numbers(values[error_name(rule, pattern, value)])
            by = 50 * float(np.max(error, where=np.isfinite(error), initial=0.0)) + 1e-9
        if value not in found[0].arrays or (other := changed(values[value], by)) is None:
            continue
        wrong = compare(Data({**found[0].arrays, value: other}, found[0].record), found[0], rules)
        assert wrong["verdict"] == "deviates" and value in wrong["deviating"], value
        planted += 1
        if planted == 12:
            break
    assert planted or not found[0].arrays
