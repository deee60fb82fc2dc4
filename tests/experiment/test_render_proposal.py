"""Proposals that renderings train: once for a run, found by other runs of the fibre."""

from __future__ import annotations

import functools
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

import dsfit.fit.amortise
from dsfit.errors import InputError
from dsfit.experiment import build, render, render_image, runner
from dsfit.experiment.proposal_cache import FOLDER, cache_key, cached_proposal
from dsfit.experiment.render_report import rows
from dsfit.experiment.schema import Config
from dsfit.experiment.store import load_proposal
from dsfit.experiment.validation import load
from dsfit.proposals import AmortisedProposal
from dsfit.render.images import read_image

CONFIG = """
kind = "render"
[bsdf]
azimuthal = "simplified"
[geometry]
kind = "block"
options = { strands = 60, seed = 2 }
radius_factor = 6.0
[camera]
width = 8
height = 6
[grid]
resolution = 8
[render]
subsamples = 1
samples = 1
passes = 2
tile = 6
technique = { kind = "amortised", light = 0.0, options = { train = true, training = { seed = 3 } } }
"""


_MADE: dict[Any, AmortisedProposal] = {}


def random_proposal(fibre: Any, bsdf: Any) -> AmortisedProposal:
    """With random weights; one for each fibre."""
    if fibre not in _MADE:
        _MADE[fibre] = AmortisedProposal(bsdf, hidden=(4,))
        generator = torch.Generator().manual_seed(1)
        with torch.no_grad():
            for weights in _MADE[fibre].parameters():
                weights += 0.1 * torch.randn(weights.shape, generator=generator, dtype=weights.dtype)
    return _MADE[fibre].requires_grad_(False)


