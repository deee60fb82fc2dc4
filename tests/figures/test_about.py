"""Every picture tells where it comes from, in bytes that repeat, and is read back."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from PIL import Image
from typer.testing import CliRunner

from dsfit.errors import InputError
from dsfit.experiment import about, runner
from dsfit.experiment.plots import draw_all
from dsfit.experiment.plots.style import new_figure, save, styled
from dsfit.experiment.validation import load
from dsfit.figures import read_about
from dsfit.figures.catalogue import find
from dsfit.figures.command import app
from dsfit.figures.make import make
from dsfit.render.images import RenderImage, write_image

TINY = """
[contexts]
theta_r_deg = [0.0]
n = [0]
[[methods]]
name = "uniform"
kind = "uniform"
[estimate]
samples = [16]
repeats = 2
rounds = 1
rtol = 1e-2
"""
TEXT = {"name": "a (b) \\ c\n) θ", "dsfit": "1", "git": "x", "packages": {"torch": "2"}, "nested": {"(": [1, 2]}}


def draw(folder: Path, name: str = "line", **more) -> list[Path]:
    with styled():
        figure = new_figure(3, 2)
        figure.subplots().plot([1, 3, 2])
        return save(figure, folder, name, **more)


def test_png_and_pdf_repeat_their_bytes_and_give_everything_back(tmp_path: Path):
    one, two = (draw(tmp_path / name, about=TEXT) for name in ("one", "two"))
    assert [path.suffix for path in one] == [".png", ".pdf"]
    for first, second in zip(one, two, strict=True):
        assert first.read_bytes() == second.read_bytes()
        assert read_about(first) == TEXT
    content = one[1].read_bytes()
    assert b"CreationDate" not in content and b"ModDate" not in content
    other = draw(tmp_path / "three", about={**TEXT, "data": "other"})
    assert all(a.read_bytes() != b.read_bytes() for a, b in zip(one, other, strict=True))


def test_without_more_a_picture_tells_of_the_present_code(tmp_path: Path):
    found = read_about(draw(tmp_path, "name")[0])
    assert found["name"] == "name" and found["dsfit"] and found["packages"]["torch"] == torch.__version__
    assert set(found["packages"]) == {"torch", "numpy", "matplotlib"}


def test_figures_by_name_tell_of_settings_data_and_code(add, tmp_path: Path):
    entry = find(add("toy_about"), "toy_about")
    make(entry, tmp_path, say=lambda what: None)
    found = read_about(tmp_path / "toy_about/figures/curve.pdf")
    assert read_about(tmp_path / "toy_about/figures/curve.png") == found
    computed = json.loads((tmp_path / "toy_about/computed.json").read_text())
    assert found["name"] == "toy_about" and found["figure"] == "curve" and found["data"] == computed["data"][:16]
    assert found["settings"] == about.plain_hash({"scale": 2.0}) and found["drawing"] == entry.drawing_version()
    assert found["dsfit"] == computed["provenance"]["dsfit"]
    make(entry, tmp_path, ["scale=3.0"], say=lambda what: None)
    other = read_about(tmp_path / "toy_about/figures/curve.pdf")
    assert other["settings"] != found["settings"] and other["data"] != found["data"]


def test_figures_of_a_run_repeat_and_tell_its_id(tmp_path: Path):
    (tmp_path / "tiny.toml").write_text(TINY)
    outcome = runner.run(load(tmp_path / "tiny.toml", ()), tmp_path, workers=0)
    written = draw_all(outcome.directory, outcome.result)
    first = [path.read_bytes() for path in written]
    assert [path.read_bytes() for path in draw_all(outcome.directory, outcome.result)] == first
    for path in written:
        found = read_about(path)
        assert found["run"] == outcome.result["run_id"] and found["name"] == outcome.result["name"]
        assert found["settings"] == about.plain_hash(outcome.result["config"]) and len(found["data"]) == 16


def test_exr_attributes_come_back(tmp_path: Path):
    image = RenderImage(torch.ones(2, 3, 3), attributes=about.exr_attributes(TEXT))
    path = write_image(tmp_path / "image.exr", image)
    assert read_about(path) == TEXT


@pytest.mark.parametrize(
    "name", ["none.png", "text.png", "text.pdf", "text.exr", "text.pgf", "bare.png", "cut.pdf", "a.txt"]
)
def test_what_says_nothing_is_refused(tmp_path: Path, name: str):
    path = tmp_path / name
    if name == "bare.png":
        Image.new("L", (2, 2)).save(path)
    elif name == "cut.pdf":
        path.write_bytes(draw(tmp_path / "whole", about=TEXT)[1].read_bytes()[:300])
    elif not name.startswith("none"):
        path.write_text("nothing of the kind")
    with pytest.raises(InputError, match=name):
        read_about(path)


def test_about_from_the_command_line(tmp_path: Path):
    path = draw(tmp_path, about=TEXT)[1]
    told = CliRunner().invoke(app, ["about", str(path)])
    assert told.exit_code == 0 and "[packages]" in told.stdout and 'torch = "2"' in told.stdout
    refused = CliRunner().invoke(app, ["about", str(tmp_path / "none.pdf")])
    assert refused.exit_code == 2 and "none.pdf" in refused.stderr
