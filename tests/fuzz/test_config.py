"""Configs: any bytes, TOML or damage to a valid config give a config or one error naming file, key and value."""

from __future__ import annotations

import copy
import tempfile
from pathlib import Path
from typing import Any

from hypothesis import example, given
from hypothesis import strategies as st

from dsfit.errors import InputError
from dsfit.experiment import files
from dsfit.experiment.reader import COMMAND_LINE, ConfigError
from dsfit.experiment.schema import Config
from dsfit.experiment.validation import Experiment, load
from tests.fuzz.common import fuzz, listing

FULL: dict[str, Any] = {
    "title": "t",
    "kind": "compare",
    "fiber": {
        "preset": "brown",
        "sigma_a": [0.1, 0.2, 0.3],
        "eta": 1.5,
        "alpha_deg": [-7, 3, 11],
        "beta_deg": [7, 4, 15],
        "eccentricity": 1.0,
        "caustic_width_deg": 15.0,
        "glint_scale": 0.8,
        "caustic_fade": 0.3,
        "caustic_max_offset": 0.5,
        "gamma_tt_deg": 30.0,
    },
    "bsdf": {
        "d_f": 0.7,
        "d_b": 0.6,
        "azimuthal": "marschner",
        "convention": {"base": "printed", "lobe_norm": "energy", "density_power": 2},
        "precision": "auto",
    },
    "light": {
        "kind": "lobes",
        "ambient": 0.1,
        "lobes": [{"theta_deg": 30, "phi_deg": 10, "width_deg": 5, "intensity": [1, 2, 3]}],
    },
    "scattering": {
        "kind": "slab",
        "thickness": 2.0,
        "depth": 1.0,
        "density": 3.0,
        "normal": [0, 1, 0],
        "v": "poisson",
        "aligned": False,
        "max_n": 50.0,
        "hint": "mean",
    },
    "contexts": {"theta_r_deg": [0, 45], "phi_r_deg": [0], "n": [0, 3], "v": [0.5], "combine": "product"},
    "methods": [
        {"name": "uniform", "kind": "uniform"},
        {"name": "light", "kind": "light"},
        {"name": "one", "kind": "single", "proposal": "R", "defensive": 0.1},
        {
            "name": "mix",
            "kind": "heuristic_mix",
            "proposals": ["R", "TT"],
            "weights": [1, 2],
            "heuristic": {"kind": "power", "beta": 2.0},
            "model": "one",
        },
        {
            "name": "fit",
            "kind": "fitted",
            "solver": "optimistix.lm",
            "objective": "excess",
            "starts": 1,
            "defensive": 0.001,
            "max_steps": 3,
        },
    ],
    "estimate": {
        "samples": [16],
        "repeats": 2,
        "rounds": 1,
        "uniforms": "sobol",
        "seed": 3,
        "dtype": "float32",
        "rtol": 1e-3,
    },
    "output": {"dir": "runs", "plots": False, "maps": 0},
    "sweep": {"grid": {"fiber.eta": [1.4, 1.5]}},
    "transmittance": {"n": [1, 2]},
    "check": {
        "suites": ["chi_square", "furnace"],
        "level": 0.01,
        "proposals": ["R", "uniform"],
        "saved": [],
        "user": [],
        "chi_square": {"samples": 1000, "cells": [4, 4]},
        "stability": {"functions": "all", "digits": 50},
    },
}


def _paths(value: Any, prefix: tuple[str | int, ...] = ()) -> list[tuple[str | int, ...]]:
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [p for key, inner in items for p in [(*prefix, key), *_paths(inner, (*prefix, key))]]


WORDS = [
    "constant",
    "lobes",
    "environment",
    "sphere",
    "compare",
    "check",
    "sweep",
    "transmittance",
    "all",
    "chapter",
    "best",
    "optimal",
    "TT",
    "MG_R",
    "back",
    "fitted",
    "structured",
    "kind",
    "fiber.eta",
    "torch.adam",
    "raw",
    "printed",
    "exact",
    "table",
    "",
    "ü\u202e\x00",
    "a" * 70,
    "../x",
    "inf",
    ".",
]
leaves = (
    st.sampled_from(WORDS)
    | st.text(max_size=4)
    | st.booleans()
    | st.integers(-3, 100)
    | st.floats()
    | st.sampled_from([10**18, -(2**63), 2**64, 10**400, 1e308, -1e308, 5e-324, 0.0, 1e-9])
)
trees = st.recursive(
    leaves,
    lambda x: st.lists(x, max_size=3) | st.dictionaries(st.sampled_from(WORDS) | st.text(max_size=4), x, max_size=3),
    max_leaves=6,
)
edits = st.lists(
    st.tuples(
        st.sampled_from(_paths(FULL)),
        st.sampled_from(["replace", "replace", "delete", "add", "wrap", "repeat"]),
        trees,
        st.sampled_from(WORDS),
    ),
    min_size=1,
    max_size=3,
)