@pytest.fixture
def trainings(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """The options of every training; instead of one, the network gets random weights."""
    asked: list[dict[str, Any]] = []

    @functools.wraps(dsfit.fit.amortise.amortise)
    def amortise(bsdf: Any, **options: Any) -> Any:
        asked.append(options)
        proposal = random_proposal(tuple(bsdf.fiber.sigma_a.tolist()), bsdf)
        return SimpleNamespace(proposal=proposal, seconds={"total": 12.5, "training": 9.0}, steps=7, contexts=5)

    monkeypatch.setattr("dsfit.fit.amortise.amortise", amortise)
    return asked


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "small.toml"
    path.write_text(CONFIG + f"[output]\ndir = '{tmp_path / 'runs'}'\n")
    return path


def quiet(_: str) -> None:
    pass


def test_a_run_trains_once_and_others_of_the_fibre_find_it(config: Path, trainings: list[Any]) -> None:
    render._technique.cache_clear()
    first = runner.run(load(config), workers=0)
    assert trainings == [{"seed": 3}]
    own = render.proposal_path(first.directory)
    (kept,) = (config.parent / "runs" / FOLDER).glob("*.npz")
    assert own.read_bytes() == kept.read_bytes()
    told = first.result["image"]["training"]
    assert (told["found"], told["steps"]) == (False, 7) and told["seconds"] > 0
    assert dict(rows(first.result))["training, CPU"].endswith(", 7 steps, before the first tile")
    other = runner.run(load(config, ["render.samples=2", "camera.width=9"]), workers=0)
    assert len(trainings) == 1 and other.result["image"]["training"] == {**told, "found": True}
    assert dict(rows(other.result))["training, CPU"].endswith(", 7 steps, by an earlier run")


def test_tiles_are_drawn_from_the_trained_proposal(
    config: Path, trainings: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(render, "direction_seed", lambda config: 7)  # whatever the technique's options are
    trained = runner.run(load(config), workers=0).directory
    untrained = runner.run(load(config, ["render.technique.options.train=false"]), workers=0).directory
    given = f"render.technique.options={{file='{render.proposal_path(trained)}'}}"
    same = runner.run(load(config, [given]), workers=0).directory
    images = [read_image(render_image.image_path(one)).radiance for one in (trained, untrained, same)]
    assert not torch.equal(images[0], images[1]) and torch.equal(images[0], images[2])
    assert len(trainings) == 1


def test_a_resumed_run_keeps_its_proposal_even_if_the_cache_is_gone(config: Path, trainings: list[Any]) -> None:
    directory = runner.run(load(config), workers=0).directory
    (directory.path / "result.json").unlink()
    directory.cell_path(1).unlink()
    for path in (config.parent / "runs" / FOLDER).iterdir():
        path.unlink()
    before = read_image(directory.path / "image.exr").radiance
    runner.run(load(config), workers=0)
    assert len(trainings) == 1 and torch.equal(read_image(directory.path / "image.exr").radiance, before)
    own = render.proposal_path(directory)  # and a damaged one is trained again
    own.write_bytes(own.read_bytes()[:-50])
    (directory.path / "result.json").unlink()
    directory.cell_path(0).unlink()
    runner.run(load(config), workers=0)
    assert len(trainings) == 2 and torch.equal(read_image(directory.path / "image.exr").radiance, before)


def test_a_process_does_not_go_on_with_an_earlier_proposal(config: Path, trainings: list[Any]) -> None:
    directory, one = runner.run(load(config), workers=0).directory, load(config).config
    before = render._technique_key(one, directory)
    assert render._technique_key(one, directory) == before
    os.utime(render.proposal_path(directory), ns=(1, 1))
    assert render._technique_key(one, directory) != before


def test_damaged_or_unfinished_cache_files_are_made_again(
    config: Path, trainings: list[Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    one: Config = load(config).config
    path, facts = cached_proposal(one, {"seed": 1}, tmp_path, quiet)
    assert facts["found"] is False and facts["wall_seconds"]["total"] == 12.5
    assert cached_proposal(one, {"seed": 1}, tmp_path, quiet) == (path, {**facts, "found": True})
    whole = path.read_bytes()
    for spoil in (lambda: path.write_bytes(whole[:100]), path.with_suffix(".json").unlink, path.unlink):
        spoil()
        count = len(trainings)
        assert cached_proposal(one, {"seed": 1}, tmp_path, quiet)[1]["found"] is False
        assert len(trainings) == count + 1
        assert load_proposal(path).defensive == 0.001

    def interrupted(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("dsfit.fit.amortise.amortise", interrupted)
    with pytest.raises(KeyboardInterrupt):
        cached_proposal(one, {"seed": 2}, tmp_path, quiet)
    assert {p.stem for p in path.parent.iterdir()} == {path.stem}


def test_a_file_of_another_fibre_under_the_name_is_not_taken(
    config: Path, trainings: list[Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    one, other = load(config).config, load(config, ['fiber.preset="black"']).config
    right, _ = cached_proposal(one, {}, tmp_path, quiet)
    wrong = tmp_path / FOLDER / f"{cache_key(build.bsdf(other), {})}.npz"
    wrong.write_bytes(right.read_bytes())
    wrong.with_suffix(".json").write_bytes(right.with_suffix(".json").read_bytes())
    with pytest.raises(InputError):
        render.loaded(str(wrong), build.bsdf(other))

    def trained(*_: Any, **__: Any) -> None:
        raise RuntimeError("trained anew")

    monkeypatch.setattr("dsfit.fit.amortise.amortise", trained)
    with pytest.raises(RuntimeError, match="trained anew"):
        cached_proposal(other, {}, tmp_path, quiet)


def test_the_key_depends_on_all_that_is_trained(config: Path) -> None:
    def key(*changes: str, **training: Any) -> str:
        return cache_key(build.bsdf(load(config, list(changes)).config), training)

    keys = {
        key(), key(steps=3), key(seed=1), key('fiber.preset="black"'), key("bsdf.d_f=0.5"), key("bsdf.d_b=0.5"),
        key('bsdf.azimuthal="marschner"'), key('bsdf.convention="printed"'), key('bsdf.precision="exact"'),
    }  # fmt: skip
    assert len(keys) == 9
    assert key() == key("render.samples=9", "camera.width=20") == key("render.seed=7")


@pytest.mark.slow
def test_a_real_training_of_few_steps_renders_and_is_found_again(config: Path) -> None:
    small = "render.technique.options.training={steps=3, inclinations=4, pairs=2, hidden=[4]}"
    first = runner.run(load(config, [small]), workers=0)
    assert first.result["image"]["training"]["steps"] == 3 and first.result["image"]["training"]["seconds"] > 0
    again = runner.run(load(config, [small, "render.seed=5"]), workers=0)
    assert again.result["image"]["training"]["found"] is True


@pytest.mark.slow
def test_two_processes_that_train_at_once_end_with_the_same_proposal(config: Path) -> None:
    """Both begin before either can have finished; each keeps its own copy."""
    small = "render.technique.options.training={steps=3, inclinations=4, pairs=2, hidden=[4]}"
    command = [sys.executable, "-m", "dsfit.cli", "render", str(config), "--workers", "0", "--set", small]
    started = [
        subprocess.Popen([*command, "--set", f"render.seed={seed}"], stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
        for seed in (1, 2)
    ]
    for process in started:
        output, _ = process.communicate(timeout=300)
        assert process.returncode == 0, output.decode()
    folders = [path for path in (config.parent / "runs").iterdir() if path.name != FOLDER]
    proposals = [load_proposal(folder / "proposals" / "amortised.npz") for folder in folders]
    (kept,) = (config.parent / "runs" / FOLDER).glob("*.npz")
    weights = [list(one.network.parameters()) for one in (*proposals, load_proposal(kept))]
    assert all(torch.equal(a, b) for other in weights[1:] for a, b in zip(weights[0], other, strict=True))
    assert len(folders) == 2 and len(list((config.parent / "runs" / FOLDER).iterdir())) == 2
