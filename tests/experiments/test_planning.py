"""The experiment `planning`: what a scene is, timing in turn, and pictures and tables of stored data."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import torch

from dsfit.figures import Data, Work
from dsfit.figures.catalogue import find
from dsfit.figures.data import read_data, write_data
from dsfit.figures.page import Page
from dsfit.figures.verify import compare
from experiments import planning
from experiments.drawing import planning as drawing

ROOT = Path(__file__).parents[2]


def _times(ratio: float) -> dict[str, Any]:
    return {"seconds": [ratio, 1.0], "ratio": ratio, "interval": [0.9 * ratio, 1.1 * ratio]}


def _data() -> Data:
    terms = ("R", "TT", "TRT", "back")
    plans = [
        {"bound": 0.0, "grey": True, "dropped": [{"half": "scattered", "term": t, "bound": 0.0} for t in terms]},
        {"bound": 3e-3, "grey": False, "dropped": [{"half": "direct", "term": "TRT", "bound": 3e-3},
                                                   {"half": "both", "term": "glint", "bound": 1e-4}]},
    ]  # fmt: skip
    rows = [
        {"name": f"scene {k}", "plan": plan, "plan_seconds": 0.3, "error": [1e-9, 2e-3][k], "error_accuracy": 1e-7,
         "nodes": [2000, 1000], "components": [8, 4], "excess": [1e-3, 2e-3],
         **{key: _times(2.0) for key in drawing.SHOWN}}
        for k, plan in enumerate(plans)
    ]  # fmt: skip
    return Data(record={"tolerance": 0.01, "scenes": rows})


def test_scenes_of_the_settings_are_what_they_are_called() -> None:
    scenes = {scene.name: scene for scene in find(ROOT, "planning").settings().scenes}
    assert len(scenes) == 6
    single = scenes["single scattering only"].context()
    assert single.batch_shape == (3,) and bool((single.v == 1).all())
    assert scenes["black hair"].context().batch_shape == (9,)
    assert float(scenes["no back scattering"].integrand().bsdf.d_b) == 0
    grey = scenes["grey fibre"].integrand().bsdf.fiber
    assert torch.equal(grey.sigma_a, torch.full((3,), 0.1, dtype=torch.float64))
    smooth = scenes["no glints"].integrand().bsdf.fiber
    assert torch.allclose(smooth.beta, torch.tensor([3.0, 1.5, 6.0], dtype=torch.float64) * math.pi / 180)


def test_calls_are_timed_in_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    now, order = [0.0], []

    def call(name: str, seconds: float) -> Any:
        def run() -> None:
            order.append(name)
            now[0] += seconds

        return run

    monkeypatch.setattr(planning.time, "perf_counter", lambda: now[0])
    found = planning.in_turns([call("a", 3.0), call("b", 1.0)], 4)
    assert order == ["a", "b", "b", "a", "a", "b", "b", "a", "a", "b"]
    assert found["seconds"] == pytest.approx([3.0, 1.0]) and found["ratio"] == pytest.approx(3.0)
    assert found["interval"] == pytest.approx([3.0, 3.0])


def test_tables_say_what_goes_and_by_which_bound() -> None:
    left_out, saved, seconds = drawing.tables(_data())
    assert [row[1] for row in left_out.rows] == ["all scattered; all channels but one",
                                                 "direct (TRT); (treatment of the caustic)"]  # fmt: skip
    assert [row[2:4] for row in left_out.rows] == [["exact", "0"], ["3.0e-03", "2.0e-03"]]
    assert saved.rows[0][1] == "2.00 (1.80 to 2.20)" and saved.rows[0][5] == "2000 → 1000"
    assert seconds.rows[0][1:3] == ["300", "2e+03 → 1e+03"]


def test_the_picture_has_a_row_for_each_scene() -> None:
    (figure,) = drawing.figures(_data(), Page(150.0)).values()
    figure.draw_without_rendering()
    left, right = figure.axes
    assert [text.get_text() for text in left.texts] == ["exact"] and len(right.patches) == 10


def test_seconds_are_not_held_and_bounds_are() -> None:
    rules, old = planning.EXPERIMENT.reproduces, _data()
    for key, value, verdict in (("plan_seconds", 9.0, "agrees"), ("fit", _times(0.5), "agrees"),
                                ("nodes", [2040, 1000], "agrees"), ("nodes", [3000, 1000], "deviates"),
                                ("error", 3e-3, "deviates"), ("name", "another", "deviates")):  # fmt: skip
        new = _data()
        new.record["scenes"][1][key] = value
        assert compare(new, old, rules)["verdict"] == verdict, key
    new = _data()
    new.record["scenes"][1]["plan"]["bound"] = 3.1e-3
    assert compare(new, old, rules)["verdict"] == "deviates"


@pytest.mark.slow
def test_a_small_run(tmp_path: Path) -> None:
    settings = find(ROOT, "planning").settings(planning.EXPERIMENT.small)
    write_data(tmp_path, planning.compute(settings, Work(tmp_path, ROOT, lambda what: None)))
    data = read_data(tmp_path)
    (row,) = data.record["scenes"]
    assert drawing.gone(row["plan"]) == "all direct" and row["plan"]["bound"] == 0
    assert row["error"] <= max(row["error_accuracy"], 1e-14) and row["excess"][1] < 0.01
    assert all(row[key]["ratio"] > 0 for key in drawing.SHOWN)
    assert drawing.figures(data, Page(150.0))
