"""`dsfit check`: what it runs, what it writes, how it exits, and what it refuses."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from typer.testing import CliRunner

import dsfit
from dsfit.checks.suites import SUITES
from dsfit.cli import app
from dsfit.errors import InputError
from dsfit.experiment.check_report import findings_of, markdown, report, verdict_line
from dsfit.experiment.check_schema import CheckConfig
from dsfit.experiment.checking import known_names
from dsfit.experiment.validation import load

CLI = CliRunner()
CONFIG = """
title = "a small check"
[fiber]
preset = "brown"
[bsdf]
azimuthal = "simplified"
[contexts]
theta_r_deg = [10, 60]
[check]
suites = ["chi_square"]
proposals = ["R", "uniform"]
[check.chi_square]
samples = 2000
cells = [8, 6]
"""
WRONG = '''
import torch
from dsfit.proposals import UniformSphere
from dsfit.proposals.printed import PRINTED

def printed(integrand, context):
    return PRINTED["front_as_printed"]()

def fine(integrand, context):
    return UniformSphere()
'''


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "small.toml"
    path.write_text(CONFIG)
    return path


def invoke(*arguments: Any) -> Any:
    return CLI.invoke(app, [str(a) for a in arguments], catch_exceptions=False)


def result_of(out: Path) -> dict[str, Any]:
    (path,) = out.glob("*/result.json")
    return json.loads(path.read_text())


def test_a_check_of_any_config(config: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = invoke("check", config, "--out", out, "--workers", 0)
    assert done.exit_code == 0, done.output
    assert "passed" in done.output and "chi_square" in done.output
    result = result_of(out)
    assert result["report"]["verdict"] == "pass"
    assert [cell["identity"]["context"]["theta_r_deg"] for cell in result["cells"]] == [10, 60]
    assert len(result["cells"][0]["findings"]) == 4  # two proposals, cells and mass
    (directory,) = out.iterdir()
    names = {path.name for path in directory.rglob("*") if path.is_file()}
    assert {"result.json", "table.md", "config.toml", "provenance.json", "chi_square.png"} <= names
    again = invoke("check", config, "--out", out, "--workers", 0)
    assert again.exit_code == 0 and "already done" in again.output
    assert invoke("show", directory).exit_code == 0


def test_random_numbers_differ_between_contexts_and_repeat_between_runs(config: Path, tmp_path: Path) -> None:
    p_values = []
    for folder in ("a", "b"):
        invoke("check", config, "--out", tmp_path / folder, "--workers", 0, "--set", "output.plots=false")
        p_values.append([f["p_value"] for cell in result_of(tmp_path / folder)["cells"] for f in cell["findings"]])
    assert p_values[0] == p_values[1]
    assert len({p for p in p_values[0] if p is not None}) == 4


def test_a_users_wrong_sampler_is_rejected(config: Path, tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(WRONG)
    config.write_text(CONFIG.replace("[check]\n", '[check]\nuser = ["mine.py:printed", "mine.py:fine"]\n'))
    done = invoke("check", config, "--out", tmp_path / "out", "--workers", 0)
    assert done.exit_code == 3, done.output
    assert "FAILED" in done.output and "mine.py:printed" in done.output
    failed = {f["subject"] for f in result_of(tmp_path / "out")["report"]["failed"]}
    assert failed == {"mine.py:printed, mass"}
    assert any(path.name.startswith("chi_square") for path in (tmp_path / "out").rglob("*.png"))


def test_a_saved_proposal_is_checked(config: Path, tmp_path: Path) -> None:
    bsdf = dsfit.DualScattering(dsfit.Fiber.preset("brown"))
    dsfit.save_proposal(tmp_path / "brown.npz", dsfit.StructuredProposal(bsdf, dsfit.Context(0.2)))
    config.write_text(CONFIG.replace("[check]\n", '[check]\nsaved = ["brown.npz"]\n'))
    assert invoke("check", config, "--out", tmp_path / "out", "--workers", 0).exit_code == 0
    subjects = {f["subject"] for f in result_of(tmp_path / "out")["cells"][0]["findings"]}
    assert "brown.npz" in subjects


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ('check.proposals=["R", "TTT"]', ("check.proposals.1", "did you mean 'TT'")),
        ('check.suites=["chi"]', ("check.suites", "chi_square")),
        ('check.saved=["nothing.npz"]', ("check.saved", "nothing.npz")),
        ('check.user=["nothing.py:f"]', ("check.user", "file.py:function")),
        ("check.level=1.5", ("check.level", "< 1")),
        ("check.chi_square.samples=1", ("check.chi_square.samples", ">= 100")),
        ("check.chi_square.cells=[1]", ("check.chi_square.cells", "2 elements")),
    ],
)
def test_bad_configs(config: Path, tmp_path: Path, change: str, words: tuple[str, ...]) -> None:
    done = invoke("check", config, "--out", tmp_path / "out", "--set", change)
    assert done.exit_code == 2
    assert all(word in done.output for word in words), done.output
    assert not (tmp_path / "out").exists()


def test_a_file_that_cannot_be_run_is_named(config: Path, tmp_path: Path) -> None:
    (tmp_path / "broken.py").write_text("import sys; sys.exit(7)")
    config.write_text(CONFIG.replace("[check]\n", '[check]\nuser = ["broken.py:f"]\n'))
    done = invoke("check", config, "--out", tmp_path / "out")
    assert done.exit_code == 2 and "broken.py" in done.output and "SystemExit" in done.output


def test_names_of_parts_are_validated(config: Path) -> None:
    with pytest.raises(InputError, match="faults"):
        load(config, ['kind="check"', 'check.suites=["faults"]', 'check.faults.faults=["none such"]'])


def test_every_suite_has_options_and_a_module() -> None:
    assert set(SUITES) <= set(CheckConfig.model_fields)
    assert set(CheckConfig().suites) <= set(SUITES)
    for name, suite in SUITES.items():
        module = suite.load()
        assert callable(module.run) and (suite.scope != "once" or module.parts()), name


def test_names_of_proposals_build(config: Path) -> None:
    from dsfit.experiment import build
    from dsfit.experiment.checking import proposals_of

    light = 'light={kind="lobes", lobes=[{theta_deg=10, width_deg=20}]}'
    made = load(config, ['kind="check"', 'check.proposals="all"', light]).config
    found = proposals_of(made, build.integrand(made), dsfit.Context(0.2))
    assert set(found) == set(known_names()) - {"fitted"}
    omega = torch.tensor([[0.2, 1.0]], dtype=torch.float64)
    assert all(not p(dsfit.Context(0.2)).log_prob(omega).isnan().any() for p in found.values())


def test_the_report_counts_and_lists() -> None:
    def finding(**changes: Any) -> dict[str, Any]:
        base = {"suite": "furnace", "subject": "x", "case": "y", "p_value": None, "value": None, "bound": None}
        return {**base, "unclear": None, "detail": "d | e", "data": {}, **changes}

    cell = {"suite": "furnace", "seconds": 1.5, "findings": [
        finding(value="inf", bound=1.0), finding(value=0.5, bound=1.0), finding(p_value=0.3),
        finding(p_value="nan"), finding(unclear="too short"),
    ]}  # fmt: skip
    found = report([cell], 0.01)
    (row,) = found["suites"]
    counts = [row[key] for key in ("findings", "passed", "failed", "unclear")]
    assert counts == [5, 2, 2, 1] and found["verdict"] == "fail"
    result = {"report": found, "title": "t", "name": "n", "cells": [cell]}
    assert "FAILED: 5 findings, 2 failed, 1 unclear" in verdict_line(result)
    assert "too short" in markdown(result) and "d \\| e" in markdown(result)
    assert len(findings_of([cell])) == 5
