"""`dsfit render`: from a config to an image, interrupted and resumed."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from typer.testing import CliRunner

from dsfit.cli import app
from dsfit.experiment import provenance, render, runner
from dsfit.experiment.reader import ConfigError
from dsfit.experiment.render_image import develop
from dsfit.experiment.render_report import markdown, rows
from dsfit.experiment.rundir import RunDirectory, RunFailure
from dsfit.experiment.validation import Experiment, load
from dsfit.render.images import RenderImage, image_errors, read_image

CLI = CliRunner()
CONFIG = """
kind = "render"
title = "a small picture"
[bsdf]
azimuthal = "simplified"
[geometry]
kind = "block"
options = { strands = 60, seed = 2 }
radius_factor = 6.0
[camera]
width = 14
height = 10
[grid]
resolution = 8
[render]
subsamples = 2
samples = 2
passes = 2
tile = 6
technique = { kind = "uniform", light = 0.0 }
"""
EXACT = ("radiance", "variance", "samples", "n", "coverage", "depth")


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "small.toml"
    path.write_text(CONFIG + f"[output]\ndir = '{tmp_path / 'runs'}'\n")
    return path


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> runner.Outcome:
    """An uninterrupted run, for tests that only read it."""
    folder = tmp_path_factory.mktemp("render")
    path = folder / "small.toml"
    path.write_text(CONFIG)
    return runner.run(load(path), folder / "runs", workers=0)


def image_of(directory: RunDirectory) -> RenderImage:
    return read_image(directory.path / "image.exr")


def assert_same_bits(found: RenderImage, expected: RenderImage) -> None:
    for layer in EXACT:
        assert torch.equal(getattr(found, layer), getattr(expected, layer)), layer


def stop_after(monkeypatch: pytest.MonkeyPatch, cells: int) -> None:
    """Let so many tiles finish, then interrupt."""
    real, done = runner.run_job, []

    def job(directory: RunDirectory, job: Any, say: Any) -> None:
        if len(done) == cells:
            raise KeyboardInterrupt
        real(directory, job, say)
        done.append(job.index)

    monkeypatch.setattr(runner, "run_job", job)


def forbid_tiles(monkeypatch: pytest.MonkeyPatch) -> None:
    def job(*_: Any) -> None:
        raise AssertionError("no tile is missing")

    monkeypatch.setattr(runner, "run_job", job)


def test_from_the_config_to_image_table_and_figures_and_shown_again(config: Path) -> None:
    done = CLI.invoke(app, ["render", str(config), "--workers", "0"], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    (folder,) = (config.parent / "runs").iterdir()
    for name in ("image.exr", "image.png", "result.json", "table.md", "figures/n.png", "figures/variance.png"):
        assert (folder / name).stat().st_size > 200, name
    assert (folder / "figures/time.png").is_file()
    text = (folder / "table.md").read_text()
    for line in ("time, wall", "time, CPU", "peak memory", "mean n", "relative standard error", "280 (2 per pixel)"):
        assert line in text and line in done.output
    with Image.open(folder / "image.png") as picture:
        assert picture.size == (14, 10) and "sRGB transfer" in picture.text["Tone map"]
    again = CLI.invoke(app, ["run", str(config), "--workers", "0"], catch_exceptions=False)
    assert again.exit_code == 0 and "already done" in again.output
    shown = CLI.invoke(app, ["show", str(folder), "--plots"], catch_exceptions=False)
    assert shown.exit_code == 0 and "time, wall" in shown.output and "image.exr" in shown.output


def test_the_image_is_its_tiles_and_says_where_it_is_from(whole: runner.Outcome) -> None:
    image, result = image_of(whole.directory), whole.result
    assert [cell["identity"]["tile"] for cell in result["cells"]] == [
        [0, 0, 6, 6], [0, 6, 6, 12], [0, 12, 6, 14], [6, 0, 10, 6], [6, 6, 10, 12], [6, 12, 10, 14]
    ]  # fmt: skip
    for cell in result["cells"]:
        top, left, bottom, right = cell["tile"]
        arrays = whole.directory.arrays(cell["index"])
        for layer in EXACT:
            part = getattr(image, layer)[top:bottom, left:right].numpy()
            assert np.array_equal(part, arrays[layer].astype(np.float32)), layer
        spent = float(image.time[top:bottom, left:right].double().sum())
        assert spent == pytest.approx(cell["cpu_seconds"], rel=1e-5)
    about = image.attributes
    assert about["dsfit.run"] == result["run_id"] and about["dsfit.version"] == provenance.code_version()
    assert about["dsfit.seed"] == "1" and about["dsfit.passes"] == 2 and about["dsfit.samples"] == 2
    assert json.loads(about["dsfit.technique"])["kind"] == "uniform"
    assert about["dsfit.seconds"] == pytest.approx(sum(c["cpu_seconds"] for c in result["cells"]), rel=1e-6)
    assert "cores" in about["dsfit.machine"] and len(about["dsfit.git"]) >= 7
    assert "strands = 60" in about["dsfit.config"]


def test_the_summary_follows_from_the_layers(whole: runner.Outcome) -> None:
    image, found = image_of(whole.directory), whole.result["image"]
    assert (found["width"], found["height"], found["tiles"], found["rays"]) == (14, 10, 6, 280)
    hits = float(image.coverage.sum()) * 2
    assert found["hits"] == hits and found["samples"] == hits * 4 == float(image.samples.sum())
    assert 0.2 < found["covered"] == float((image.coverage > 0).double().mean()) < 1
    assert found["peak_memory"] > 50 * 2**20
    covered = image.covered
    square = image.radiance[covered].double().square().mean()
    rms = math.sqrt(float(image.variance[covered].double().mean() / square))
    assert found["relative_rms_error"] == pytest.approx(rms, rel=1e-5)
    assert 0.05 < rms < 2 and 0.05 < found["relative_error"] < 2
    weighted = float((image.n * image.coverage).sum() / image.coverage.sum())
    assert found["mean_n"] == pytest.approx(weighted, rel=1e-5)
    assert {name for name, _ in rows(whole.result)} >= {"tiles", "rays", "samples", "technique"}
    assert "| tiles | 6 of at most 6 x 6 pixels |" in markdown(whole.result)


def test_an_interrupted_rendering_with_a_damaged_tile_ends_with_the_same_bits(
    config: Path, whole: runner.Outcome, monkeypatch: pytest.MonkeyPatch
) -> None:
    experiment = load(config)
    with monkeypatch.context() as patch:
        stop_after(patch, 4)
        with pytest.raises(KeyboardInterrupt):
            runner.run(experiment, workers=0)
    directory = runner.run_directory(experiment)
    assert not (directory.path / "image.exr").exists()
    damaged = directory.cell_path(2, "npz")
    damaged.write_bytes(damaged.read_bytes()[:-30])
    kept = {k: directory.cell_path(k).stat().st_mtime_ns for k in (0, 1, 3)}
    resumed = runner.run(experiment, workers=0)
    assert_same_bits(image_of(directory), image_of(whole.directory))
    assert all(directory.cell_path(k).stat().st_mtime_ns == stamp for k, stamp in kept.items())
    assert [s["cells_reused"] for s in resumed.result["provenance"]["sessions"]] == [0, 3]
    assert ("time, wall", "in 2 sittings") in [(a, b.split(", ")[-1]) for a, b in rows(resumed.result)]


@pytest.mark.slow
def test_processes_render_the_same_bits_as_one(config: Path, whole: runner.Outcome) -> None:
    found = runner.run(load(config), workers=2)
    assert_same_bits(image_of(found.directory), image_of(whole.directory))


def test_a_lost_image_is_put_together_again_from_its_tiles(config: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    experiment = load(config)
    directory = runner.run(experiment, workers=0).directory
    before = (directory.path / "image.exr").read_bytes()
    forbid_tiles(monkeypatch)
    (directory.path / "image.exr").write_bytes(before[: len(before) // 2])
    assert not runner.run(experiment, workers=0).skipped
    assert image_of(directory).radiance.shape == (10, 14, 3)
    (directory.path / "image.png").unlink()
    assert runner.run(experiment, workers=0).skipped and (directory.path / "image.png").is_file()


def test_another_exposure_shows_the_same_run_differently(config: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    directory = runner.run(load(config), workers=0).directory
    before = (directory.path / "image.png").read_bytes()
    forbid_tiles(monkeypatch)
    assert runner.run(load(config, ["compare.width=99"]), workers=0).skipped  # of no concern to the picture
    for change in ("render.exposure=7.0", 'render.tone_map="srgb"'):
        changed = runner.run(load(config, [change]), workers=0)
        assert changed.skipped and changed.directory.path == directory.path
        assert (directory.path / "image.png").read_bytes() != before
    with Image.open(directory.path / "image.png") as picture:
        assert "clipped" in picture.text["Tone map"]


def test_radiance_that_is_not_finite_fails_the_run_and_leaves_the_image_to_look_at(
    config: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = render.render

    def broken(*arguments: Any) -> Any:
        data, arrays = real(*arguments)
        if data["tile"][:2] == [6, 6]:
            arrays["radiance"][1, 2, 0] = np.nan
        return data, arrays

    monkeypatch.setattr(render, "render", broken)
    done = CLI.invoke(app, ["render", str(config), "--workers", "0"])
    assert done.exit_code == 1 and "row 7, column 8" in done.output
    (folder,) = (config.parent / "runs").iterdir()
    assert not (folder / "result.json").exists()
    assert bool(read_image(folder / "image.exr").radiance.isnan()[7, 8, 0])


def test_force_removes_the_images_of_the_earlier_run(config: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    experiment = load(config)
    directory = runner.run(experiment, workers=0).directory
    stop_after(monkeypatch, 0)
    with pytest.raises(KeyboardInterrupt):
        runner.run(experiment, workers=0, force=True)
    assert not (directory.path / "image.exr").exists() and not (directory.path / "image.png").exists()


def test_one_channel_gives_a_grey_picture(config: Path) -> None:
    experiment = load(config, ["fiber.sigma_a=[0.2]"])
    directory = runner.run(experiment, workers=0).directory
    assert image_of(directory).radiance.shape == (10, 14, 1)
    with Image.open(directory.path / "image.png") as picture:
        assert picture.mode == "L" and np.asarray(picture).max() > 100
    assert develop(directory, experiment.config.render).exposure > 0


@pytest.mark.parametrize(
    "change, message",
    [
        ('sweep.grid={"fiber.preset"=["blond"]}', "sweep.grid"),
        ("fiber.sigma_a=[1, 2]", "1 or 3 channels"),
        ("render.tile=0", "render.tile"),
        ("render.passes=1", "render.passes"),
        ("render.exposure=0", "render.exposure"),
        ('render.tone_map="gamma"', "render.tone_map"),
        ('render.technique={kind="unifrom"}', "did you mean 'uniform'"),
        ('render.technique={kind="uniform", options={size=3}}', "render.technique.options.size"),
        ('render.technique={kind="amortised", options={train=true, training={stepz=3}}}', "training.stepz"),
        ('render.technique={kind="amortised", options={train=true, training=3}}', "options.training"),
    ],
)
def test_wrong_configs_are_refused_by_key(config: Path, change: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load(config, [change])
    assert message in str(caught.value)


def test_a_picture_that_shows_nothing_says_so(config: Path) -> None:
    experiment: Experiment = load(config, ["camera.position=[0,0,100]", "camera.target=[0,0,200]"])
    with pytest.raises(RunFailure, match="empty picture"):
        runner.run(experiment, workers=0)


def test_changes_of_cpp_sources_make_another_version(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("experiment/provenance.py", "kernels/native.cpp", "bsdf/fiber.py"):
        (tmp_path / "dsfit" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "dsfit" / name).write_text("one")
    monkeypatch.setattr(provenance, "__file__", str(tmp_path / "dsfit/experiment/provenance.py"))

    def hashes() -> tuple[str, str]:
        provenance.sources_hash.cache_clear()
        return provenance.sources_hash(), provenance.sources_hash(("bsdf",))

    try:
        first = hashes()
        (tmp_path / "dsfit/kernels/native.cpp").write_text("two")
        second = hashes()
        (tmp_path / "dsfit/bsdf/fiber.py").write_text("two")
        third = hashes()
    finally:
        provenance.sources_hash.cache_clear()
    assert len({first[0], second[0], third[0]}) == 3
    assert first[1] == second[1] != third[1]


def test_images_of_other_sample_counts_differ_by_their_stated_variances(config: Path) -> None:
    finer = ["camera.width=30", "camera.height=24", "render.tile=30", "render.passes=6"]
    found, reference = (
        runner.run(load(config, [*finer, f"render.samples={samples}"]), workers=0).directory for samples in (3, 6)
    )
    pair = image_of(found), image_of(reference)
    assert torch.equal(pair[0].coverage, pair[1].coverage) and torch.equal(pair[0].depth, pair[1].depth)
    errors = image_errors(*pair)
    assert abs(errors.mse.value - errors.predicted) < 4 * errors.mse.standard_error
    assert errors.mse.value > 4 * errors.mse.standard_error  # about 0 if the reference had the image's directions


def test_with_a_pilot_further_passes_go_where_it_was_noisy(config: Path) -> None:
    experiment = load(config, ["render.pilot=2", "render.passes=6", "render.tile=14"])
    outcome = runner.run(experiment, workers=0)
    image = image_of(outcome.directory)
    passes = image.samples[image.covered] / (image.coverage[image.covered] * 2 * 2)
    assert set(passes.tolist()) <= {4.0, 6.0, 10.0, 18.0, 34.0} and len(set(passes.tolist())) > 1
    assert "2 passes, then 6 more on average, of 2 directions" in dict(rows(outcome.result))["samples"]


@pytest.mark.slow
def test_the_shipped_quick_config_renders_compiled_and_smooth(tmp_path: Path) -> None:
    config = Path(__file__).parents[2] / "configs" / "render_quick.toml"
    found = runner.run(load(config), tmp_path, workers=0).result["image"]
    assert found["backend"] == "compiled" and found["tiles"] == 9
    assert 0.4 < found["covered"] < 0.9 and found["relative_rms_error"] < 0.1
