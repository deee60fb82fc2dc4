"""The table, failures' configs and the summary, from outcomes made up."""

from __future__ import annotations

import pickle
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pandas
import polars
import pytest

from dsfit.errors import InputError
from dsfit.experiment import files, runner
from dsfit.experiment.cells import jobs
from dsfit.experiment.validation import load
from dsfit.sweep import pilot, table, tasks
from dsfit.sweep.compute import compute
from dsfit.sweep.failures import reproducing
from dsfit.sweep.log import CellLog
from dsfit.sweep.plan import make_plan
from dsfit.sweep.rows import columns
from dsfit.sweep.run import run_sweep, sweep_directory
from dsfit.sweep.table import write_table
from tests.sweep.cheap import SCENE, SOBOL, FakeMachines, config, measured, rows_of


def answer(batch: Any) -> list[dict[str, Any]]:
    """Cell 3 fails."""
    trouble = {"context": [1.0, 0.0, 2.0, None], "seconds": 0.1, "fate": "timed out", "error": "x", "traceback": ""}
    return [{"cell": t.cell, **trouble} if t.cell == 3 else rows_of(t.cell) for t in batch.tasks]


def test_cells_are_points_times_contexts_as_in_a_run(tmp_path: Path) -> None:
    grid = SOBOL.replace("[sweep.space]", '[sweep.grid]\n"contexts.phi_r_deg" = [[0], [10, 20]]\n[sweep.space]')
    path = config(tmp_path, grid)
    plan, experiment = make_plan(path), load(path)
    found = jobs(experiment)
    assert len(plan) == len(found) == 12 * 2 + 12 * 4 and len(plan.design) == 24
    for cell in (0, 1, 23, 24, 27, 28, 71):
        task, job = plan.task(cell), found[cell]
        assert task.values == job.identity["grid"]
        assert plan.base.config(task.values).contexts == job.config.contexts
        same = [other for other in found if other.identity["grid"] == task.values]
        assert same[task.part] is job


def test_more_points_than_are_validated_are_counted_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    grid = SOBOL.replace("[sweep.space]", '[sweep.grid]\n"contexts.phi_r_deg" = [[0], [10, 20]]\n[sweep.space]')
    for sweep in (SOBOL, grid):
        path = config(tmp_path, sweep)
        whole = make_plan(path).ends.tolist()
        with monkeypatch.context() as patch:
            patch.setattr("dsfit.sweep.plan.VALIDATED", 3)
            told: list[tuple[int, int]] = []
            assert make_plan(path, say=lambda *x, told=told: told.append(x)).ends.tolist() == whole
            assert told[-1] == (3, 3)


def test_what_is_no_sweep_is_refused(tmp_path: Path) -> None:
    path = config(tmp_path, "")
    with pytest.raises(InputError, match="kind: got 'render'; allowed: one of 'compare', 'sweep'"):
        make_plan(path, ["kind=render"])
    with pytest.raises(InputError, match=r"sweep: got {}.*a \[sweep.grid\] or a \[sweep.space\]"):
        make_plan(path)