def damaged(changes: list[tuple[tuple[str | int, ...], str, Any, str]]) -> dict[str, Any]:
    """`FULL` with values replaced, deleted, wrapped in lists, repeated, and unknown keys added."""
    data = copy.deepcopy(FULL)
    for path, how, value, word in changes:
        target: Any = data
        for part in path[:-1]:
            known = (
                isinstance(target, dict) and part in target or isinstance(target, list) and part in range(len(target))
            )
            target = target[part] if known else None
        last = path[-1]
        if not (isinstance(target, dict) and last in target or isinstance(target, list) and last in range(len(target))):
            continue
        if how == "replace":
            target[last] = value
        elif how == "delete":
            del target[last]
        elif how == "add" and isinstance(target[last], dict):
            target[last][word] = value
        elif how == "wrap":
            target[last] = [target[last]]
        elif how == "repeat" and isinstance(target[last], list):
            target[last] = target[last] * 3
    return data


def check(error: InputError, *sources: Path | str) -> None:
    """A `ConfigError` that says where, what and what else."""
    assert isinstance(error, ConfigError), type(error)
    text = str(error)
    assert any(text.startswith(str(source)) for source in (*sources, COMMAND_LINE)), text
    assert "got " in text and "allowed: " in text and error.field
    assert max(map(len, text.splitlines())) < 2000, text


def tried(text: bytes, overrides: list[str] = (), more: dict[str, bytes] | None = None) -> Experiment | None:
    """Load a config of these bytes; the folder is as before."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "a.toml").write_bytes(text)
        for other, content in (more or {}).items():
            (folder / other).write_bytes(content)
        before = listing(folder)
        try:
            return load(folder / "a.toml", overrides)
        except InputError as error:
            check(error, folder)
            return None
        finally:
            assert listing(folder) == before


def test_the_full_config_is_valid() -> None:
    found = tried(files.to_toml(FULL).encode())
    assert found is not None and len(found.points) == 2


@fuzz(90)
@given(edits)
def test_damaged_configs(changes: list[Any]) -> None:
    data = damaged(changes)
    if (found := tried(files.to_toml(data).encode())) is not None:
        for point in found.points[:3]:
            text = files.to_toml(point.config.model_dump(exclude_none=True))
            again = tried(text.encode())
            assert again is not None and again.config == point.config


@fuzz(100)
@given(
    st.sampled_from([list(Config.model_fields), WORDS]).flatmap(
        lambda names: st.dictionaries(st.sampled_from(names), trees, max_size=4)
    )
)
def test_any_tables(data: dict[str, Any]) -> None:
    tried(files.to_toml(data).encode())


fragments = st.lists(
    st.sampled_from(
        [
            "[fiber]\n",
            "eta = 1.5\n",
            "[[methods]]\n",
            "name = 'u'\n",
            "kind = 'uniform'\n",
            "[sweep.grid]\n",
            "a.b.c = 1\n",
            '"fiber.eta" = [1.4]\n',
            "x = {a = 1}\n",
            "x = '''\n",
            "x = nan\n",
            "x = -inf\n",
            "x = 0x" + "f" * 5000 + "\n",
            "d = 1979-05-27T07:32:00Z\n",
            "t = 07:32:00\n",
            "[" * 200,
            "]" * 200,
            "{" * 200,
            "x = [" * 300,
            "\ufeff",
            "\x00",
            "=",
            '"\\u',
            "\\",
            "kind = 'check'\n",
            "[check]\n",
            "suites = ['chi_square']\n",
            "extends = 'a.toml'\n",
            "extends = ['b.toml', 3]\n",
            "extends = '\\u0000'\n",
            "extends = '/'\n",
            "extends = '" + "x" * 5000 + "'\n",
        ]
    )
    | st.text(max_size=6),
    max_size=8,
)


@fuzz(150)
@given(fragments)
def test_any_text(parts: list[str]) -> None:
    tried("".join(parts).encode("utf-8", "surrogatepass"))


@fuzz(100)
@given(st.binary(max_size=40), st.integers(0, 2000), st.integers(0, 8))
def test_any_bytes(noise: bytes, position: int, cut: int) -> None:
    tried(noise)
    whole = files.to_toml(FULL).encode()
    tried(whole[:position] + noise + whole[position + cut :])


@fuzz(60)
@given(
    st.lists(
        st.lists(
            st.sampled_from(["a.toml", "b.toml", "c.toml", "./a.toml", "gone.toml", "", ".", "..", "b.toml/"]),
            max_size=2,
        ),
        min_size=3,
        max_size=3,
    )
)
def test_extends_in_any_shape(graph: list[list[str]]) -> None:
    text = [f"extends = {names!r}\n".encode() for names in graph]
    tried(text[0], more={"b.toml": text[1], "c.toml": text[2]})


keys = st.sampled_from(
    [".".join(map(str, p)) for p in _paths(FULL)] + ["methods.9.name", "a", "fiber.x.y", "", ".", "a b"]
)
settings_ = st.lists(
    st.text(max_size=12)
    | st.tuples(
        keys,
        st.sampled_from(
            [
                "1",
                "-1",
                "nan",
                "[1]",
                "[]",
                "{}",
                "{ a = 1 }",
                "true",
                "x",
                "'",
                "[" * 2000,
                "9" * 5000,
                "1e999",
                "0x",
                "\n",
            ]
        )
        | st.text(max_size=6),
    ).map("=".join),
    min_size=1,
    max_size=3,
)


@fuzz(150)
@given(settings_)
@example(["fiber.eta=1.6", "methods.0.name=x"])
def test_any_overrides(overrides: list[str]) -> None:
    tried(files.to_toml(FULL).encode(), overrides)
