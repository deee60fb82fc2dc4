"""`dsfit bench`: a race from its config to table and figure."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, ClassVar

import pytest
import torch
from typer.testing import CliRunner

from dsfit.cli import app
from dsfit.context import Context
from dsfit.errors import InputError
from dsfit.experiment import race, runner
from dsfit.experiment.plots.race import _spread_out
from dsfit.experiment.plots.race import race as figure_of
from dsfit.experiment.race_report import markdown, table, winner_table
from dsfit.experiment.race_summary import entrants, rows, winners
from dsfit.experiment.reader import ConfigError
from dsfit.experiment.rundir import RunDirectory
from dsfit.experiment.validation import load
from dsfit.race import registry
from dsfit.race.peer import Sampler
from dsfit.race.peers.uniform import Uniform

CLI = CliRunner()
CONFIG = """
kind = "race"
title = "a small race"
[bsdf]
azimuthal = "simplified"
[contexts]
theta_r_deg = [20]
n = [0, 3]
[estimate]
dtype = "float32"
rtol = 1e-4
[race]
implementation = "eager"
budgets = [0.01, 1000.0]
[race.stream]
count = 200
batch = 100
seconds = 0.05
fewest = 8
[race.single]
seconds = 0.05
seeds = 16
[[race.peers]]
name = "uniform sphere"
kind = "uniform"
[[race.peers]]
name = "two of the chapter's"
kind = "chapter"
options = { proposals = ["back", "uniform"] }
[[race.peers]]
name = "per context"
kind = "structured"
uniforms = "sobol"
"""


class Crooked(Uniform):
    """Estimates that are too large by a twentieth."""

    name: ClassVar[str] = "uniform"

    def at(self, contexts: Context) -> Sampler:
        sampler = super().at(contexts)
        right = sampler.estimate
        sampler.estimate = lambda samples, generator: 1.05 * right(samples, generator)  # type: ignore[method-assign]
        return sampler


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "small.toml"
    path.write_text(CONFIG + f"[output]\ndir = '{tmp_path / 'runs'}'\n")
    return path


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Of one run, for tests that only read it."""
    folder = tmp_path_factory.mktemp("race")
    path = folder / "small.toml"
    path.write_text(CONFIG)
    return runner.run(load(path), folder / "runs", workers=0).result


