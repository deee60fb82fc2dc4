"""Figure 2: predictions from weights, what is stored of pictures, and a small run."""

from __future__ import annotations

import io
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from dsfit.figures import Work
from dsfit.figures.data import read_data, write_data
from dsfit.figures.page import Page
from experiments._figure2_weights import WEIGHTS, Prediction, _tails
from experiments.drawing import figure2 as drawing
from experiments.figure2 import Figure2, _jpeg, _overrides, _window, compute


def test_tails_of_a_weight_with_two_values():
    """F = 1 on the unit interval, p = 1/2 on its first half and 3/2 on the second: weights 2 and 2/3."""
    value = torch.ones(100, 1, 1, dtype=torch.float64)
    weight = torch.full((100, 1), 0.01, dtype=torch.float64)
    log_p = torch.log(torch.cat([torch.full((50, 1), 0.5), torch.full((50, 1), 1.5)]).double())
    survival, moment = (x[0].numpy() for x in _tails(value, weight, log_p))
    below, between, above = (WEIGHTS < 0.66), (WEIGHTS > 0.67) & (WEIGHTS < 1.99), WEIGHTS > 2.01
    assert survival[below] == pytest.approx(1) and survival[above] == pytest.approx(0)
    assert survival[between] == pytest.approx(0.25)  # chance of the first half under p
    assert moment[between] == pytest.approx(0.75)  # 1/p: 2 against 2/3
    assert moment[below] == pytest.approx(1) and moment[above] == pytest.approx(0)


def test_predicted_error_falls_as_one_over_root_n():
    prediction = Prediction(np.array([1.0, 3.0]), WEIGHTS, WEIGHTS)
    assert prediction.error(2)[0] == pytest.approx(1.0)
    assert prediction.error(8)[0] == pytest.approx(0.5)
    assert prediction.error(8)[1] == pytest.approx(1 / math.sqrt(2) / 8 / (2 * 0.5))


def test_pictures_survive_their_storage():
    from PIL import Image

    y, x = torch.meshgrid(torch.linspace(0, 1, 40), torch.linspace(0, 1, 50), indexing="ij")
    display = torch.stack([x, y, 0.5 * (x + y)], dim=-1)
    found = np.asarray(Image.open(io.BytesIO(_jpeg(display, 90).tobytes()))) / 255
    assert found.shape == (40, 50, 3) and np.abs(found - display.numpy()).mean() < 0.01
    assert display[_window(display.shape, 0.5)].shape == (20, 25, 3)
    assert torch.equal(display[_window(display.shape, 1.0)], display)


@pytest.mark.parametrize("scene", ["lamp", "sky"])
def test_overrides_make_a_valid_config(scene: str):
    from dsfit.experiment.validation import load
    from experiments.figure2 import SCENES

    root = Path(__file__).parents[2]
    config = load(root / "configs" / SCENES[scene], _overrides(scene, Figure2(width=20))).config
    assert config.compare.width == 20 and config.camera.direction == [0.6, 0.15, 1.0]
    assert [t.kind for t in config.compare.techniques][:1] == ["single"] and len(config.compare.techniques) == 5


@pytest.mark.slow
def test_small_run(tmp_path: Path):
    pytest.importorskip("embreex")
    root = Path(__file__).parents[2]
    settings = Figure2(width=24, ladder_seconds=0.3, equal_seconds=0.2, equal_samples=8, reference_samples=32,
                       training_steps=20, predicted_pixels=64, nodes=1024)  # fmt: skip
    write_data(tmp_path, compute(settings, Work(tmp_path, root, lambda what: None)))
    data = read_data(tmp_path)
    sky, lamp = (data.record["scenes"][scene]["of"] for scene in ("sky", "lamp"))
    # where weights have no tail, quadrature foretells the picture's error
    for name in ("uniform", "best heuristic mix"):
        facts = sky[name]["equal_samples"]
        assert facts["predicted"] == pytest.approx(facts["error"], rel=0.25)
    # of M_R it sees a tail: most of the second moment is in weights far above the mean
    predicted = {name: sky[name]["equal_samples"]["predicted"] for name in ("M_R only", "uniform")}
    assert predicted["M_R only"] > 4 * predicted["uniform"]
    tail = data.arrays["sky.M_R only.moment"]
    assert tail[np.searchsorted(data.arrays["weights"], 1e2)] > 0.5 > data.arrays["sky.uniform.moment"][30]
    assert lamp["best heuristic mix + light"]["equal_samples"]["error"] < lamp["M_R only"]["equal_samples"]["error"]
    assert set(drawing.figures(data, Page())) == {"pictures-lamp", "pictures-sky", "weights"}
    assert [len(table.rows) for table in drawing.tables(data)] == [10, 10]
    assert list((tmp_path / "runs").glob("*/images/equal_time-M_R-only.exr"))
