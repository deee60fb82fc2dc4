"""The `dsfit` command: exit codes, what it says, what it leaves behind."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from typer.testing import CliRunner

from dsfit.cli import app
from dsfit.experiment import runner
from dsfit.experiment.validation import load

CONFIG = """
title = "tiny"
[contexts]
theta_r_deg = [0, 20, 40]
[[methods]]
name = "uniform"
kind = "uniform"
[[methods]]
name = "TT only"
kind = "single"
proposal = "TT"
[estimate]
samples = [16, 64]
repeats = 4
rounds = 2
rtol = 1e-3
[output]
maps = 1
dir = "runs"
"""


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tiny.toml").write_text(CONFIG)
    return tmp_path


def invoke(*arguments: str) -> tuple[int, str]:
    result = CliRunner().invoke(app, list(arguments))
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.output


def names(folder: Path) -> list[str]:
    return sorted(p.name for p in folder.iterdir())


@pytest.mark.parametrize(
    ("override", "parts"),
    [
        ("fiber.etta=1.5", ["--set: fiber.etta: got 1.5", "did you mean 'eta'?"]),
        (
            "methods.0.kind=unifrm",
            ["--set: methods.0.kind: got 'unifrm'", "'uniform', 'light'", "did you mean 'uniform'?"],
        ),
        ("contexts.n=[-1]", ["--set: contexts.n.0: got -1", ">= 0"]),
        ("nonsense", ["--set: (key): got 'nonsense'", "key=value"]),
    ],
)
def test_a_wrong_config_exits_with_2_and_writes_nothing(here: Path, override: str, parts: list[str]) -> None:
    code, output = invoke("run", "tiny.toml", "--set", override)
    assert code == 2 and all(part in output for part in parts), output
    assert names(here) == ["tiny.toml"]


def test_errors_name_the_file(here: Path) -> None:
    (here / "bad.toml").write_text("extends = 'tiny.toml'\n[fiber]\neta = 0.5\n")
    code, output = invoke("run", "bad.toml")
    assert code == 2 and "bad.toml: fiber.eta: got 0.5; allowed: a finite number > 1" in output
    code, output = invoke("run", "gone.toml")
    assert code == 2 and "gone.toml" in output and "No such file" in output
    assert names(here) == ["bad.toml", "tiny.toml"]


def test_run_skip_show(here: Path) -> None:
    one = ("--set", "contexts.theta_r_deg=[10]")
    code, output = invoke("run", "tiny.toml", "--workers", "0", *one)
    assert code == 0, output
    (run,) = (here / "runs").iterdir()
    assert all(word in output for word in ("uniform", "TT only", str(run.name), "result.json"))
    figures = sorted(p.name for p in (run / "figures").iterdir())
    assert figures == [f"{name}.{kind}" for name in ("convergence", "excess", "maps-0000") for kind in ("pdf", "png")]
    assert all((run / "figures" / name).read_bytes()[:4] in (b"%PDF", b"\x89PNG") for name in figures)
    assert "| uniform |" in (run / "table.md").read_text()
    before = (run / "result.json").stat().st_mtime_ns
    code, output = invoke("run", "tiny.toml", *one)
    assert code == 0 and "already done" in output and "TT only" in output
    assert (run / "result.json").stat().st_mtime_ns == before
    # The resolved config is a config: it gives the same run.
    code, output = invoke(
        "run", str(run / "config.toml"), "--out", "again", "--workers", "0", "--set", "output.plots=false"
    )
    (again,) = (here / "again").iterdir()
    assert code == 0 and again.name.split("-")[-1] == run.name.split("-")[-1]
    code, output = invoke("show", str(run), "--plots")
    assert code == 0 and "TT only" in output
    (run / "result.json").write_bytes((run / "result.json").read_bytes()[:200])
    code, output = invoke("show", str(run))
    assert code == 2 and "result.json" in output and "damaged" in output
    (run / "result.json").write_text('{"schema_version": 1, "kind": "compare"}')
    code, output = invoke("show", str(run))
    assert code == 2 and "damaged" in output


def test_show_of_no_run_and_of_an_unfinished_run(here: Path) -> None:
    code, output = invoke("show", "nowhere")
    assert code == 2 and "no result.json there" in output
    directory = runner.run_directory(load("tiny.toml")).path
    directory.mkdir(parents=True)
    (directory / "config.toml").write_text("")
    code, output = invoke("show", str(directory))
    assert code == 2 and "unfinished" in output


def test_a_failing_run_exits_with_1(monkeypatch: pytest.MonkeyPatch) -> None:
    def job(*_: object) -> None:
        raise ArithmeticError("broken")

    monkeypatch.setattr(runner, "run_job", job)
    code, output = invoke("run", "tiny.toml", "--workers", "0")
    assert code == 1 and "3 of 3 cells failed" in output and "ArithmeticError: broken" in output
    assert "goes on from here" in output


def test_presets() -> None:
    code, output = invoke("presets")
    assert code == 0 and "blond" in output and "0.03, 0.07, 0.15" in output


def command(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "dsfit.cli", *arguments]


def environment() -> dict[str, str]:
    root = str(Path(__file__).resolve().parents[1])
    return {**os.environ, "PYTHONPATH": root, "OMP_NUM_THREADS": "1"}


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL], ids=["ctrl-c", "killed"])
def test_an_interrupted_process_is_resumed(here: Path, how: signal.Signals) -> None:
    """A real process, in a group of its own so that the signal reaches the workers as Ctrl-C does."""
    arguments = command(
        "run", "tiny.toml", "--workers", "1", "--set", "estimate.rounds=20", "--set", "output.plots=false"
    )
    process = subprocess.Popen(
        arguments,
        env=environment(),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    deadline = time.monotonic() + 120
    while not list(here.glob("runs/*/cells/0000.json")) and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.01)
    os.killpg(process.pid, how)
    output, _ = process.communicate(timeout=60)
    assert process.returncode == (130 if how == signal.SIGINT else -signal.SIGKILL), output
    if how == signal.SIGINT:
        assert "goes on from here" in output and "Traceback" not in output
    (run,) = here.glob("runs/*")
    kept = {p.name: p.stat().st_mtime_ns for p in (run / "cells").glob("*.json")}
    assert kept and not (run / "result.json").exists()
    done = subprocess.run(arguments, env=environment(), capture_output=True, text=True, timeout=200)
    assert done.returncode == 0, done.stderr
    assert "TT only" in done.stdout
    result = json.loads((run / "result.json").read_text())
    assert len(result["cells"]) == 3
    assert all((run / "cells" / name).stat().st_mtime_ns == at for name, at in kept.items())
