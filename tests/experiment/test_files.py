"""Whole files or none, and damage that is named."""

from __future__ import annotations

import math
import os
import tomllib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dsfit.errors import InputError
from dsfit.experiment import files

_NAMES = st.text(max_size=8)
_SCALARS = (
    st.text(max_size=8)
    | st.booleans()
    | st.integers(-(2**62), 2**62)
    | st.floats(allow_nan=False, allow_infinity=False)
)
_VALUES = st.recursive(
    _SCALARS | st.lists(_SCALARS, max_size=3), lambda x: st.dictionaries(_NAMES, x, max_size=3), max_leaves=12
)


def test_a_write_that_fails_leaves_the_old_file_and_no_litter(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "x.json"
    files.write_json(path, {"schema_version": 1, "a": 1})

    def fail(*_: object) -> None:
        raise OSError("disk full")

    for name in ("replace", "fsync"):
        with monkeypatch.context() as patch:
            patch.setattr(os, name, fail)
            with pytest.raises(OSError, match="disk full"):
                files.write_json(path, {"schema_version": 1, "a": 2})
        assert files.read_json(path, 1)["a"] == 1
        assert [p.name for p in tmp_path.iterdir()] == ["x.json"]


def test_json_keeps_infinities_apart_from_text(tmp_path: Path) -> None:
    files.write_json(
        tmp_path / "x.json", {"schema_version": 1, "a": [math.inf, math.nan, np.float64(2.5)], "b": (1, 2)}
    )
    data = files.read_json(tmp_path / "x.json", 1)
    assert [files.number(x) for x in data["a"]][::2] == [math.inf, 2.5] and math.isnan(files.number(data["a"][1]))
    assert data["b"] == [1, 2] and math.isnan(files.number(None))


@pytest.mark.parametrize(
    "content", [b"", b"{", b"[]", b"\xff", b'{"schema_version": 2}', b'{"schema_version": true}', b"[" * 100000]
)
def test_damaged_json(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "x.json").write_bytes(content)
    with pytest.raises(InputError, match=r"x\.json: got .*schema version 1"):
        files.read_json(tmp_path / "x.json", 1)


def test_every_truncation_of_an_array_file_is_an_input_error(tmp_path: Path) -> None:
    path = tmp_path / "x.npz"
    files.write_arrays(path, {"a": np.arange(50.0), "b": np.zeros((0, 3), dtype=np.float32)})
    whole = path.read_bytes()
    back = files.read_arrays(path)
    assert back["a"].tolist() == list(range(50)) and back["b"].shape == (0, 3)
    for length in range(0, len(whole), 7):
        path.write_bytes(whole[:length])
        with pytest.raises(InputError, match=r"x\.npz"):
            files.read_arrays(path)


def test_arrays_of_objects_are_not_unpickled(tmp_path: Path) -> None:
    np.savez(tmp_path / "x.npz", a=np.array([{"evil": 1}], dtype=object))
    with pytest.raises(InputError, match="damaged"):
        files.read_arrays(tmp_path / "x.npz")


@given(st.dictionaries(_NAMES, _VALUES, max_size=5))
def test_toml_comes_back_as_it_was(data: dict[str, object]) -> None:
    assert tomllib.loads(files.to_toml(data)) == data


def test_toml_of_lists_of_tables_and_left_out_keys() -> None:
    data = {"methods": [{"name": "a", "weights": [1, 2.0]}, {"name": "b", "x": None}], "sweep": {"grid": {"a.b": [1]}}}
    text = files.to_toml(data)
    assert tomllib.loads(text) == {
        "methods": [{"name": "a", "weights": [1, 2.0]}, {"name": "b"}],
        "sweep": {"grid": {"a.b": [1]}},
    }
