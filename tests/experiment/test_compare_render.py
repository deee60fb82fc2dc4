"""Techniques compared on an image: from the config to tables and figures."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor
from typer.testing import CliRunner

from dsfit.cli import app
from dsfit.experiment import compare_render as module
from dsfit.experiment import runner
from dsfit.experiment.compare_render_painter import Painter, picture_of
from dsfit.experiment.compare_render_reference import agreement, centred, own_error
from dsfit.experiment.compare_render_report import equal_error, markdown, quality
from dsfit.experiment.compare_render_summary import rows
from dsfit.experiment.reader import ConfigError
from dsfit.experiment.rundir import RunDirectory
from dsfit.experiment.schema_render import ComparedTechnique, Technique
from dsfit.experiment.validation import load
from dsfit.render.images import RenderImage, read_image

CONFIG = """
kind = "compare_render"
title = "a small comparison"
[bsdf]
azimuthal = "simplified"
precision = "exact"
[geometry]
kind = "block"
options = { strands = 60, points = 6 }
radius_factor = 4.0
[camera]
width = 40
height = 30
[grid]
resolution = 6
[render]
dtype = "float64"
[compare]
width = 16
subsamples = 2
seconds = 0.1
equal_seconds = 0.02
equal_samples = 8
crop = [0.2, 0.2, 0.7, 0.8]
[compare.reference]
technique = { kind = "chapter", options = { model = "one" }, light = 0.3 }
samples = 64
passes = 8
check = { kind = "uniform" }
check_samples = 64
check_passes = 8
[[compare.techniques]]
name = "uniform"
kind = "uniform"
uniforms = "random"
[[compare.techniques]]
name = "chapter, Sobol"
kind = "chapter"
options = { model = "one" }
light = 0.3
[[compare.techniques]]
name = "M_R only"
kind = "single"
options = { proposal = "M_R" }
uniforms = "random"
"""


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("compare") / "small.toml"
    path.write_text(CONFIG)
    return path


@pytest.fixture(scope="module")
def finished(config: Path) -> Iterator[tuple[RunDirectory, dict[str, Any]]]:
    outcome = runner.run(load(config), config.parent / "runs", workers=0)
    yield outcome.directory, outcome.result


def test_a_run_leaves_tables_figures_and_images(config: Path, finished: Any) -> None:
    found = CliRunner().invoke(app, ["run", str(config), "--out", str(config.parent / "runs")])
    assert found.exit_code == 0, found.output
    assert "already done" in found.output and "M_R only" in found.output
    directory, _ = finished
    found = CliRunner().invoke(app, ["show", str(directory.path), "--plots"])
    assert found.exit_code == 0, found.output
    names = {path.name for path in (directory.path / "figures").iterdir()}
    assert {"curves.png", "curves.pdf", "equal_time-crops.png", "equal_samples-pictures.pdf"} <= names
    reference = read_image(directory.path / "images" / "reference.exr")
    assert (reference.width, reference.height) == (16, 12) and reference.variance is not None
    assert read_image(directory.path / "images" / "equal_time-M_R-only.exr").attributes["technique"] == "single"
    assert "a small comparison" in (directory.path / "table.md").read_text()


def test_the_reference_states_its_error_and_agrees_with_its_check(finished: Any) -> None:
    facts = finished[1]["cells"][0]["reference"]
    assert facts["check"]["verdict"] == "agree"
    assert 0 < facts["own_error"] < 0.05
    assert abs(facts["check"]["difference"]) < 5 * facts["check"]["standard_error"]


def test_errors_fall_with_samples_and_ratios_follow_from_the_curves(finished: Any) -> None:
    _, result = finished
    uniform, chapter, _ = result["cells"][1:]
    errors = [rung["error"] for rung in uniform["rungs"]]
    assert len(errors) >= 4 and errors[-1] < 0.5 * errors[0]
    assert [r["samples"] for r in uniform["rungs"]] == [2**k for k in range(len(errors))]
    assert uniform["equal_samples"]["samples"] == 8
    found = {row["name"]: row for row in rows(result)}
    to = found["chapter, Sobol"]["to"]["0.05"]
    if to["uniform"].how in ("measured", "extrapolated"):
        own, other = to["prepared"].seconds, found["uniform"]["to"]["0.05"]["prepared"].seconds
        assert to["uniform"].seconds == pytest.approx(other / own)
    counted = to["counted"].seconds - to["prepared"].seconds
    assert counted == pytest.approx(chapter["prepare"]["seconds"])
    assert found["uniform"]["to"]["0.05"]["uniform"].how == "unknown"  # there is no other one


def test_tables_have_a_row_for_every_technique(finished: Any) -> None:
    _, result = finished
    for lines in (quality(result), equal_error(result)):
        assert [line[0] for line in lines[1:]] == ["uniform", "chapter, Sobol", "M_R only"]
        assert {len(line) for line in lines} == {len(lines[0])}
    assert "agrees" in markdown(result)


def test_a_technique_that_fails_is_named_and_leaves_the_others_alone(
    config: Path, finished: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    directory, result = finished
    painted = Painter.paint

    def paint(self: Painter, samples: int, seed: int) -> tuple[Tensor, float]:
        if self.technique.name == "uniform":
            raise RuntimeError("out of luck")
        return painted(self, samples, seed)

    monkeypatch.setattr(Painter, "paint", paint)
    experiment = load(config)
    found = [
        module.compare_render(experiment.config, {"technique": name}, directory, lambda _: None)[0]
        for name in ("uniform", "chapter, Sobol")
    ]
    assert found[0]["failed"] == "RuntimeError: out of luck" and "rungs" in found[1]
    broken = {**result, "cells": [result["cells"][0], {**found[0], "index": 1}, {**found[1], "index": 2}]}
    assert "FAILED: RuntimeError" in markdown(broken)
    assert [line[0] for line in equal_error(broken)[1:]] == ["chapter, Sobol"]


def test_a_technique_off_the_reference_is_called_biased(
    config: Path, finished: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    directory, result = finished
    assert not any(cell["biased"] for cell in result["cells"][1:])
    painted = Painter.paint

    def paint(self: Painter, samples: int, seed: int) -> tuple[Tensor, float]:
        radiance, seconds = painted(self, samples, seed)
        return 1.3 * radiance, seconds

    monkeypatch.setattr(Painter, "paint", paint)
    slower = load(config, ["compare.seconds=1.0"]).config
    cell, _ = module.compare_render(slower, {"technique": "chapter, Sobol"}, directory, lambda _: None)
    assert cell["biased"] and cell["rungs"][-1]["mean"]["difference"] == pytest.approx(0.3, abs=0.1)


def test_an_interrupted_run_goes_on_with_the_stored_reference(
    config: Path, finished: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    directory, result = finished
    directory.cell_path(2).unlink()
    (directory.path / "result.json").unlink()
    passes: list[str] = []
    monkeypatch.setattr(module, "_passes", lambda *given: passes.append("again"))
    again = runner.run(load(config), config.parent / "runs", workers=0).result
    assert not passes
    assert again["cells"][1] == result["cells"][1]
    errors = [[rung["error"] for rung in run["cells"][2]["rungs"]] for run in (result, again)]
    shared = min(map(len, errors))
    assert errors[0][:shared] == errors[1][:shared]  # the same seeds; how far the ladder goes depends on the clock


def test_painting_is_reproducible_and_sees_the_background(config: Path) -> None:
    experiment = load(config, ["render.background=2.0"])
    picture = picture_of(module.small(experiment.config))
    painter = picture.painter(Technique(kind="uniform"))
    first, again, other = (painter.paint(4, seed)[0] for seed in (5, 5, 6))
    assert torch.equal(first, again) and not torch.equal(first, other)
    missed = picture.coverage == 0
    assert bool(missed.any()) and bool((first[missed] == 2.0).all())
    assert set(painter.preparation) == {"seconds", "prepare", "first_use", "trial"}


def test_the_share_of_light_sampling_is_the_best_of_a_trial(tmp_path: Path) -> None:
    sun = """
