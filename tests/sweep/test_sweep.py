"""Sweeps in real processes: local ones, killed and resumed, and a Dask cluster that loses a worker."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from dsfit.cli import app
from dsfit.errors import InputError
from dsfit.experiment import runner
from dsfit.experiment.provenance import numbers_version
from dsfit.experiment.rundir import RunFailure
from dsfit.experiment.validation import load
from dsfit.sweep.compute import compute
from dsfit.sweep.drive import Counts
from dsfit.sweep.executors import DaskCluster, LocalProcesses
from dsfit.sweep.failures import reproducing, write_failures
from dsfit.sweep.log import CellLog
from dsfit.sweep.plan import make_plan
from dsfit.sweep.run import read_record, run_sweep, sweep_directory
from dsfit.sweep.slot import Unable, run_batch, start_again, stop_all
from dsfit.sweep.tasks import Batch
from tests.sweep.cheap import SCENE, SOBOL, config, measured

ROOT = Path(__file__).resolve().parents[2]
TROUBLE = """
import os, time

def proposal(integrand, context):
    from dsfit.proposals import UniformSphere

    n = int(context.n)
    if n == 1:
        raise ValueError("no such luck")
    if n == 2:
        os.kill(os.getpid(), 9)
    if n == 3:
        time.sleep(600)
    print("printed by a cell")
    return UniformSphere()
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("sweep")


@pytest.fixture(scope="module")
def whole(folder: Path) -> Path:
    """Directory of a sweep of 24 cells by two local processes."""
    done = CliRunner().invoke(app, ["sweep", str(config(folder)), "--out", str(folder / "whole"), "--workers", "2"])
    assert done.exit_code == 0, done.output
    assert "24 of 24 cells, 48 rows" in done.output
    (path,) = (folder / "whole").iterdir()
    return path


