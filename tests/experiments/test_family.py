"""The experiment `family`: quantiles with standard errors, what they hold, and a small run from end to end."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path

import numpy as np
import pytest

from dsfit.figures import Data, Work
from dsfit.figures.catalogue import find
from dsfit.figures.data import read_data, write_data
from dsfit.figures.page import Page
from dsfit.figures.verify import compare
from experiments import family
from experiments._family_judge import named, quantiles
from experiments.drawing import family as drawing

ROOT = Path(__file__).parents[2]
PRESETS = ("nonabsorbing", "blond", "brown", "black")


def _excess(seed: int, fibers: int = 12) -> tuple[np.ndarray, np.ndarray]:
    """Excesses `[views, pairs]` that differ from fibre to fibre by a factor of two, and within one by as much."""
    random = np.random.default_rng(seed)
    fiber = np.repeat(np.arange(fibers), 6)
    level = random.normal(-3, 0.3, fibers)[fiber][:, None]
    return 10 ** (level + random.normal(0, 0.3, (len(fiber), 6))), fiber


def test_errors_are_those_of_other_fibres() -> None:
    """Medians of families drawn anew scatter as the bootstrap says."""
    found = [quantiles(*_excess(seed)) for seed in range(40)]
    spread = np.std([one["log10"][0] for one in found])
    assert np.median([one["log10_error"][0] for one in found]) == pytest.approx(spread, rel=0.4)
    value, fiber = _excess(0)
    assert found[0]["worst"] == pytest.approx(value.max())
    assert found[0]["log10"][2] == pytest.approx(np.quantile(np.log10(value), 0.99))
    assert np.isnan(quantiles(value[:0], fiber[:0])["log10"]).all()
    assert (quantiles(value[:1], fiber[:1])["log10_error"] == 0).all()


@functools.cache
def _data(seed: int = 0) -> Data:
    """Twelve unseen fibres, four of them elliptic, and the presets."""
    flat = np.arange(12) % 3 == 0
    arrays = {"fiber.sigma_a": np.geomspace(0.01, 9, 16)[:, None].repeat(3, 1), "curve.fibers": np.array([6, 96]),
              "fiber.eccentricity": np.where(np.append(flat, [False] * 4), 0.9, 1.0), "curve.steps": np.array([9, 9]),
              "mix.pairs": np.full(5, 0.1), "mix.family.log10": np.array([-3.0]),
              "mix.family.log10_error": np.array([0.1])}  # fmt: skip
    arrays |= {f"exact.{key}": np.ones(2) for key in ("used", "exact", "mass")}
    for name in drawing.STREAMS:
        for stage in ("untrained", "trained"):
            value, fiber = _excess(seed, 16)
            arrays |= family.judge(f"{name}.{stage}", value, fiber, flat)
        arrays |= named(f"curve.{name}", *(quantiles(*_excess(k)) for k in (1, 2)))
    arrays |= named("curve.train", *(quantiles(*_excess(k)) for k in (3, 4)))
    arrays |= named("own.brown.family", quantiles(*_excess(5))) | named("own.brown.own", quantiles(*_excess(6)))
    place = {"excess": 0.1, "fiber": 3, "theta_r_deg": 80.0, "n": 12.0, "v": 0.0}
    seconds = {"round": 0.4, "eccentric": 1.0, "bsdf": 2.0}
    record = {"unseen": 12, "presets": list(PRESETS), "levels": list(family.CURVE), "table_seconds": seconds,
              "target_seconds": 9.0, "training_seconds": [1.0, 2.0], "own": ["brown"], "own_seconds": [3.0],
              "worst": {name: [place] for name in drawing.STREAMS}}  # fmt: skip
    return Data(arrays, record)


def test_fibres_are_told_apart() -> None:
    arrays = _data().arrays
    value, fiber = _excess(0, 16)
    assert arrays["angle.trained.by_fiber.log10"].shape == (12, 3)
    assert arrays["angle.trained.by_fiber.log10"][5, 0] == pytest.approx(np.median(np.log10(value[fiber == 5])))
    assert arrays["angle.trained.black.log10"][0] == pytest.approx(np.median(np.log10(value[fiber == 15])))
    flat = np.isin(fiber, [0, 3, 6, 9])
    assert arrays["angle.trained.eccentric.log10"][0] == pytest.approx(np.median(np.log10(value[flat])))
    assert arrays["angle.trained.all.worst"] == pytest.approx(value[fiber < 12].max())


def test_pictures_and_tables_are_made_from_the_data() -> None:
    figures = drawing.figures(_data(), Page(150.0))
    assert set(figures) == {"unseen", "by_fiber"}
    for figure in figures.values():
        figure.draw_without_rendering()
    tables = {table.name: table for table in drawing.tables(_data())}
    assert {name: len(table.rows) for name, table in tables.items()} == {
        "unseen": 16, "own": 2, "curve": 6, "worst": 2, "exact": 2
    }  # fmt: skip
    assert "median is 0.001, that of the best mix of the chapter's proposals 0.1" in tables["unseen"].caption
    assert tables["worst"].rows[0] == ["all inclinations", "3", "0.1", "80", "12.0", "0"]


def test_other_fibres_agree_and_a_worse_training_does_not() -> None:
    rules, data = family.EXPERIMENT.reproduces, _data()
    trained = "angle.trained.all.log10"
    for name, shift, verdict in ((trained, 0.1, "agrees"), (trained, 1.0, "deviates"),
                                 ("angle.untrained.all.log10", 0.1, "deviates"),
                                 ("angle.trained.all.worst", 1.0, "agrees"),
                                 ("exact.mass", 0.01, "deviates"), ("fiber.sigma_a", 0.1, "deviates")):  # fmt: skip
        other = dataclasses.replace(data, arrays={**data.arrays, name: data.arrays[name] + shift})
        assert compare(other, data, rules)["verdict"] == verdict, (name, shift)


@pytest.mark.slow
def test_a_small_run(tmp_path: Path) -> None:
    settings = find(ROOT, "family").settings(family.EXPERIMENT.small)
    write_data(tmp_path, family.compute(settings, Work(tmp_path, ROOT, lambda what: None)))
    data = read_data(tmp_path)
    assert (tmp_path / "family_proposal.npz").is_file()
    assert compare(data, data, family.EXPERIMENT.reproduces)["verdict"] == "agrees"
    assert data.arrays["exact.mass"] == pytest.approx(1, abs=0.01)
    assert data.arrays["exact.used"] == pytest.approx(data.arrays["exact.exact"], rel=0.1)
    assert drawing.figures(data, Page(150.0)) and drawing.tables(data)
