"""Every wrong config is one error that names file, key, value and what is allowed."""

from __future__ import annotations

import copy
import tomllib
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dsfit.experiment import files
from dsfit.experiment.reader import ConfigError, RawConfig
from dsfit.experiment.schema import Config
from dsfit.experiment.validation import expand, load, validate

UNIFORM = {"name": "uniform", "kind": "uniform"}


def raw(**data: Any) -> RawConfig:
    return RawConfig("a", "a.toml", {"methods": [UNIFORM], **data})


def message(**data: Any) -> str:
    with pytest.raises(ConfigError) as caught:
        made = raw(**data)
        expand(made, validate(made))
    return str(caught.value)


@pytest.mark.parametrize(
    ("data", "parts"),
    [
        ({"fiber": {"etaa": 1.6}}, ["a.toml: fiber.etaa: got 1.6", "one of the keys preset", "did you mean 'eta'?"]),
        ({"fibre": {}}, ["a.toml: fibre: got {}", "did you mean 'fiber'?"]),
        ({"fiber": {"eta": "x"}}, ["fiber.eta: got 'x'", "a finite number > 1"]),
        ({"fiber": {"eta": 1.0}}, ["fiber.eta: got 1.0", "> 1"]),
        ({"fiber": {"eta": True}}, ["fiber.eta: got True"]),
        ({"fiber": {"eta": float("nan")}}, ["fiber.eta: got nan", "finite"]),
        ({"fiber": {"eta": 10**400}}, ["fiber.eta: got 1000"]),
        (
            {"fiber": {"preset": "blonde"}},
            ["fiber.preset: got 'blonde'", "'nonabsorbing', 'blond'", "did you mean 'blond'?"],
        ),
        ({"fiber": {"alpha_deg": [1, 2]}}, ["fiber.alpha_deg: got [1, 2]", "a list of 3 elements"]),
        ({"fiber": {"beta_deg": [1, 2, -3]}}, ["fiber.beta_deg.2: got -3", "> 0"]),
        ({"fiber": {"eccentricity": 0.5}}, ["fiber.eccentricity: got 0.5", "> 0.707107 and < 1.41421"]),
        ({"bsdf": {"convention": "print"}}, ["bsdf.convention: got 'print'", "'consistent', 'printed'"]),
        (
            {"bsdf": {"convention": {"base": "printed", "lobe_nrm": 1}}},
            ["bsdf.convention.lobe_nrm: got 1", "'lobe_norm'"],
        ),
        ({"bsdf": {"convention": {"lobe_norm": "x"}}}, ["bsdf.convention.lobe_norm: got 'x'", "'energy', 'printed'"]),
        ({"bsdf": {"convention": 3}}, ["bsdf.convention: got 3", "a string, or a table"]),
        ({"bsdf": {"d_f": 1.5}}, ["bsdf.d_f: got 1.5", ">= 0 and <= 1"]),
        ({"light": {"kind": "lamp"}}, ["light.kind: got 'lamp'", "'constant', 'lobes', 'environment'"]),
        ({"light": {"radiance": 2}}, ["light.kind: got None", "'constant', 'lobes', 'environment'"]),
        ({"light": 3}, ["light: got 3", "a table with kind"]),
        ({"light": {"kind": "lobes", "lobes": [{"theta_deg": 1, "width_degg": 3}]}}, ["light.lobes.0.width_deg"]),
        ({"light": {"kind": "lobes", "lobes": [{"theta_deg": 1, "width_deg": 3}, 4]}}, ["light.lobes.1: got 4"]),
        (
            {"light": {"kind": "constant", "radiance": [-1.0]}},
            ["light.radiance: got [-1.0]", "a finite number >= 0, or a list"],
        ),
        ({"light": {"kind": "environment", "path": "gone.exr"}}, ["a.toml: light.path: got ", "gone.exr"]),
        (
            {"scattering": {"kind": "slab", "thickness": 1.0, "depth": 2.0, "density": 1.0}},
            ["scattering.depth: got 2.0"],
        ),
        ({"scattering": {"kind": "sphere", "radius": 1.0}}, ["scattering.density: got None", "this key is required"]),
        ({"contexts": {"theta_r_deg": [0, 91]}}, ["contexts.theta_r_deg.1: got 91", ">= -90 and <= 90"]),
        ({"contexts": {"n": []}}, ["contexts.n: got []", "at least one element"]),
        ({"contexts": {"n": [0, 1], "theta_r_deg": [0, 1, 2], "combine": "zip"}}, ["contexts.combine", "equal length"]),
        ({"contexts": {"n": [1] * 1000, "theta_r_deg": [1] * 1000}}, ["contexts: got", "at most 100000"]),
        ({"methods": []}, ["methods: got []", "at least one [[methods]]"]),
        ({"methods": [UNIFORM, UNIFORM]}, ["methods.1.name: got 'uniform'", "differ"]),
        ({"methods": [UNIFORM, {**UNIFORM, "name": "uniform "}]}, ["methods.1.name: got 'uniform '", "differ"]),
        ({"bsdf": {"precision": "table"}, "fiber": {"eccentricity": 0.9}}, ["bsdf.precision: got 'table'"]),
        ({"methods": [{"kind": "uniform"}]}, ["methods.0.name: got None", "this key is required"]),
        ({"methods": [{"name": "a", "kind": "single", "proposal": "M_X"}]}, ["methods.0.proposal: got 'M_X'", "M_R"]),
        (
            {"methods": [{"name": "a", "kind": "heuristic_mix", "proposals": ["R", "Q"]}]},
            ["methods.0.proposals.1: got 'Q'"],
        ),
        (
            {"methods": [{"name": "a", "kind": "heuristic_mix", "proposals": ["R"], "weights": [1, 2]}]},
            ["methods.0.weights: got [1, 2]", "1 numbers"],
        ),
        (
            {"methods": [{"name": "a", "kind": "heuristic_mix", "weights": "bst"}]},
            ["methods.0.weights: got 'bst'", "did you mean 'best'?"],
        ),
        (
            {"methods": [{"name": "a", "kind": "heuristic_mix", "heuristic": {"kind": "power", "beta": -1}}]},
            ["methods.0.heuristic", "> 0"],
        ),
        (
            {"methods": [{"name": "a", "kind": "fitted", "solver": "lm"}]},
            ["methods.0.solver: got 'lm'", "'optimistix.lm'"],
        ),
        ({"methods": [{"name": "a/b", "kind": "uniform"}]}, ["methods.0.name: got 'a/b'"]),
        ({"estimate": {"seed": -1}}, ["estimate.seed: got -1", "a whole number >= 0"]),
        ({"estimate": {"seed": 1.5}}, ["estimate.seed: got 1.5", "a whole number"]),
        ({"estimate": {"dtype": "float16"}}, ["estimate.dtype: got 'float16'", "'float32', 'float64'"]),
        ({"kind": "sweep"}, ["sweep.grid", "at least one dotted key"]),
        ({"sweep": {"grid": {"fiber.eta": 1.5}}}, ["sweep.grid", "a list of values for fiber.eta"]),
        ({"sweep": {"grid": {"fiber.eta": [1.5, 0.5]}}}, ["fiber.eta: got 0.5", "(sweep.grid)"]),
        ({"sweep": {"grid": {"output.dir": ["x"]}}}, ["sweep.grid", "keys of what is computed"]),
        ({"sweep": {"grid": {"contexts.n": [[1]] * 1000, "fiber.eta": [1.5] * 1000}}}, ["at most", "1000000"]),
        ({"transmittance": {"n": [0]}}, ["transmittance.n.0: got 0", ">= 1"]),
        ({"output": {"plots": "yes"}}, ["output.plots: got 'yes'", "true or false"]),
    ],
    ids=lambda x: str(x)[:50] if isinstance(x, dict) else "",
)  # fmt: skip
def test_wrong_values(data: dict[str, Any], parts: list[str]) -> None:
    text = message(**data)
    assert all(part in text for part in parts), text