def test_the_table_opens_in_pandas_and_polars_with_its_types(tmp_path: Path) -> None:
    sweep = """
[sweep.grid]
"fiber.preset" = ["blond", "black"]
"bsdf.d_f" = [1, 0.7]
"contexts.n" = [[0], [1.5]]
"bsdf.convention" = ["printed", { base = "printed", lobe_norm = "energy" }]
"check.chi_square.samples" = [200, 300]
"""
    plan = make_plan(config(tmp_path, sweep.replace('"contexts.n"', '"contexts.n"')))
    record = run_sweep(plan, tmp_path / "s", lambda: FakeMachines(answer), retries=0)
    assert record["counts"] == {"points": 32, "cells": 64, "done": 63, "failed": 1, "rows": 64}
    one, two = pandas.read_parquet(tmp_path / "s/results.parquet"), polars.read_parquet(tmp_path / "s/results.parquet")
    assert list(one) == two.columns and len(one) == len(two) == 64
    types = dict(zip(two.columns, map(str, two.dtypes), strict=True))
    keys = ("fiber.preset", "bsdf.d_f", "contexts.n", "bsdf.convention", "check.chi_square.samples")
    assert [types[key] for key in keys] == ["String", "Float64", "List(Float64)", "String", "Int64"]
    assert types["cell"] == "Int64" and types["p_value"] == types["cell_seconds"] == "Float64"
    assert one["cell"].tolist() == list(range(64)) and one["point"].tolist() == [k // 2 for k in range(64)]
    assert one["bsdf.convention"].tolist()[4] == '{"base": "printed", "lobe_norm": "energy"}'
    failed = one[one["status"] == "failed"]
    assert failed["cell"].tolist() == [3] and failed["error"].tolist() == ["timed out: x"]
    assert failed["n"].tolist() == [2.0] and failed["p_value"].isna().all()
    text = (tmp_path / "s/table.md").read_text()
    assert "| fiber.preset | blond | chi_square | 31 | 0.5 | - | - |" in text
    assert "32 points, 64 cells: 63 done, 1 failed" in text


def test_the_table_is_written_in_pieces_without_a_seam(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plan = make_plan(config(tmp_path))
    log = CellLog(tmp_path / "log", len(plan))
    for cell in np.random.default_rng(0).permutation(len(plan)).tolist():  # in any order
        log.add(rows_of(cell))
    assert write_table(plan, log, tmp_path / "one.parquet") == 24
    monkeypatch.setattr(table, "_PIECE", 7)
    write_table(plan, log, tmp_path / "two.parquet")
    one, two = (pandas.read_parquet(tmp_path / f"{name}.parquet") for name in ("one", "two"))
    assert one.equals(two) and one["case"].tolist() == [f"case {k}" for k in range(24)]
    assert [p.name for p in tmp_path.glob(".*")] == []


def test_a_finished_sweep_is_left_alone_and_a_failed_one_tried_again(tmp_path: Path) -> None:
    plan = make_plan(config(tmp_path))
    path = sweep_directory(plan, tmp_path)
    first = run_sweep(plan, path, lambda: FakeMachines(answer), retries=0)
    assert first["counts"]["failed"] == 1 and [f["config"] for f in first["failures"]] == ["failures/000003.toml"]
    again = FakeMachines(lambda batch: [rows_of(task.cell) for task in batch.tasks])
    second = run_sweep(plan, path, lambda: again)
    assert second["counts"]["failed"] == 0 and [t.cell for b in again.batches for t in b.tasks] == [3]
    assert not (path / "failures").exists() and len(second["sessions"]) == 2
    before = {p: p.stat().st_mtime_ns for p in path.iterdir()}

    def unused() -> Any:
        raise AssertionError("nothing is left to compute")

    assert run_sweep(plan, path, unused) == second
    assert {p: p.stat().st_mtime_ns for p in path.iterdir()} == before
    forced = run_sweep(plan, path, lambda: FakeMachines(lambda b: [rows_of(t.cell) for t in b.tasks]), force=True)
    assert forced["sessions"][0]["cells_reused"] == 0 and len(forced["sessions"]) == 1
    assert len(measured(path)) == 24


def test_files_that_the_config_names_reach_workers_that_do_not_have_them(tmp_path: Path) -> None:
    user = tmp_path / "mine.py"
    user.write_text("from dsfit.proposals import UniformSphere\n\ndef proposal(*_):\n    return UniformSphere()\n")
    scene = SCENE.replace('proposals = ["uniform"]', 'proposals = ["uniform"]\nuser = ["mine.py:proposal"]')
    plan = make_plan(config(tmp_path, scene=scene))
    here = compute(plan.base, plan.task(2))
    assert list(plan.base.files) == [str(user)] and len(here["rows"]) == 4
    user.unlink()
    again = pickle.loads(pickle.dumps((plan.base, plan.task(2))))
    tasks._place.cache_clear()
    there = compute(*again)
    assert there.get("error") is None and there["rows"] == here["rows"]


_SMALL = {
    "compare": """
[contexts]
n = [0]
theta_r_deg = [30]
[bsdf]
azimuthal = "simplified"
precision = "exact"
[estimate]
samples = [16]
repeats = 2
rounds = 1
rtol = 1e-2
[[methods]]
name = "even"
kind = "uniform"
""",
    "amortise": "[amortise]\nsteps = 1\ninclinations = 4\npairs = 2\ncheck = 0\n",
    "transmittance": "[transmittance]\nn = [1, 2]\n",
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", list(_SMALL))
def test_rows_of_every_kind_hold_what_a_run_stores(kind: str, tmp_path: Path) -> None:
    scene = f'kind = "{kind}"\n[fiber]\npreset = "brown"\n[output]\nplots = false\n{_SMALL[kind]}'
    path = config(tmp_path, '[sweep.grid]\n"fiber.eta" = [1.5]\n', scene)
    plan = make_plan(path)
    found = compute(plan.base, plan.task(0))
    assert found.get("error") is None
    rows = [dict(zip(columns(kind), row, strict=True)) for row in found["rows"]]
    (cell,) = runner.run(load(path), tmp_path, workers=0).result["cells"]
    if kind == "compare":
        method = cell["methods"][0]
        assert [row["method"] for row in rows] == ["even"] and rows[0]["theta_r_deg"] == 30
        assert rows[0]["rmse"] == method["estimates"][-1]["rmse"] and rows[0]["excess"] == method["excess"]
    elif kind == "amortise":
        assert [row["group"] for row in rows] == ["start", "held_out"]
        assert [row["excess_median"] for row in rows] == [cell[g]["median"] for g in ("start", "held_out")]
        assert rows[0]["training_seconds"] > 0 and rows[0]["training_steps"] == 1
    else:
        assert [(row["n"], row["excess"]) for row in rows] == [(fit["n"], fit["excess"]) for fit in cell["fits"]]


def test_the_id_follows_the_design(tmp_path: Path) -> None:
    def identity(*overrides: str) -> Path:
        return sweep_directory(make_plan(config(tmp_path), list(overrides)), tmp_path)

    assert identity() == identity("title=other") != identity("sweep.seed=2") != identity("check.chi_square.samples=501")


def test_the_reproducing_config_has_the_cell_alone_and_its_random_numbers(tmp_path: Path) -> None:
    sweep = '[sweep.grid]\n"fiber.eta" = [1.5, 1.6]\n"bsdf.d_f" = [0.6]\n'
    path = config(tmp_path, sweep)
    plan = make_plan(path)
    job = jobs(load(path))[3]
    (tmp_path / "one.toml").write_text(files.to_toml(reproducing(plan.base, plan.task(3))))
    alone = jobs(load(tmp_path / "one.toml"))
    assert [a.identity for a in alone] == [job.identity]
    kept = tomllib.loads((tmp_path / "one.toml").read_text())
    assert kept["contexts"]["theta_r_deg"] == [30] and kept["fiber"]["eta"] == 1.6
    assert alone[0].config.model_dump(exclude={"sweep", "contexts"}) == job.config.model_dump(
        exclude={"sweep", "contexts"}
    )


def test_a_point_that_is_refused_late_leaves_a_config_that_is_refused_in_the_same_way(tmp_path: Path) -> None:
    plan = make_plan(config(tmp_path, '[sweep.grid]\n"fiber.eta" = [1.5, 1.6]\n'))
    task = plan.task(2)
    task.values["fiber.eta"] = 0.5
    (tmp_path / "bad.toml").write_text(files.to_toml(reproducing(plan.base, task)))
    with pytest.raises(InputError, match=r"bad\.toml: fiber\.eta: got 0\.5"):
        load(tmp_path / "bad.toml")


def test_a_dry_run_says_how_much_there_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plan = make_plan(config(tmp_path))
    lines = pilot.describe(plan, shown=2)
    assert lines[0].startswith("12 points, 24 cells; columns of the design: contexts.theta_r_deg.0, contexts.n.0")
    assert len(lines) == 4 and lines[1].startswith("  point 0: contexts.theta_r_deg.0 = ")
    asked: list[int] = []

    def batch(given: Any) -> list[dict[str, Any]]:
        asked.extend(task.cell for task in given.tasks)
        return [{**rows_of(task.cell), "seconds": 10.0 if k == 0 else k} for k, task in enumerate(given.tasks)]

    monkeypatch.setattr(pilot, "run_batch", batch)
    found = pilot.pilot(plan, 3)
    assert asked == [0, 0, 11, 23] and found.cell_seconds == (2.0, 3.0) and found.hours == pytest.approx(48 / 3600)
    log = CellLog(tmp_path / "log", len(plan))
    for cell in range(24):
        log.add({**rows_of(cell), "seconds": 1})
    assert found.rows == 24 and found.log_bytes == pytest.approx(log.bytes, rel=0.01)
