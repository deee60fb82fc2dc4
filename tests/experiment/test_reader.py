"""Joining TOML files, overrides, and the errors on the way."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dsfit.experiment.reader import ConfigError, did_you_mean, parse_override, parse_value, read


def write(folder: Path, name: str, text: str) -> Path:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


def test_extends_merges_tables_and_replaces_lists(tmp_path: Path) -> None:
    write(tmp_path, "shared/base.toml", "[fiber]\npreset = 'brown'\neta = 1.5\n[contexts]\nn = [1, 2, 3]\n")
    path = write(tmp_path, "a.toml", "extends = 'shared/base.toml'\n[fiber]\neta = 1.6\n[contexts]\nn = [0]\n")
    raw = read(path)
    assert raw.data == {"fiber": {"preset": "brown", "eta": 1.6}, "contexts": {"n": [0]}}
    assert raw.source(("fiber", "eta")) == str(path)
    assert raw.source(("fiber", "preset")).endswith("shared/base.toml")


def test_extends_list_is_applied_in_order_and_diamonds_are_fine(tmp_path: Path) -> None:
    write(tmp_path, "root.toml", "title = 'root'\n[fiber]\neta = 1.1\n")
    write(tmp_path, "b.toml", "extends = 'root.toml'\n[fiber]\neta = 1.2\n")
    write(tmp_path, "c.toml", "extends = 'root.toml'\n[bsdf]\nd_f = 0.5\n")
    raw = read(write(tmp_path, "d.toml", "extends = ['b.toml', 'c.toml']\n"))
    # c comes after b and brings the root's value again: the later file wins.
    assert raw.data == {"title": "root", "fiber": {"eta": 1.1}, "bsdf": {"d_f": 0.5}}


def test_circle_is_named(tmp_path: Path) -> None:
    write(tmp_path, "a.toml", "extends = 'b.toml'\n")
    write(tmp_path, "b.toml", "extends = 'c.toml'\n")
    write(tmp_path, "c.toml", "extends = 'a.toml'\n")
    with pytest.raises(
        ConfigError, match=r"c\.toml: extends: got 'a\.toml -> b\.toml -> c\.toml -> a\.toml'; allowed: .*circle"
    ):
        read(tmp_path / "a.toml")


def test_a_table_of_another_kind_replaces_the_old_one(tmp_path: Path) -> None:
    write(tmp_path, "base.toml", "[light]\nkind = 'constant'\nradiance = 2.0\n")
    raw = read(write(tmp_path, "a.toml", "extends = 'base.toml'\n[light]\nkind = 'environment'\npath = 'x.exr'\n"))
    assert raw.data["light"] == {"kind": "environment", "path": "x.exr"}


@pytest.mark.parametrize(
    ("extends", "expected"),
    [
        ("3", "extends: got 3; allowed: a file name or a list"),
        ("['a', 3]", "extends: got ['a', 3]; allowed: a file name or a list"),
        ("''", "extends: got ''; allowed: a file name or a list"),
        ("'gone.toml'", "gone.toml'; allowed: a readable TOML file (No such file"),
    ],
)
def test_bad_extends(tmp_path: Path, extends: str, expected: str) -> None:
    path = write(tmp_path, "a.toml", f"extends = {extends}\n")
    with pytest.raises(ConfigError) as caught:
        read(path)
    assert expected in str(caught.value) and str(path) in str(caught.value)


@pytest.mark.parametrize("content", [b"a = \xff", b"a = ", b"[a\n", b"a = 1\na = 2\n", b"\x00", b"x = " + b"[" * 5000])
def test_damaged_files_give_one_error_with_the_file_name(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "a.toml"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match=r"a\.toml: \(file\): got .*; allowed: (valid TOML|text in UTF-8)"):
        read(path)


def test_tables_nested_without_end_and_endless_numbers(tmp_path: Path) -> None:
    path = write(tmp_path, "a.toml", ".".join(["a"] * 3000) + " = 1\n")
    with pytest.raises(ConfigError, match=r"a\.toml: .*a few levels of tables"):
        read(path)
    with pytest.raises(ConfigError, match="too long to show"):
        raise read(write(tmp_path, "b.toml", "x = 0x" + "f" * 5000)).error(("x",), "less")


def test_missing_file_and_folder(tmp_path: Path) -> None:
    for path in (tmp_path / "none.toml", tmp_path, tmp_path / "x\0y"):
        with pytest.raises(ConfigError, match="readable TOML file"):
            read(path)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1", 1),
        ("1.5", 1.5),
        ("true", True),
        ("[1, 2]", [1, 2]),
        ("'x'", "x"),
        ("{ a = 1 }", {"a": 1}),
        ("blond", "blond"),
    ]
    + [("", ""), ("a=b", "a=b"), ("1\nb = 2", "1\nb = 2"), (" spaced ", "spaced")],
)
def test_values_are_toml_or_else_strings(text: str, value: object) -> None:
    assert parse_value(text) == value


def test_set_reaches_into_tables_and_lists(tmp_path: Path) -> None:
    path = write(tmp_path, "a.toml", "[[methods]]\nname = 'a'\n[[methods]]\nname = 'b'\n")
    raw = read(path, ["methods.1.name=c", "fiber.eta=1.4", 'sweep.grid."fiber.eta"=[1.2]', "contexts.n=[0, 3]"])
    assert raw.data["methods"] == [{"name": "a"}, {"name": "c"}]
    assert raw.data["fiber"] == {"eta": 1.4}
    assert raw.data["sweep"] == {"grid": {"fiber.eta": [1.2]}}
    assert raw.source(("fiber", "eta")) == "--set"
    assert raw.source(("methods", 0, "name")) == str(path)


def test_setting_a_table_keeps_what_it_does_not_mention(tmp_path: Path) -> None:
    path = write(tmp_path, "a.toml", "[fiber]\neta = 1.4\npreset = 'brown'\n")
    raw = read(path, ["fiber={ eta = 1.7 }"])
    assert raw.data["fiber"] == {"eta": 1.7, "preset": "brown"}
    assert raw.source(("fiber", "preset")) == str(path)


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("fiber.eta", "--set: (key): got 'fiber.eta'; allowed: key=value"),
        ("=3", "allowed: key=value"),
        ("a b=3", "allowed: key=value"),
        ("a..b=3", "allowed: key=value"),
        ("methods.7.name=x", "--set: methods.7: got '7'; allowed: an index from 0 to 0 into methods"),
        ("methods.first.name=x", "an index from 0 to 0"),
        ("title.x=1", "--set: title.x: got 't'; allowed: title is a value, not a table"),
    ],
)
def test_bad_overrides(tmp_path: Path, override: str, expected: str) -> None:
    path = write(tmp_path, "a.toml", "title = 't'\n[[methods]]\nname = 'a'\n")
    with pytest.raises(ConfigError) as caught:
        read(path, [override])
    assert expected in str(caught.value)


def test_did_you_mean() -> None:
    assert did_you_mean("etaa", ["eta", "beta_deg"]) == " (did you mean 'eta'?)"
    assert did_you_mean("zzz", ["eta"]) == ""


@settings(deadline=None, max_examples=200)
@given(st.text(max_size=40))
def test_any_override_is_parsed_or_refused_clearly(text: str) -> None:
    try:
        parts, _ = parse_override(text)
    except ConfigError as error:
        assert str(error).startswith("--set: ")
    else:
        assert parts


@settings(deadline=None, max_examples=200)
@given(st.binary(max_size=60))
def test_any_bytes_are_read_or_refused_clearly(tmp_path_factory: pytest.TempPathFactory, content: bytes) -> None:
    path = tmp_path_factory.mktemp("fuzz") / "a.toml"
    path.write_bytes(content)
    try:
        raw = read(path)
    except ConfigError as error:
        assert "a.toml" in str(error) and "allowed:" in str(error)
    else:
        assert isinstance(raw.data, dict)
