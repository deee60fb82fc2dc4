"""Runs: complete, skipped, resumed after a crash, the same for any number of workers."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from dsfit.experiment import provenance, runner
from dsfit.experiment.rundir import RunDirectory, RunFailure
from dsfit.experiment.validation import Experiment, load


def numbers(data: Any) -> Any:
    """Everything but times and provenance."""
    if isinstance(data, dict):
        skip = ("seconds", "provenance", "file")
        return {k: numbers(v) for k, v in data.items() if not any(word in k for word in skip)}
    return [numbers(v) for v in data] if isinstance(data, list) else data


def snapshot(path: Path) -> dict[str, int]:
    return {str(p): p.stat().st_mtime_ns for p in path.rglob("*") if p.is_file()}


@pytest.fixture
def experiment(tiny: Path) -> Experiment:
    return load(tiny)


def crash_after(monkeypatch: pytest.MonkeyPatch, cells: int, error: BaseException) -> None:
    """Let `cells` cells finish, then raise."""
    real: Callable[..., None] = runner.run_job
    done: list[int] = []

    def job(directory: RunDirectory, job: Any, say: Any) -> None:
        if len(done) == cells:
            raise error
        real(directory, job, say)
        done.append(job.index)

    monkeypatch.setattr(runner, "run_job", job)


def test_a_run_writes_what_it_promises_and_is_then_skipped(experiment: Experiment) -> None:
    outcome = runner.run(experiment, workers=0)
    path = outcome.directory.path
    assert not outcome.skipped and path.name.startswith("tiny-")
    found = {p.relative_to(path).as_posix() for p in path.rglob("*") if p.is_file()} - {".lock"}
    cells = {f"cells/{i:04d}.{kind}" for i in range(2) for kind in ("json", "npz")}
    assert found == {"config.toml", "provenance.json", "result.json", *cells}
    record = json.loads((path / "provenance.json").read_text())
    assert record["seed"] == 1 and record["dtype"] == "float64" and record["packages"]["torch"]
    assert record["machine"]["cores"] and record["sessions"][0]["threads_per_worker"] == 1
    assert record["sessions"][0]["finished"] >= record["sessions"][0]["started"]
    before = snapshot(path)
    again = runner.run(experiment, workers=0)
    assert again.skipped and snapshot(path) == before
    assert again.result["cells"] == json.loads((path / "result.json").read_text())["cells"]
    forced = runner.run(experiment, workers=0, force=True)
    assert not forced.skipped and numbers(forced.result) == numbers(again.result)
    assert all(snapshot(path)[name] != time for name, time in before.items() if not name.endswith(".lock"))


def test_a_crash_between_cells_is_resumed_at_the_unfinished_cell(
    experiment: Experiment, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = runner.run(experiment, tmp_path / "whole", workers=0)
    with monkeypatch.context() as patch:
        crash_after(patch, 1, KeyboardInterrupt())
        with pytest.raises(KeyboardInterrupt):
            runner.run(experiment, workers=0)
    directory = runner.run_directory(experiment)
    before = snapshot(directory.path / "cells")
    assert sorted(Path(name).name for name in before) == ["0000.json", "0000.npz"]
    assert directory.finished() is None
    resumed = runner.run(experiment, workers=0)
    after = snapshot(directory.path / "cells")
    assert {name: after[name] for name in before} == before
    assert numbers(resumed.result["cells"]) == numbers(whole.result["cells"])
    sessions = resumed.result["provenance"]["sessions"]
    assert [s["cells_reused"] for s in sessions] == [0, 1]


def test_a_cell_that_fails_does_not_stop_the_others(experiment: Experiment, monkeypatch: pytest.MonkeyPatch) -> None:
    real = runner.run_job

    def job(directory: RunDirectory, job: Any, say: Any) -> None:
        if job.index == 0:
            raise ValueError("no such luck")
        real(directory, job, say)

    with monkeypatch.context() as patch:
        patch.setattr(runner, "run_job", job)
        with pytest.raises(RunFailure, match=r"1 of 2 cells failed.*\n.*θr 0°.*ValueError: no such luck"):
            runner.run(experiment, workers=0)
    directory = runner.run_directory(experiment)
    assert "no such luck" in directory.cell_path(0, "error.txt").read_text()
    kept = directory.cell_path(1).stat().st_mtime_ns
    runner.run(experiment, workers=0)
    assert directory.cell_path(1).stat().st_mtime_ns == kept
    assert not directory.cell_path(0, "error.txt").exists()


@pytest.mark.parametrize("suffix", ["json", "npz"])
def test_damaged_parts_are_made_anew(experiment: Experiment, suffix: str) -> None:
    first = runner.run(experiment, workers=0)
    directory = first.directory
    kept = directory.cell_path(0).stat().st_mtime_ns
    damaged = directory.cell_path(1, suffix)
    damaged.write_bytes(damaged.read_bytes()[:100])
    (directory.path / "result.json").write_text("{")
    (directory.path / "provenance.json").write_text("{")
    second = runner.run(experiment, workers=0)
    assert not second.skipped and directory.cell_path(0).stat().st_mtime_ns == kept
    assert numbers(second.result["cells"]) == numbers(first.result["cells"])


def test_a_cell_of_something_else_is_not_taken(experiment: Experiment) -> None:
    first = runner.run(experiment, workers=0)
    directory = first.directory
    other = directory.cell_path(1).read_bytes()
    directory.cell_path(0).write_bytes(other)
    (directory.path / "result.json").unlink()
    second = runner.run(experiment, workers=0)
    assert numbers(second.result["cells"]) == numbers(first.result["cells"])


def test_the_number_of_workers_does_not_change_the_numbers(experiment: Experiment, tmp_path: Path) -> None:
    results = [runner.run(experiment, tmp_path / str(w), workers=w).result["cells"] for w in (0, 2)]
    assert numbers(results[0]) == numbers(results[1])


def test_two_processes_cannot_share_a_directory(experiment: Experiment) -> None:
    directory = runner.run_directory(experiment)
    with directory.lock(), pytest.raises(RunFailure, match="another"):
        runner.run(experiment, workers=0)


def test_a_place_that_cannot_be_written_is_a_run_failure(experiment: Experiment, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(RunFailure, match="file"):
        runner.run(experiment, tmp_path / "file", workers=0)


def test_the_run_id_follows_what_decides_the_numbers(tiny: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def identity(*overrides: str) -> str:
        return provenance.run_id(load(tiny, overrides).config)

    base = identity()
    assert identity("title=other") == identity("output.dir=elsewhere") == identity("fiber.preset=blond") == base
    assert identity("fiber.eta=1.5") != base != identity("estimate.seed=2")
    monkeypatch.setattr(provenance, "numbers_version", lambda: "9")
    assert identity() != base


def test_measured_and_predicted_errors_agree(experiment: Experiment) -> None:
    result = runner.run(experiment, workers=0).result
    for cell in result["cells"]:
        for method in cell["methods"]:
            for point in method["estimates"]:
                assert point["repeats"] == 8
                # eight repeats of a chi-square with a few degrees of freedom: within a factor of three, not ten
                assert 1 / 3 < point["rmse"] / point["predicted_rmse"] < 3
                assert point["bias"] < 5 * point["predicted_rmse"] / point["repeats"] ** 0.5
