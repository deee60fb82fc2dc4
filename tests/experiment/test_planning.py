"""`[plan]` in a config: the command, runs that obey it, and what result.json says."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from dsfit.cli import app
from dsfit.experiment import runner
from dsfit.experiment.validation import load

CONFIG = """
[fiber]
preset = "black"
[bsdf]
azimuthal = "simplified"
[contexts]
theta_r_deg = [20]
n = [1]
v = [0.5]
combine = "zip"
[[methods]]
name = "start"
kind = "fitted"
max_steps = 0
[estimate]
samples = [64]
repeats = 4
rounds = 2
rtol = 1e-3
[output]
maps = 0
plots = false
"""


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "planned.toml"
    path.write_text(CONFIG)
    return path


def test_the_command_prints_the_plan(config: Path) -> None:
    exact = CliRunner().invoke(app, ["plan", str(config)])
    assert exact.exit_code == 0 and "tolerance 0: exact" in exact.output and "R, TT, TRT, back" in exact.output
    bounded = CliRunner().invoke(app, ["plan", str(config), "--set", "plan.tolerance=0.01"])
    assert bounded.exit_code == 0 and "error at most" in bounded.output and "dropped  direct TRT" in bounded.output


@pytest.mark.parametrize(
    "wrong", ["plan.tolerance=1", "plan.tolerance=-1e-3", "plan.tolerance='no'", "plan.tolerances=0"]
)
def test_a_wrong_tolerance_is_refused(config: Path, wrong: str) -> None:
    found = CliRunner().invoke(app, ["plan", str(config), "--set", wrong])
    assert found.exit_code == 2 and "plan.tolerance" in found.output


def test_a_run_obeys_and_records_its_plan(config: Path, tmp_path: Path) -> None:
    """Proposals have no component for what went, the result has the plan, and errors are those against the whole."""
    values = {}
    for tolerance in (0.0, 0.01):
        experiment = load(config, [f"plan.tolerance={tolerance}"])
        outcome = runner.run(experiment, tmp_path / "runs", workers=0)
        cell = json.loads((outcome.directory.path / "result.json").read_text())["cells"][0]
        values[tolerance] = cell["reference"]["value"]
        assert cell["plan"]["tolerance"] == tolerance
        gone = {(d["half"], d["term"]) for d in cell["plan"]["dropped"]}
        assert (("direct", "TRT") in gone) == (tolerance > 0)
        assert cell["plan"]["bound"] <= tolerance
    assert values[0.01] == pytest.approx(values[0.0], rel=2e-3)  # of the whole integrand, not of what is kept