def test_from_the_config_to_table_and_figure_and_shown_again(config: Path) -> None:
    done = CLI.invoke(app, ["bench", str(config), "--workers", "0"], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    (folder,) = (config.parent / "runs").iterdir()
    for name in ("result.json", "table.md", "figures/race.png", "figures/race.pdf"):
        assert (folder / name).stat().st_size > 500, name
    text = (folder / "table.md").read_text()
    for name in ("uniform sphere", "two of the chapter's", "per context"):
        assert name in text and name.split()[0] in done.output
    assert "stream of 200 contexts" in text and "load average" in text
    again = CLI.invoke(app, ["run", str(config), "--workers", "0"], catch_exceptions=False)
    assert again.exit_code == 0 and "already done" in again.output
    shown = CLI.invoke(app, ["show", str(folder)], catch_exceptions=False)
    assert shown.exit_code == 0 and "uniform sphere" in shown.output


def test_every_cell_says_what_was_spent_and_how_busy_the_machine_was(result: dict[str, Any]) -> None:
    assert len(result["cells"]) == 6
    for cell in result["cells"]:
        assert cell["prepare"]["seconds"] >= cell["prepare"]["prepare"] >= 0
        assert 0 < cell["watch"]["cpu_share"] < 1.5 and cell["threads"] == 1
        assert cell["implementation"] == "eager" and cell["reference_error"] < 1e-4
        assert cell["verdict"] in ("unbiased", "untested")
        for row in [cell["stream"]] if "stream" in cell else cell["contexts"]:
            samples = [p["samples"] for p in row["points"]]
            assert samples == [samples[0] * 4**k for k in range(len(samples))]
            assert all(p["rmse"]["low"] < p["rmse"]["value"] < p["rmse"]["high"] for p in row["points"])
    slow = next(c for c in result["cells"] if c["label"] == "per context: stream")
    assert 8 <= slow["stream"]["subset"] <= 200


def test_the_error_of_uniform_directions_is_what_quadrature_predicts(result: dict[str, Any]) -> None:
    cell = next(c for c in result["cells"] if c["label"] == "uniform sphere: contexts")
    for row in cell["contexts"]:
        for point in row["points"]:
            predicted = math.sqrt(row["predicted_variance"] / point["samples"])
            assert 0.25 * point["rmse"]["low"] < predicted < 4 * point["rmse"]["high"]


def test_rows_and_winners_follow_from_the_cells(result: dict[str, Any]) -> None:
    found = {row["name"]: row for row in rows(result)}
    assert list(found) == ["uniform sphere", "two of the chapter's", "per context"]
    chapter = found["two of the chapter's"]["stream"]
    assert chapter["over_heuristic"] == pytest.approx(1.0)
    uniform = found["uniform sphere"]["stream"]
    ratio = chapter["to"]["0.01"]["seconds"] / uniform["to"]["0.01"]["seconds"]
    assert uniform["over_heuristic"] == pytest.approx(ratio)
    for row in found.values():
        for group in ("stream", "contexts"):
            to = row[group]["to"]
            for reading in to.values():
                assert reading["low"] <= reading["seconds"] <= reading["high"]
            assert to["0.01"]["seconds"] < to["0.001"]["seconds"]
            spent = to["0.01"]["seconds"] - to["0.01 prepared"]["seconds"]
            assert spent == pytest.approx(row["prepare"], rel=1e-6, abs=1e-9)
    late = [w for w in winners(result) if w["budget"] == 1000.0]
    assert len(late) == 4
    for entry in late:
        errors = [x["error"] for x in entry["ranking"]]
        assert errors == sorted(errors) and all(x["how"] in ("extrapolated", "far") for x in entry["ranking"])
    assert len(winner_table(result)) == 5 and len(table(result, "stream")) == 4


def test_an_interrupted_race_goes_on_and_keeps_what_was_done(config: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    two = 'race.peers=[{name="a",kind="uniform"},{name="b",kind="uniform",uniforms="sobol"}]'
    experiment, real, done = load(config, [two]), runner.run_job, []

    def interrupted(directory: Any, job: Any, say: Any) -> None:
        if len(done) == 3:
            raise KeyboardInterrupt
        real(directory, job, say)
        done.append(job.index)

    with monkeypatch.context() as patch:
        patch.setattr(runner, "run_job", interrupted)
        with pytest.raises(KeyboardInterrupt):
            runner.run(experiment, workers=0)
    folder = runner.run_directory(experiment).path / "cells"
    before = {p.name: p.stat().st_mtime_ns for p in folder.iterdir()}
    assert {"0000.json", "0001.json", "0002.json"} < set(before) and "0003.json" not in before
    race._READY.clear()
    outcome = runner.run(experiment, workers=0)
    assert len(outcome.result["cells"]) == 4
    assert all((folder / name).stat().st_mtime_ns == time for name, time in before.items())


@pytest.mark.slow
def test_a_peer_off_the_truth_fails_loses_and_sets_the_exit_code(config: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = registry.make
    monkeypatch.setattr(registry, "make", lambda kind, options=None: Crooked() if kind == "uniform" else real(kind))
    changes = [
        'race.peers=[{name="crooked",kind="uniform"},{name="right",kind="structured"}]',
        "race.stream.seconds=0.6", "race.single.seconds=0.3",
    ]  # fmt: skip
    arguments = [x for change in changes for x in ("--set", change)]
    done = CLI.invoke(app, ["bench", str(config), "--workers", "0", *arguments], catch_exceptions=False)
    assert done.exit_code == 3
    (folder,) = (config.parent / "runs").iterdir()
    found = json.loads((folder / "result.json").read_text())
    assert race.failed(found) == ["crooked"]
    assert "FAILED: biased" in (folder / "table.md").read_text()
    assert {x["name"] for w in winners(found) for x in w["ranking"]} == {"right"}
    assert figure_of(found).axes


def test_a_peer_whose_package_is_missing_says_so_and_the_race_goes_on(
    config: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Uniform, "needs", ("no_such_package",))
    found = runner.run(load(config, ['race.peers=[{name="u",kind="uniform"}]']), workers=0).result
    assert all(cell["skipped"] == "not installed: no_such_package" for cell in found["cells"])
    assert "not run: not installed: no_such_package" in markdown(found)
    assert rows(found)[0]["skipped"] and figure_of(found).axes


def test_a_cell_off_the_truth_is_biased_and_one_that_knows_too_little_untested() -> None:
    def cell(*points: tuple[bool, float], heavy: bool = False) -> dict[str, Any]:
        rmse = {"heavy": heavy, "high": 0.1}
        rows = [{"samples": 64, "tested": tested, "p_value": p, "rmse": rmse} for tested, p in points]
        return {"stream": {"points": rows}}

    assert race._verdict(cell((True, 1e-9), (True, 0.5)))["verdict"] == "biased"
    assert race._verdict(cell((True, 1e-4), (True, 0.5)))["verdict"] == "unbiased"
    assert race._verdict(cell((False, 1e-9)))["verdict"] == "untested"
    assert race._verdict(cell((True, 1e-9), heavy=True))["verdict"] == "untested"


def test_integrals_of_the_stream_are_computed_once_per_run_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Once:
        def __init__(self, integrand: Any) -> None:
            pass

        def check(self, contexts: Context) -> float:
            return 1e-7

        def __call__(self, contexts: Context) -> torch.Tensor:
            return contexts.n.unsqueeze(-1)

    contexts, directory = Context([0.1, 0.2], 0.0, [1.0, 2.0]), RunDirectory(tmp_path)
    monkeypatch.setattr(race, "StreamReference", Once)
    first = race._stream_truth("key", None, contexts, directory)  # type: ignore[arg-type]
    monkeypatch.setattr(race, "StreamReference", None)
    again = race._stream_truth("key", None, contexts, directory)  # type: ignore[arg-type]
    assert torch.equal(first[0], again[0]) and first[1] == again[1] == 1e-7
    monkeypatch.setattr(Once, "check", lambda self, contexts: 1e-3)
    monkeypatch.setattr(race, "StreamReference", Once)
    with pytest.raises(InputError, match="references that agree"):
        race._stream_truth("other", None, contexts, directory)  # type: ignore[arg-type]


def test_a_peer_with_rare_large_weights_is_marked_and_does_not_win(result: dict[str, Any]) -> None:
    found = json.loads(json.dumps(result))
    for cell in found["cells"]:
        if cell["label"] == "per context: contexts":
            cell["contexts"][0]["predicted_variance"] = 1e6
    marked = next(e for e in entrants(found["cells"]) if e.name == "per context")
    assert marked.heavy and not marked.honest
    assert all(x["name"] != "per context" for w in winners(found) for x in w["ranking"])
    assert "heavy tails" in markdown(found)


@pytest.mark.parametrize(
    "change, message",
    [
        ("race.peers=[]", "race.peers"),
        ('race.peers.0.kind="unifrom"', "did you mean 'uniform'"),
        ('race.peers.1.name="uniform sphere"', "race.peers.1.name"),
        ('race.peers.1.options={heuristic="best"}', "race.peers.1.options.heuristic"),
        ("race.peers.0.options={size=3}", "race.peers.0.options.size"),
        ('race.peers.0.uniforms="halton"', "race.peers.0.uniforms"),
        ('race.implementation="cuda"', "race.implementation"),
        ("race.stream.count=3", "race.stream.count"),
        ("race.stream.theta_max_deg=91", "race.stream.theta_max_deg"),
        ("race.budgets=[]", "race.budgets"),
        ("fiber.eccentricity=0.9", "round fibre"),
        ('light={kind="lobes", lobes=[{theta_deg=0, width_deg=10}]}', "constant light"),
        ('sweep.grid={"fiber.preset"=["blond"]}', "sweep.grid"),
    ],
)
def test_wrong_configs_are_refused_by_key(config: Path, change: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load(config, [change])
    assert message in str(caught.value)


def test_a_compiled_race_needs_float32(config: Path) -> None:
    with pytest.raises(ConfigError, match="race.implementation"):
        load(config, ['race.implementation="compiled"', 'estimate.dtype="float64"'])


def test_names_beside_curves_keep_their_distance_and_stay_inside() -> None:
    places = _spread_out([0.0, 0.01, 0.02, 0.99, 1.0], 0.2, 0.0, 1.0)
    assert all(b - a > 0.199 for a, b in zip(places, places[1:], strict=False))
    assert places[0] >= -1e-9 and places[-1] <= 1 + 1e-9