[light]
kind = "sun"
direction = [0.3, 0.1, 1.0]
angular_radius_deg = 1.0
radiance = 100.0
"""
    path = tmp_path / "sun.toml"
    path.write_text(CONFIG + sun)
    picture = picture_of(module.small(load(path, ['compare.techniques.1.light="best"']).config))
    fitted = ComparedTechnique(name="x", kind="uniform", light="best", uniforms="random")
    painter = picture.painter(fitted)
    assert painter.light >= 0.7 and painter.preparation["trial"] > 0  # all light comes from one narrow cone
    poor = picture.painter(Technique(kind="uniform", light=0.1, uniforms="random"))

    def spread(one: Painter) -> float:
        return float((one.paint(16, 1)[0] - one.paint(16, 2)[0]).square().mean())

    assert spread(painter) < 0.5 * spread(poor)


def _noisy(mean: Tensor, deviation: float, generator: torch.Generator) -> RenderImage:
    noise = deviation * torch.randn(mean.shape, generator=generator, dtype=torch.float64)
    covered = torch.ones(mean.shape[:2], dtype=torch.float64)
    return RenderImage(mean + noise, torch.full_like(mean, deviation**2), coverage=covered)


def test_agreement_is_found_and_small_differences_are_not_overlooked() -> None:
    generator = torch.Generator().manual_seed(3)
    truth = 1 + torch.rand(64, 48, 3, generator=generator, dtype=torch.float64)
    reference = _noisy(truth, 0.02, generator)
    same = agreement(reference, _noisy(truth, 0.05, generator))
    assert same["verdict"] == "agree" and same["blocks"] == 64
    assert abs(same["difference"]) < 4 * same["standard_error"]
    assert agreement(reference, _noisy(1.005 * truth, 0.05, generator))["verdict"] == "differ"
    local = truth.clone()
    local[:8, :6] *= 1.06  # one block in 64
    assert agreement(reference, _noisy(local, 0.05, generator))["verdict"] == "differ"


def test_own_error_and_centring_of_known_noise() -> None:
    generator = torch.Generator().manual_seed(4)
    truth = torch.full((80, 80, 3), 2.0, dtype=torch.float64)
    reference = _noisy(truth, 0.03, generator)
    assert own_error(reference, 1e-12) == pytest.approx(0.015, rel=0.02)
    fair = centred(_noisy(truth, 0.4, generator).radiance, reference)
    assert fair["z"] < 4 and fair["standard_error"] == pytest.approx(0.2 / 80, rel=0.05)
    off = centred(_noisy(1.02 * truth, 0.4, generator).radiance, reference)
    assert off["z"] > 5 and off["difference"] == pytest.approx(0.02, abs=0.01)


def test_the_small_picture_keeps_the_cameras_shape(config: Path) -> None:
    given = load(config).config
    small = module.small(given)
    assert (small.camera.width, small.camera.height, small.render.subsamples) == (16, 12, 2)
    assert math.isclose(small.camera.width / small.camera.height, given.camera.width / given.camera.height)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ("compare.techniques=[]", "compare.techniques"),
        ('compare.techniques.1.name="uniform"', "compare.techniques.1.name"),
        ('compare.techniques.0.name="reference"', "compare.techniques.0.name"),
        ('compare.techniques.2.options.proposel="M_R"', "compare.techniques.2.options.proposel"),
        ("compare.crop=[0.5, 0.2, 0.4, 0.8]", "compare.crop"),
        ("compare.targets=[2.0]", "compare.targets"),
        ('compare.reference.check={kind="uniforn"}', "compare.reference.check.kind"),
        ("compare.reference.passes=2", "compare.reference.passes"),
        ('sweep.grid={"fiber.eta"=[1.5, 1.6]}', "sweep.grid"),
    ],
)
def test_errors_name_the_key(config: Path, change: str, named: str) -> None:
    with pytest.raises(ConfigError) as found:
        load(config, [change])
    assert named in str(found.value)


def test_results_are_plain_data(finished: Any) -> None:
    directory, result = finished
    assert json.loads((directory.path / "result.json").read_text())["kind"] == "compare_render" == result["kind"]