def children() -> list[str]:
    """Processes that compute cells, of anyone."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                if b"dsfit.sweep.child" in (entry / "cmdline").read_bytes():
                    found.append(entry.name)
            except OSError:
                pass
    return found


def test_local_processes_compute_what_this_process_does(whole: Path, folder: Path) -> None:
    table = measured(whole)
    plan = make_plan(config(folder))
    for cell in (0, 7):
        rows = compute(plan.base, plan.task(cell))["rows"]
        assert table[table["cell"] == cell]["p_value"].iloc[0] == rows[0][8]
    record = read_record(whole)
    assert record["counts"] == {"points": 12, "cells": 24, "done": 24, "failed": 0, "rows": 48}
    assert record["sessions"][0]["machines"] == "2 local processes" and record["provenance"]["sweep"]["torch"]
    assert sorted(p.name for p in whole.iterdir() if p.name != ".lock") == [
        "cells.log", "config.toml", "results.parquet", "sweep.json", "table.md",
    ]  # fmt: skip


def test_the_numbers_are_those_of_a_run_of_one_cell(whole: Path, folder: Path) -> None:
    plan = make_plan(config(folder))
    from dsfit.experiment import files

    (folder / "one.toml").write_text(files.to_toml(reproducing(plan.base, plan.task(9))))
    result = runner.run(load(folder / "one.toml"), folder / "runs", workers=0).result
    contexts = plan.base.config(plan.task(9).values).contexts.theta_r_deg
    found = [f["p_value"] for f in result["cells"][contexts.index(contexts[1])]["findings"]]
    table = measured(whole)
    expected = table[table["cell"] == 9]["p_value"]
    assert found[0] == expected.iloc[0]


@pytest.mark.parametrize("signal_number", [signal.SIGKILL, pytest.param(signal.SIGINT, marks=pytest.mark.slow)])
def test_killed_and_resumed_the_table_is_the_same(whole: Path, folder: Path, signal_number: int) -> None:
    out = folder / f"killed-{signal_number}"
    command = [sys.executable, "-m", "dsfit.cli", "sweep", str(config(folder)), "--out", str(out), "--workers", "1"]
    before = set(children())
    process = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True)
    path = out / whole.name
    while not (path / "cells.log").is_file() or (path / "cells.log").read_bytes().count(b"\n") < 3:
        assert process.poll() is None, process.stderr and process.stderr.read()
        time.sleep(0.005)
    process.send_signal(signal_number)
    assert process.wait() == (-signal.SIGKILL if signal_number == signal.SIGKILL else 130)
    assert process.stderr is not None
    if signal_number == signal.SIGINT:
        assert "interrupted; the same command goes on from here" in process.stderr.read()
    kept = (path / "cells.log").read_bytes()
    assert 3 <= kept.count(b"\n") < 24 and not (path / "results.parquet").exists()
    deadline = time.monotonic() + 60
    while set(children()) - before and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not set(children()) - before  # the processes end with their parent
    with open(path / "cells.log", "ab") as log:
        log.write(b'5 0012abcd {"cell":5,"rows')  # as if the kill had come within a line
    done = CliRunner().invoke(app, ["sweep", str(config(folder)), "--out", str(out), "--workers", "1"])
    assert done.exit_code == 0, done.output
    assert (path / "cells.log").read_bytes().startswith(kept)
    assert read_record(path)["sessions"][0]["cells_reused"] == kept.count(b"\n")
    assert measured(path).equals(measured(whole))


@pytest.fixture
def trouble(tmp_path: Path) -> Path:
    """A sweep whose cells go well, raise, die and hang."""
    (tmp_path / "trouble.py").write_text(TROUBLE)
    scene = SCENE.replace('proposals = ["uniform"]', 'proposals = ["uniform"]\nuser = ["trouble.py:proposal"]')
    return config(tmp_path, '[sweep.grid]\n"contexts.n" = [[0], [1], [2], [3]]\n', scene.replace("[0, 30]", "[0]"))


def test_cells_that_raise_die_or_hang_leave_the_others_alone(trouble: Path, tmp_path: Path) -> None:
    plan = make_plan(trouble)
    start_again()
    try:
        order = [plan.task(cell) for cell in (0, 1, 2, 0)]
        found = run_batch(Batch(plan.base, order, numbers_version()))
        hung = run_batch(Batch(plan.base, [plan.task(3)], numbers_version(), timeout=0.5))
    finally:
        stop_all()
    assert [outcome.get("fate") for outcome in [*found, *hung]] == [None, "raised", "died", None, "timed out"]
    assert found[1]["error"] == "ValueError: no such luck" and "in proposal" in found[1]["traceback"]
    assert found[1]["context"] == [0.0, 0.0, 1.0, None] and found[0]["rows"] == found[3]["rows"]
    assert "SIGKILL" in found[2]["error"] and "0.5 s" in hung[0]["error"]

    log = CellLog(tmp_path / "log", len(plan))
    log.add({**found[1], "attempts": 2})
    (failure,) = write_failures(plan, log, tmp_path / "failures")
    assert failure["config"] == "failures/000001.toml"
    assert "after 2 attempts: ValueError: no such luck" in (tmp_path / "failures/000001.txt").read_text()
    with pytest.raises(RunFailure, match="1 of 1 cells failed.*\n.*ValueError: no such luck"):
        runner.run(load(tmp_path / failure["config"]), tmp_path, workers=0)


def test_another_version_of_the_code_computes_nothing(tmp_path: Path) -> None:
    plan = make_plan(config(tmp_path))
    with pytest.raises(Unable, match=r"on this worker, 0\.0 where the sweep was started"):
        run_batch(Batch(plan.base, [plan.task(0)], "0.0"))


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["--dask", "tcp://127.0.0.1:9"], 2, "--dask: got 'tcp://127.0.0.1:9'; allowed: the address of a running Dask"),
        (["--dask", "gone.json"], 2, "there is no such file"),
        (["--dask", "tcp://127.0.0.1:9", "--workers", "2"], 2, "--workers: got 2; allowed: left out with --dask"),
        (["--set", "fiber.eta=0.5"], 2, "--set: fiber.eta: got 0.5"),
        (["--set", "sweep.points=x"], 2, "sweep.points: got 'x'"),
        (["--dry-run", "--pilot", "0"], 0, "12 points, 24 cells"),
    ],
    ids=str,
)
def test_the_command_says_what_is_wrong(
    arguments: list[str], code: int, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dsfit.sweep.executors.CONNECT_SECONDS", 0.5)
    done = CliRunner().invoke(app, ["sweep", str(config(tmp_path)), "--out", str(tmp_path / "out"), *arguments])
    assert done.exit_code == code and words in done.output, done.output


# ---- Dask ----


@pytest.fixture
def cluster() -> Iterator[Any]:
    """Two worker processes on this machine."""
    distributed = pytest.importorskip("distributed")
    made = distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, silence_logs=50
    )
    yield made
    made.close()


def lose_a_worker(cluster: Any, plan: Any, path: Path, when: int) -> dict[str, Any]:
    """Run the sweep, and kill a worker process with -9 when so many cells are done."""
    killed: list[int] = []

    def tell(counts: Counts) -> None:
        if counts.done >= when and not killed:
            killed.append(cluster.workers[0].pid)
            os.kill(killed[0], signal.SIGKILL)

    record = run_sweep(plan, path, lambda: DaskCluster(cluster.scheduler_address), tell=tell)
    assert killed and record["counts"]["done"] == len(plan) and record["counts"]["failed"] == 0
    assert record["sessions"][0]["machines"].startswith("Dask at tcp://")
    assert record["sessions"][0]["most_in_flight"] <= 6
    return record


def test_a_cluster_that_loses_a_worker_gives_the_same_table(whole: Path, folder: Path, cluster: Any) -> None:
    plan = make_plan(config(folder))
    path = sweep_directory(plan, folder / "dask")
    lose_a_worker(cluster, plan, path, when=4)
    assert measured(path).equals(measured(whole))


@pytest.mark.slow
def test_two_hundred_cells_survive_the_loss_of_a_worker(tmp_path: Path, cluster: Any) -> None:
    plan = make_plan(config(tmp_path, SOBOL.replace("points = 12", "points = 100")))
    assert len(plan) == 200
    lose_a_worker(cluster, plan, tmp_path / "dask", when=60)
    run_sweep(plan, tmp_path / "local", lambda: LocalProcesses(2))
    assert measured(tmp_path / "dask").equals(measured(tmp_path / "local"))


def test_without_workers_the_cluster_is_refused() -> None:
    distributed = pytest.importorskip("distributed")
    with (
        distributed.LocalCluster(n_workers=0, processes=False, dashboard_address=None, silence_logs=50) as empty,
        pytest.raises(RunFailure, match="no workers"),
    ):
        DaskCluster(empty.scheduler_address, timeout=0.5)


def test_without_distributed_the_error_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match="the package `distributed` to be installed"):
        DaskCluster("tcp://127.0.0.1:8786")
