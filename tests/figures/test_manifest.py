"""The manifest lists every file with its hash, and any change is found."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from dsfit.figures.catalogue import find
from dsfit.figures.command import app
from dsfit.figures.make import make
from dsfit.figures.manifest import check_manifest, write_manifest


@pytest.fixture
def out(add, tmp_path: Path) -> Path:
    """An output directory with one experiment."""
    make(find(add("toy_m"), "toy_m"), tmp_path / "out", say=lambda what: None)
    write_manifest(tmp_path / "out")
    return tmp_path / "out"


def test_it_tells_everything(out: Path):
    found = json.loads((out / "manifest.json").read_text())
    one = found["experiments"]["toy_m"]
    assert one["state"] == "complete" and one["failure"] is None and "thesis.tex" in found["files"]
    assert one["computed"]["settings"] == {"scale": 2.0} and one["computed"]["seconds"] >= 0
    assert {"dsfit", "git", "machine", "packages", "python"} <= one["computed"]["provenance"].keys()
    assert one["drawn"]["reproduces"]["y"] == "within 1e-06 (relative)"
    assert one["drawn"]["figures"]["curve"]["caption"] == "shows x against y_x, θ_r & more.".removeprefix("shows ")
    there = {path.relative_to(out / "toy_m").as_posix() for path in (out / "toy_m").rglob("*") if path.is_file()}
    assert set(one["files"]) == there - {"computed.json", "drawn.json", ".lock", "log.txt"}


def test_every_listed_file_is_checked(out: Path):
    count, wrong = check_manifest(out)
    listed = json.loads((out / "manifest.json").read_text())
    names = [f"toy_m/{name}" for name in listed["experiments"]["toy_m"]["files"]] + list(listed["files"])
    assert (count, wrong) == (len(names), [])
    for name in names:
        content = (out / name).read_bytes()
        (out / name).write_bytes(content + b" ")
        assert check_manifest(out)[1] == [f"{name}: changed"]
        (out / name).unlink()
        assert check_manifest(out)[1] == [f"{name}: missing"]
        (out / name).write_bytes(content)
    (out / "toy_m/figures/other.png").write_bytes(b"")
    assert check_manifest(out)[1] == ["toy_m/figures/other.png: not in the manifest"]


def test_from_the_command_line(out: Path, tmp_path: Path):
    good = CliRunner().invoke(app, ["check-manifest", str(out)])
    assert good.exit_code == 0 and "files are as the manifest says" in good.stdout
    (out / "toy_m/figures/curve.png").write_bytes(b"x")
    bad = CliRunner().invoke(app, ["check-manifest", str(out)])
    assert bad.exit_code == 3 and "toy_m/figures/curve.png: changed" in bad.stdout
    assert CliRunner().invoke(app, ["check-manifest", str(tmp_path / "none")]).exit_code == 2


def test_data_that_changed_afterwards_are_told(out: Path):
    (out / "toy_m/data.json").write_text("{}")
    assert write_manifest(out)["experiments"]["toy_m"]["state"] == "data damaged"


def test_rows_for_a_readme(add):
    root = add("toy_n")
    told = CliRunner().invoke(app, ["list", "--markdown", "--root", str(root)])
    assert told.exit_code == 0
    row = next(line for line in told.stdout.splitlines() if "toy_n" in line)
    for part in ("`dsfit figures run toy_n`", "0.1", "`mean`", "`seconds` (measured)", "all else equal"):
        assert part in row
    add("toy_o")
    (root / "experiments/toy_o.py").write_text("broken = \n")
    told = CliRunner().invoke(app, ["list", "--root", str(root)])
    assert told.exit_code == 1 and "toy_n" in told.stdout and "toy_o" in told.stderr
