"""The chapter's figure 1: attenuation, a_f^n and its fits, as small runs give them."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("jax")

from dsfit.figures import Data, Work  # noqa: E402
from dsfit.figures.data import read_data, write_data  # noqa: E402
from dsfit.figures.page import Page  # noqa: E402
from experiments.drawing import figure1 as drawing  # noqa: E402
from experiments.figure1 import EXPERIMENT, Figure1, compute  # noqa: E402


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Data:
    folder = tmp_path_factory.mktemp("figure1")
    presets = ["nonabsorbing", "brown", "black"]
    settings = Figure1(
        presets=presets,
        step_deg=2.5,
        shown_n=[1.0, 20.0],
        fit_n=[1.0, 20.0, 400.0],
        measures=[0.0, 2.0],
        slope_from=20.0,
    )
    write_data(folder, compute(settings, Work(folder, Path(), lambda what: None)))
    return read_data(folder)


def test_attenuation_is_a_share_and_absorption_lowers_it(data: Data):
    presets = data.record["presets"]
    for name in presets:
        forward, backward = data.arrays[f"{name}.a_f"], data.arrays[f"{name}.a_b"]
        assert (forward >= 0).all() and (backward >= 0).all() and (forward + backward <= 1 + 1e-9).all()
        assert forward[[0, -1]] == pytest.approx(0, abs=1e-9)  # the cosine of incidence
    for lighter, darker in zip(presets, presets[1:], strict=False):
        assert (data.arrays[f"{darker}.a_f"] <= data.arrays[f"{lighter}.a_f"] + 1e-12).all()
    middle = len(data.arrays["theta_deg"]) // 2
    assert data.arrays["nonabsorbing.a_f"][middle] == pytest.approx(0.7772, abs=1e-4)  # quadrature done elsewhere
    assert data.arrays["nonabsorbing.a_b"][middle] == pytest.approx(0.1997, abs=1e-4)


def test_densities_integrate_to_one(data: Data):
    theta = data.arrays["theta_deg"]
    assert np.trapezoid(data.arrays["cosine"], theta) == pytest.approx(1, abs=1e-3)
    for name in data.record["presets"]:
        for row in data.arrays[f"{name}.density"]:
            assert np.trapezoid(row, theta) == pytest.approx(1, abs=1e-6)
    for row in data.arrays["brown.gaussian"]:  # none with its centre on the edge
        assert np.trapezoid(row, theta) == pytest.approx(1, abs=2e-3)


def test_width_follows_the_curvature_of_the_peak(data: Data):
    """width sqrt(n) tends to 1 / sqrt(-(log a_f)''), for hair that has a peak; the cosine is too wide by far then."""
    for name in ("nonabsorbing", "brown"):
        law = data.record["width"][name]
        assert law["last_deg"] == pytest.approx(law["limit_deg"], rel=0.03) and -0.53 < law["slope"] < -0.4
        assert data.arrays[f"{name}.fit.excess"][-1] < 1e-3 < data.arrays[f"{name}.fit.excess_cosine"][-1]
        assert data.arrays[f"{name}.fit.width_deg"][-1] < drawing.COSINE_STD_DEG / 4
    assert math.isnan(float(data.record["width"]["black"]["limit_deg"])) and data.record["at_bounds"]["black"][0]


def test_claims_of_the_caption(data: Data):
    for name in data.record["presets"]:
        claim = data.record["claims"][name]
        assert claim["a_b_last"] < claim["a_b_most"]  # what goes back falls again towards 90 degrees ...
        assert claim["back_share_grazing"] > claim["back_share_0"]  # ... its share does not
        low, high = claim["near_of_all"]
        assert high > 0.99 > low if name != "black" else high < 1e-6 < low
    rows = {(row[0], row[1]): row[2] for row in drawing.tables(data)[0].rows}
    assert rows["more goes back towards ±90°: a_b", "nonabsorbing"] == "no"
    assert [row[2] for row in drawing.tables(data)[0].rows[-3:]] == ["-", "no", "no"]


def test_measures_agree_where_they_are_the_same_fit(data: Data):
    for name in ("nonabsorbing", "brown"):
        plain = data.record["measures"][name][0]
        assert plain["gaussian"][1] == pytest.approx(data.arrays[f"{name}.fit.excess"][1], rel=1e-6)
        assert data.record["measures"][name][1]["cosine"][1] > plain["cosine"][1]  # the measure narrows the target


def test_everything_is_drawn(data: Data):
    assert set(drawing.figures(data, Page())) == {"averages", "densities", "fits"}
    assert [table.name for table in drawing.tables(data)] == ["claims", "fits", "measures"]
    assert set(EXPERIMENT.reproduces) >= {"*.a_?", "claims.*"}
