"""Designs: which points a [sweep] means, and what is refused."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.stats import qmc

from dsfit.errors import InputError
from dsfit.experiment import files
from dsfit.experiment.design import Choices, Design, Range, all_values, at_point, design_of
from dsfit.experiment.reader import ConfigError, RawConfig
from dsfit.experiment.validation import expand, load, validate
from tests.fuzz.common import attempt, fuzz

UNIT = Range(0.0, 1.0)


def raw(**sweep: Any) -> RawConfig:
    uniform = {"name": "uniform", "kind": "uniform"}
    return RawConfig("a", "a.toml", {"fiber": {"beta_deg": [7, 3, 14]}, "methods": [uniform], "sweep": sweep})


def design(**sweep: Any) -> Design:
    made = raw(**sweep)
    return design_of(made, validate(made).sweep)


def message(**sweep: Any) -> str:
    with pytest.raises(ConfigError) as caught:
        design(**sweep)
    return str(caught.value)


@pytest.mark.parametrize("kind", ["random", "sobol"])
def test_points_are_those_of_the_sequence_and_repeat(kind: str) -> None:
    space = {"a": UNIT, "b": UNIT, "c": UNIT}
    made = Design({}, space, kind, points=64, seed=3)
    found = np.array([list(values.values()) for values in all_values(made)])
    generator = np.random.default_rng(3)
    expected = generator.random((64, 3)) if kind == "random" else qmc.Sobol(3, seed=generator).random(64)
    np.testing.assert_allclose(found, expected, atol=1e-12)
    again = Design({}, space, kind, points=20, seed=3)  # the first of the same sequence
    assert [again.values(k) for k in range(20)] == [made.values(k) for k in range(20)]
    assert Design({}, space, kind, points=64, seed=4).values(0) != made.values(0)


def test_sobol_points_fill_every_elementary_interval() -> None:
    """The first 2^m points have one in each of 2^m equal intervals of every axis, and the first two axes are a
    (0, m, 2)-net: one point in every box of volume 2^-m."""
    made = Design({}, {"a": UNIT, "b": UNIT, "c": UNIT}, "sobol", points=64, seed=7)
    u = np.array([list(values.values()) for values in all_values(made)])
    for axis in range(3):
        assert sorted(np.floor(64 * u[:, axis]).astype(int)) == list(range(64))
    for k in range(7):
        boxes = np.floor(u[:, 0] * 2**k) * 2 ** (6 - k) + np.floor(u[:, 1] * 2 ** (6 - k))
        assert sorted(boxes.astype(int)) == list(range(64))


def test_scales_integers_and_choices() -> None:
    u = (np.arange(1200) + 0.5) / 1200
    log = np.array([Range(0.01, 100.0, log=True).at(x) for x in u])
    np.testing.assert_allclose(np.log10(log), -2 + 4 * u, atol=1e-11)
    whole = [Range(2, 5, integer=True).at(x) for x in u]
    assert all(type(x) is int for x in whole) and [whole.count(k) for k in (2, 3, 4, 5)] == [300] * 4
    counts = [[Range(1, 7, log=True, integer=True).at(x) for x in u].count(k) for k in range(1, 8)]
    np.testing.assert_allclose(counts, [1200 * math.log2((k + 1) / k) / 3 for k in range(1, 8)], atol=1)
    chosen = [Choices(["a", "b", "c"]).at(x) for x in u]
    assert [chosen.count(name) for name in "abc"] == [400] * 3
    assert Range(0.1, 0.3).at(0.0) == 0.1 and Range(0.1, 0.3).at(1 - 1e-16) == 0.3


def test_every_grid_point_meets_every_sampled_point() -> None:
    made = design(
        design="sobol", points=4, grid={"fiber": {"preset": ["blond", "black"]}, "bsdf.d_f": [0.6, 0.7]},
        space={"fiber.eta": {"low": 1.4, "high": 1.6}, "contexts.n": {"choices": [[0], [3]]}},
    )  # fmt: skip
    points = list(all_values(made))
    assert len(made) == len(points) == 16 and made.keys == ["fiber.preset", "bsdf.d_f", "fiber.eta", "contexts.n"]
    assert [p["bsdf.d_f"] for p in points] == [*[0.6] * 4, *[0.7] * 4] * 2
    assert [p["fiber.eta"] for p in points[:4]] * 4 == [p["fiber.eta"] for p in points]
    assert len({p["fiber.eta"] for p in points}) == 4


def test_elements_of_lists_are_swept_by_index_and_points_do_not_share_them() -> None:
    made = raw(design="random", points=3, space={"fiber.beta_deg.0": {"low": 3, "high": 20, "scale": "log"}})
    points = expand(made, validate(made))
    found = [point.config.fiber.beta_deg for point in points]
    assert all(beta[1:] == [3, 14] and 3 <= beta[0] <= 20 for beta in found) and len({b[0] for b in found}) == 3
    shared = Choices([[1.0, 2.0]])
    base = raw()
    first = at_point(base, {"contexts.n": "x"}, {"contexts.n": shared.values[0]})
    first.data["contexts"]["n"][0] = 9.0
    assert shared.values == [[1.0, 2.0]]


def test_run_takes_designs_too(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text(
        'kind = "sweep"\n[[methods]]\nname = "u"\nkind = "uniform"\n[sweep]\ndesign = "sobol"\npoints = 3\n'
        "[sweep.space]\nfiber.eta = { low = 1.4, high = 1.6 }\n"
    )
    found = load(tmp_path / "a.toml")
    assert [p.config.fiber.eta for p in found.points] == [p.values["fiber.eta"] for p in found.points]
    resolved = files.to_toml(found.config.model_dump(exclude_none=True))
    (tmp_path / "b.toml").write_text(resolved)
    assert load(tmp_path / "b.toml").points == found.points


ETA = {"low": 1.4, "high": 1.6}


@pytest.mark.parametrize(
    ("sweep", "parts"),
    [
        ({"design": "sobl"}, ["a.toml: sweep.design: got 'sobl'", "'sobol' (did you mean 'sobol'?)"]),
        ({"design": "sobol", "space": {"fiber.eta": ETA}}, ["sweep.points: got None", "a whole number >= 1"]),
        ({"design": "random", "points": 3}, ["sweep.space: got {}", "at least one key, as the design is 'random'"]),
        ({"space": {"fiber.eta": ETA}}, ["sweep.design: got 'grid'", "'random' or 'sobol'"]),
        ({"points": 3}, ["sweep.points: got 3", "nothing where the design is 'grid'"]),
        ({"design": "sobol", "points": 0}, ["sweep.points: got 0", ">= 1"]),
        ({"seed": -1}, ["sweep.seed: got -1", ">= 0"]),
        ({"grid": {"fiber": {"eta": 1.5}}}, ["sweep.grid.fiber.eta: got 1.5", "a list of values for fiber.eta"]),
        ({"grid": {"sweep.points": [1]}}, ["sweep.grid", "keys of what is computed"]),
    ],
    ids=str,
)
def test_what_is_refused(sweep: dict[str, Any], parts: list[str]) -> None:
    text = message(**sweep)
    assert all(part in text for part in parts), text


@pytest.mark.parametrize(
    ("axis", "key", "allowed"),
    [
        (1.5, "", "a table { low, high, scale, integer } or { choices = [...] }"),
        ({}, "", "a table { low, high"),
        ({"low": 1.4}, ".high", "a finite number (this key is required)"),
        ({"low": "a", "high": 2}, ".low", "a finite number"),
        ({"low": True, "high": 2}, ".low", "a finite number"),
        ({"low": 1.4, "high": math.inf}, ".high", "a finite number"),
        ({"low": 1.6, "high": 1.4}, ".high", "> low = 1.6"),
        ({"low": 1.4, "high": 1.4}, ".high", "> low = 1.4"),
        ({"low": 0.0, "high": 1.4, "scale": "log"}, ".low", "> 0, as the scale is 'log'"),
        ({"low": 1, "high": 2, "scale": "logg"}, ".scale", "one of 'linear', 'log'"),
        ({"low": 1.5, "high": 2, "integer": True}, ".low", "a whole number"),
        ({"low": 1, "high": 2, "integer": 1}, ".integer", "true or false"),
        ({"low": 1, "hihg": 2}, ".hihg", "(did you mean 'high'?)"),
        ({"choices": []}, ".choices", "a list of at least one value"),
        ({"choices": [1.5], "low": 1}, ".low", "one of the keys choices"),
    ],
    ids=str,
)
def test_axes_that_are_refused(axis: Any, key: str, allowed: str) -> None:
    text = message(design="random", points=2, space={"fiber.eta": axis})
    assert text.startswith(f'a.toml: sweep.space."fiber.eta"{key}: got ') and allowed in text, text


def test_keys_that_overlap_are_refused() -> None:
    space = {"fiber.eta": ETA}
    assert "apart from each other" in message(design="sobol", points=2, grid={"fiber.eta": [1.5]}, space=space)
    beta = {"contexts.n.0": {"low": 0, "high": 3}}
    assert "apart from each other" in message(design="sobol", points=2, grid={"contexts.n": [[1]]}, space=beta)


def test_a_point_that_is_not_allowed_names_file_key_and_value() -> None:
    made = raw(design="random", points=30, space={"fiber.eta": {"low": 0.5, "high": 2.0}})
    with pytest.raises(ConfigError, match=r"a\.toml \(sweep\.space\): fiber\.eta: got 0\.\d+; allowed: .* > 1"):
        expand(made, validate(made))
    made = raw(design="random", points=3, space={"fiber.beta_deg.5": {"low": 0.5, "high": 2.0}})
    with pytest.raises(ConfigError, match=r"fiber\.beta_deg\.5.*an index from 0 to 2"):
        expand(made, validate(made))


_NUMBERS = st.integers(-3, 20) | st.floats() | st.booleans() | st.text(max_size=3)
_AXIS = st.fixed_dictionaries(
    {},
    optional={
        "low": _NUMBERS, "high": _NUMBERS, "scale": st.sampled_from(["linear", "log", "x"]), "integer": _NUMBERS,
        "choices": st.lists(_NUMBERS, max_size=3),
    },
) | _NUMBERS  # fmt: skip
_KEY = st.sampled_from(["fiber.eta", "contexts.n.0", "contexts.n", "bsdf", "fiber.", "", "a.b.c", "sweep.seed"])
_SWEEP = st.fixed_dictionaries(
    {},
    optional={
        "design": st.sampled_from(["grid", "random", "sobol", "x"]), "points": st.integers(-1, 40) | _NUMBERS,
        "seed": _NUMBERS, "grid": st.dictionaries(_KEY, st.lists(_NUMBERS, max_size=3) | _NUMBERS, max_size=2),
        "space": st.dictionaries(_KEY | st.text(max_size=3), _AXIS | st.dictionaries(_KEY, _AXIS), max_size=3),
    },
)  # fmt: skip


@example({"design": "sobol", "points": 3, "space": {"fiber.eta": {"low": 1.4, "high": 1.6}}})
@example({"design": "random", "points": 3, "space": {"contexts": {"n.0": {"low": 0, "high": 9, "integer": True}}}})
@given(_SWEEP)
@fuzz(300)
def test_any_sweep_is_a_design_or_one_clear_error(sweep: dict[str, Any]) -> None:
    found = attempt(lambda: design(**sweep))
    if isinstance(found, InputError):
        assert str(found).startswith("a.toml")
        return
    assert len(found) == len({key: 0 for key in range(len(found))}) >= 1
    for number in {0, len(found) // 2, len(found) - 1}:
        values = found.values(number)
        assert list(values) == found.keys
        for key, axis in found.space.items():
            if isinstance(axis, Range):
                assert axis.low <= values[key] <= axis.high and isinstance(values[key], int) == axis.integer
            else:
                assert values[key] in axis.values