def test_all_problems_are_listed_the_first_first() -> None:
    lines = message(fiber={"eta": 0.5, "glint": 1}, bsdf={"d_f": 2}).splitlines()
    assert len(lines) == 3 and lines[0].startswith("a.toml: fiber.eta: got 0.5")


def test_the_file_that_wrote_the_value_is_named(tmp_path: Path) -> None:
    (tmp_path / "base.toml").write_text("[fiber]\neta = 0.5\n[[methods]]\nname = 'u'\nkind = 'uniform'\n")
    (tmp_path / "a.toml").write_text("extends = 'base.toml'\n[bsdf]\nd_f = 0.5\n")
    with pytest.raises(ConfigError, match=r"base\.toml: fiber\.eta: got 0\.5"):
        load(tmp_path / "a.toml")
    with pytest.raises(ConfigError, match=r"--set: fiber\.eta: got 0\.9"):
        load(tmp_path / "a.toml", ["fiber.eta=0.9"])
    assert load(tmp_path / "a.toml", ["fiber.eta=1.9"]).config.fiber.eta == 1.9


def test_paths_are_relative_to_the_file_that_names_them(tmp_path: Path) -> None:
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub/base.toml").write_text("[light]\nkind = 'environment'\npath = 'x.exr'\n")
    (tmp_path / "a.toml").write_text("extends = 'sub/base.toml'\n[[methods]]\nname = 'u'\nkind = 'uniform'\n")
    with pytest.raises(ConfigError) as caught:
        load(tmp_path / "a.toml")
    assert str(tmp_path / "sub" / "x.exr") in str(caught.value)


