"""Planted deviations are found, whatever kind of rule holds the value; what agrees passes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import norm
from typer.testing import CliRunner

from dsfit.figures import Close, Data, Estimate, Exact, Measured, agreement
from dsfit.figures.catalogue import find
from dsfit.figures.command import app
from dsfit.figures.data import read_data, write_data
from dsfit.figures.make import make
from dsfit.figures.verify import bound_of, compare, error_name, matches, rules_of

RULES = {
    "close": Close(1e-6),
    "near": Close(0.0, 1e-3),
    "*.mean": Estimate("*.se"),
    "seconds": Measured(),
    "rows.*.t": Measured(),
    "exact": Exact(),
}


def data(**changes) -> Data:
    """Reference data, with changes of arrays or of the record."""
    generator = np.random.default_rng(3)
    arrays = {
        "close": np.linspace(1.0, 2.0, 12).reshape(3, 4),
        "near": np.array([0.0, 1.0, np.nan, np.inf]),
        "a.mean": 10 + generator.normal(size=50),
        "a.se": np.full(50, 1.0),
        "exact": np.arange(5),
        "plain": np.array([0.1, np.nan]),
        "words": np.array(["x", "y"]),
    }
    record = {"seconds": 3.0, "rows": [{"t": 1.0, "name": "one"}, {"t": 2.0, "name": "two"}], "count": 5}
    record["b"] = {"mean": [5.0, 7.0], "se": [0.5, 0.5]}
    for name, value in changes.items():
        name = name.replace("__", ".")
        if value is None:
            (arrays if name in arrays else record).pop(name)
        elif isinstance(value, np.ndarray):
            arrays[name] = value
        else:
            record[name] = value
    return Data(arrays, record)


def verdict(**changes) -> dict:
    return compare(data(**changes), data(), RULES)


def test_the_same_data_agree_with_every_value_counted():
    found = verdict()
    assert found["verdict"] == "agrees" and found["worst"]["deviation"] == 0
    assert found["compared"] == {"close": 16, "estimate": 52, "standard error": 52, "exact": 12, "measured": 3}
    assert found["deviating"] == {}


def with_one(values: np.ndarray, index: tuple[int, ...], value: float) -> np.ndarray:
    values = values.copy()
    values[index] = value
    return values


CLOSE, MEAN = data().arrays["close"], data().arrays["a.mean"]


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("close", {"close": with_one(CLOSE, (1, 2), CLOSE[1, 2] * (1 + 2e-6))}),
        ("close", {"close": with_one(CLOSE, (1, 2), np.nan)}),
        ("close", {"close": with_one(CLOSE, (1, 2), np.inf)}),
        ("close", {"close": CLOSE.ravel()}),
        ("close", {"close": CLOSE[:0]}),
        ("close", {"close": CLOSE.astype("U")}),
        ("near", {"near": np.array([0.0011, 1.0, np.nan, np.inf])}),
        ("near", {"near": np.array([0.0, 1.0, 2.0, np.inf])}),
        ("near", {"near": np.array([0.0, 1.0, np.nan, -np.inf])}),
        ("a.mean", {"a__mean": with_one(MEAN, (7,), MEAN[7] + 6.0)}),
        ("a.mean", {"a__mean": with_one(MEAN, (7,), np.nan)}),
        ("a.mean", {"a__mean": MEAN[:49], "a__se": np.full(49, 1.0)}),
        ("a.mean", {"a__se": np.full(50, 6.0)}),
        ("a.mean", {"a__se": with_one(np.full(50, 1.0), (3,), np.nan)}),
        ("a.mean", {"a__se": with_one(np.full(50, 1.0), (3,), -1.0)}),
        ("a.mean", {"a__se": None}),
        ("b.mean", {"b": {"mean": [5.0, 12.0], "se": [0.5, 0.5]}}),
        ("b.mean", {"b": {"mean": [5.0, "nan"], "se": [0.5, 0.5]}}),
        ("exact", {"exact": np.array([0, 1, 2, 3, 5])}),
        ("exact", {"exact": np.arange(5.0)}),
        ("plain", {"plain": np.array([np.nextafter(0.1, 1), np.nan])}),
        ("plain", {"plain": np.array([0.1, 0.0])}),
        ("words", {"words": np.array(["x", "z"])}),
        ("count", {"count": 6}),
        ("count", {"count": 5.0}),
        ("rows.1.name", {"rows": [{"t": 1.0, "name": "one"}, {"t": 2.0, "name": "three"}]}),
        ("rows.1.name", {"rows": [{"t": 1.0, "name": "one"}]}),
        ("close", {"close": None}),
        ("seconds", {"seconds": None}),
        ("extra", {"extra": np.zeros(2)}),
        ("extra", {"extra": "more"}),
    ],
)
def test_planted_deviations_are_found_where_they_are(name: str, changes: dict):
    found = verdict(**changes)
    assert found["verdict"] == "deviates" and name in found["deviating"]
    assert found["worst"]["deviation"] > 1


def test_what_the_rules_allow_passes():
    generator = np.random.default_rng(4)
    found = verdict(
        close=CLOSE * (1 + 0.9e-6),
        near=np.array([0.0009, 1.0, np.nan, np.inf]),
        a__mean=MEAN + generator.normal(size=50),
        a__se=np.full(50, 1.2),
        seconds=60.0,
    )
    assert found["verdict"] == "agrees", found["deviating"]
    assert 0.8 < found["worst"]["deviation"] < 1
    assert found["measured"]["seconds"] == "20 times"


def test_seconds_are_told_but_held_to_nothing():
    found = verdict(seconds=3e9, rows=[{"t": 5.0, "name": "one"}, {"t": 0.5, "name": "two"}])
    assert found["verdict"] == "agrees" and found["measured"]["rows.0.t"] == "5 times"


def test_honest_estimates_deviate_once_in_a_hundred_times():
    """Over 40 estimates and 2000 experiments: 20 expected, standard deviation 4.4."""
    generator, old = np.random.default_rng(5), np.full(40, 100.0)
    bound = bound_of({"m": old}, {"m": (Estimate("s"), "m")})
    assert 1 - (1 - 2 * norm.sf(bound)) ** 40 == pytest.approx(0.01)
    wrong = 0
    for _ in range(2000):
        a, b = 100 + generator.normal(size=(2, 40))
        wrong += not agreement.estimate(a, b, (np.ones(40), np.ones(40)), Estimate("s"), bound).agrees
    assert 7 <= wrong <= 36


def test_without_standard_errors_estimates_must_be_equal():
    zero = np.zeros(2)
    values = np.array([1.0, 2.0])
    assert agreement.estimate(values, values, (zero, zero), Estimate("s"), 3.0).agrees
    assert not agreement.estimate(values + 1e-12, values, (zero, zero), Estimate("s"), 3.0).agrees


def test_a_large_standard_error_is_allowed_only_where_the_rule_says_so():
    ones = np.ones(1)
    assert not agreement.estimate(ones, ones, (ones, ones), Estimate("s"), 3.0).agrees
    assert agreement.estimate(ones, ones, (ones, ones), Estimate("s", most=2.0), 3.0).agrees


def test_patterns():
    assert matches("*.a_?", "blond.a_f") == ["blond"] and matches("*.a_?", "blond.a_ff") is None
    assert matches("a.b", "axb") is None
    assert error_name(Estimate("*.se.*"), "*.mean.*", "x.mean.3") == "x.se.3"
    kinds = rules_of({"a": 1, "ab": 2}, {"a": Close(), "a*": Measured()})
    assert isinstance(kinds["a"][0], Close) and isinstance(kinds["ab"][0], Measured)


def test_an_explicit_rule_for_standard_errors_counts():
    rules = {"m": Estimate("s"), "s": Exact()}
    old = Data({"m": np.full(3, 9.0), "s": np.ones(3)})
    new = Data({"m": np.full(3, 9.0), "s": np.full(3, 1.1)})
    assert compare(new, old, {"m": Estimate("s")})["verdict"] == "agrees"
    assert list(compare(new, old, rules)["deviating"]) == ["s"]


def invoke(*arguments: object):
    return CliRunner().invoke(app, [str(x) for x in arguments])


def plant(folder: Path, **changes) -> None:
    """Change data as another computation would have given them: the state file names their hash."""
    found = read_data(folder)
    arrays = {**found.arrays, **{k: v for k, v in changes.items() if isinstance(v, np.ndarray)}}
    record = {**found.record, **{k: v for k, v in changes.items() if not isinstance(v, np.ndarray)}}
    digest = write_data(folder, Data(arrays, record))
    state = json.loads((folder / "computed.json").read_text())
    (folder / "computed.json").write_text(json.dumps({**state, "data": digest}))


def test_accept_and_verify_from_the_command_line(add, tmp_path: Path):
    root, out = add("toy_v"), tmp_path / "out"
    assert invoke("verify", out, "--root", root).exit_code == 2  # no such directory
    make(find(root, "toy_v"), out, say=lambda what: None)
    assert invoke("verify", out, "--root", root).exit_code == 4  # no reference data
    assert "stored" in invoke("accept", out, "--root", root).stdout
    reference = root / "experiments/reference/toy_v"
    content = json.loads((reference / "data.json").read_text())
    assert content["settings"] == {"scale": 2.0} and content["origin"]["data"] and content["origin"]["machine"]
    same = invoke("verify", out, "toy_v", "--root", root)
    assert same.exit_code == 0 and "agrees" in same.stdout
    assert json.loads((out / "verify.json").read_text())["experiments"]["toy_v"]["verdict"] == "agrees"

    plant(out / "toy_v", mean=1.3)  # z = 2.1 of 2.6
    assert invoke("verify", out, "--root", root).exit_code == 0
    plant(out / "toy_v", mean=1.5)
    found = invoke("verify", out, "--root", root)
    assert found.exit_code == 3 and "mean" in found.stdout and "deviating: toy_v" in found.stderr
    plant(out / "toy_v", mean=1.0, y=np.zeros(9))
    assert invoke("verify", out, "--root", root).exit_code == 3

    make(find(root, "toy_v"), out, ["scale=3.0"], say=lambda what: None)
    other = invoke("verify", out, "--root", root)
    assert other.exit_code == 4 and "scale 2.0 -> 3.0" in " ".join(other.stdout.split())
    (out / "toy_v/failed.json").write_text('{"schema_version": 1, "failure": "planted"}')
    assert invoke("verify", out, "--root", root).exit_code == 3
    assert invoke("accept", out, "--root", root).exit_code == 1


def test_reference_data_are_small(add, tmp_path: Path):
    root, out = add("toy_w"), tmp_path / "out"
    make(find(root, "toy_w"), out, say=lambda what: None)
    plant(out / "toy_w", noise=np.random.default_rng(0).random(200_000))
    refused = invoke("accept", out, "--root", root)
    assert refused.exit_code == 1 and "1000000 bytes" in refused.stdout
    assert not (root / "experiments/reference/toy_w").exists()


def test_damaged_reference_data_are_not_compared(add, tmp_path: Path):
    root, out = add("toy_x"), tmp_path / "out"
    make(find(root, "toy_x"), out, say=lambda what: None)
    invoke("accept", out, "--root", root)
    path = root / "experiments/reference/toy_x/data.npz"
    path.write_bytes(path.read_bytes()[:100])
    assert invoke("verify", out, "--root", root).exit_code == 4