def test_a_grid_is_all_combinations_and_each_is_validated() -> None:
    made = raw(sweep={"grid": {"fiber": {"preset": ["blond", "black"]}, "contexts.n": [[0], [3], [5]]}})
    points = expand(made, validate(made))
    assert [(p.config.fiber.preset, p.config.contexts.n) for p in points][1:4] == [
        ("blond", [3]),
        ("blond", [5]),
        ("black", [0]),
    ]
    assert points[5].values == {"fiber.preset": "black", "contexts.n": [5]}


def test_a_resolved_config_reads_back_as_itself(tmp_path: Path) -> None:
    made = raw(
        fiber={"preset": "brown", "beta_deg": [5, 6, 7]},
        light={"kind": "lobes", "lobes": [{"theta_deg": 30, "width_deg": 5, "intensity": [1, 2, 3]}]},
        sweep={"grid": {"fiber.eta": [1.4, 1.5]}},
        bsdf={"convention": {"base": "printed", "lobe_norm": "energy"}},
    )
    config = validate(made)
    (tmp_path / "config.toml").write_text(files.to_toml(config.model_dump(exclude_none=True)))
    assert load(tmp_path / "config.toml").config == config


def test_defaults_are_a_valid_config() -> None:
    assert validate(raw()) == Config(methods=[UNIFORM])


_LEAVES = (
    st.none()
    | st.booleans()
    | st.integers(-5, 100)
    | st.floats()
    | st.text(max_size=5)
    | st.sampled_from(["constant", "lobes"])
)
_ANY = st.recursive(
    _LEAVES, lambda x: st.lists(x, max_size=3) | st.dictionaries(st.text(max_size=5), x, max_size=3), max_leaves=8
)
_SECTIONS = list(Config.model_fields)


def _mutations() -> st.SearchStrategy[tuple[list[str], Any]]:
    known = {
        name: list(getattr(type(field.default), "model_fields", [])) for name, field in Config.model_fields.items()
    }
    key = st.sampled_from(_SECTIONS).flatmap(
        lambda s: st.just([s]) | st.sampled_from([*known[s], "kind", "lobes", "other"]).map(lambda k: [s, k])
    )
    return st.tuples(key, _ANY)


@settings(deadline=None, max_examples=300)
@given(st.lists(_mutations(), min_size=1, max_size=4))
def test_any_tables_are_a_config_or_one_clear_error(mutations: list[tuple[list[str], Any]]) -> None:
    made = raw()
    for key, value in mutations:
        target = made.data
        for part in key[:-1]:
            target = target[part] if isinstance(target.get(part), dict) else target.setdefault(part, {})
            if not isinstance(target, dict):
                break
        if isinstance(target, dict):
            target[key[-1]] = copy.deepcopy(value)
    try:
        points = expand(made, validate(made))
    except ConfigError as error:
        assert str(error).startswith("a.toml") and "allowed: " in str(error)
    else:
        for point in points:
            again = tomllib.loads(files.to_toml(point.config.model_dump(exclude_none=True)))
            assert Config.model_validate(again) == point.config
