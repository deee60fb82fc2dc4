"""Saved proposals and run directories: damaged, they are refused by name; writes that fail leave old files whole."""

from __future__ import annotations

import builtins
import json
import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from dsfit import Context, load_proposal, save_proposal
from dsfit.cli import app
from dsfit.errors import InputError
from dsfit.experiment import files, runner
from dsfit.experiment.plots.style import new_figure, save
from dsfit.experiment.progress import BarProgress
from dsfit.experiment.rundir import RunFailure
from dsfit.experiment.validation import load
from dsfit.proposals import GaussianLobe, Mixture, Product, UniformSphere, WrappedGaussian
from dsfit.scene import write_exr
from tests.fuzz.common import fuzz, listing

CONTEXT = Context(0.2)
TINY = """
[contexts]
theta_r_deg = [0, 30]
[bsdf]
azimuthal = "simplified"
[[methods]]
name = "uniform"
kind = "uniform"
[[methods]]
name = "TT"
kind = "single"
proposal = "TT"
defensive = 0.5
[estimate]
samples = [16, 64]
repeats = 2
rounds = 1
rtol = 1e-2
[output]
plots = false
"""


def example() -> Mixture:
    return Mixture([Product(GaussianLobe(torch.tensor(-0.1), 0.2), WrappedGaussian(0.5)), UniformSphere()])


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> dict[str, np.ndarray]:
    path = tmp_path_factory.mktemp("saved") / "p.npz"
    save_proposal(path, example())
    return files.read_arrays(path)


def works(path: Path) -> bool:
    """Whether the file loads; if so, what is loaded samples, evaluates, or says what is wrong with it."""
    try:
        proposal = load_proposal(path)
    except InputError as error:
        assert path.name in str(error)
        return False
    try:
        distribution = proposal(CONTEXT)
        u = torch.full((2, distribution.dimension), 0.3, dtype=torch.float64)
        omega, log_prob = distribution.sample_with_log_prob(u)
    except InputError:
        return False
    assert omega.shape == (2, 2) and log_prob.shape == (2,)
    assert not bool(log_prob.isnan().any())
    return True


values = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-3, 10**6),
    st.floats(allow_nan=False, allow_infinity=False),
    st.text(max_size=5),
    st.just([]),
    st.just({}),
    st.sampled_from(
        [
            "dsfit.proposals.mixture:Mixture",
            "dsfit.bsdf.fiber:Fiber",
            "os:system",
            "a0",
            "a99",
            "float64",
            "dsfit.cli:main",
            "dsfit.proposals.uniform:UniformSphere",
            {"same": 3},
            {"same": 99},
            {"id": 1},
            {"tuple": [1]},
            {"float": "nan"},
            {"dtype": "float16"},
            {"dict": [[1]]},
        ]
    ),
)


def nodes(value: Any) -> Iterator[tuple[Any, Any]]:
    """Every place in a JSON tree, as (container, key)."""
    for key in list(value if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ()):
        yield value, key
        yield from nodes(value[key])


@fuzz(150)
@given(
    st.lists(
        st.tuples(st.integers(0, 10**6), st.sampled_from(["replace", "delete", "rename"]), values),
        min_size=1,
        max_size=3,
    )
)
def test_edited_headers_of_saved_proposals(saved: dict[str, np.ndarray], edits: list[Any]) -> None:
    header = json.loads(saved["header"].tobytes())
    for where, how, value in edits:
        places = [(c, k) for c, k in nodes(header) if k != "checksum"]  # without one a file is taken as it is
        if not places:
            break
        container, key = places[where % len(places)]
        if how == "replace":
            container[key] = value
        elif how == "delete":
            del container[key]
        elif isinstance(container, dict):
            container[str(value)] = container.pop(key)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "p.npz"
        np.savez(path, **{**saved, "header": np.frombuffer(json.dumps(header).encode(), np.uint8)})
        works(path)
        assert [p.name for p in Path(folder).iterdir()] == ["p.npz"]


arrays = st.sampled_from(
    [
        np.zeros(()),
        np.zeros(0),
        np.zeros((2, 3)),
        np.array("x"),
        np.array([1 + 2j]),
        np.array([1]),
        np.full(2, np.nan),
        np.zeros(3, np.float16),
        np.ones(2, bool),
        np.full((), np.inf),
    ]
)


@fuzz(150)
@given(st.integers(0, 100), st.none() | arrays)
def test_edited_arrays_of_saved_proposals(saved: dict[str, np.ndarray], which: int, value: np.ndarray | None) -> None:
    changed = dict(saved)
    key = sorted(changed)[which % len(changed)]
    if value is None:
        del changed[key]
    else:
        changed[key] = value
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "p.npz"
        np.savez(path, **changed)
        works(path)


@fuzz(70)
@given(st.floats(0, 1), st.floats(0, 1), st.binary(max_size=5))
def test_damaged_bytes_of_saved_proposals(
    tmp_path_factory: pytest.TempPathFactory, at: float, keep: float, noise: bytes
) -> None:
    path = tmp_path_factory.mktemp("bytes") / "p.npz"
    save_proposal(path, example())
    whole = path.read_bytes()
    start = int(at * len(whole))
    data = whole[:start] + noise + whole[start + len(noise) :]
    path.write_bytes(data[: int(keep * len(data))] if keep < 0.5 else data)
    works(path)


# ---- run directories ----


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run."""
    folder = tmp_path_factory.mktemp("run")
    (folder / "tiny.toml").write_text(TINY)
    outcome = runner.run(load(folder / "tiny.toml"), folder, workers=0)
    return outcome.directory.path


def show(path: Path, *options: str) -> int:
    """`dsfit show`: done, or one line that says what is wrong, and exit code 2."""
    done = CliRunner().invoke(app, ["show", str(path), *options])
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    assert done.exit_code in (0, 2) and "Traceback" not in done.output, done.output
    return done.exit_code


@fuzz(60)
@given(
    st.lists(st.tuples(st.integers(0, 10**6), st.sampled_from(["replace", "delete"]), values), min_size=1, max_size=2)
)
def test_show_of_edited_results(finished: Path, edits: list[Any]) -> None:
    result = json.loads((finished / "result.json").read_text())
    for where, how, value in edits:
        places = [(c, k) for c, k in nodes(result) if k != "provenance"]
        container, key = places[where % len(places)]
        if how == "replace":
            container[key] = value
        else:
            del container[key]
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "result.json").write_text(json.dumps(result))
        code = show(Path(folder))
        assert set(listing(Path(folder))) == {"result.json"} | ({"table.md"} if code == 0 else set())


@fuzz(60)
@given(
    st.binary(max_size=30)
    | st.sampled_from(
        [
            b"{}",
            b"[]",
            b"null",
            b"[" * 5000,
            b'{"schema_version": 1}',
            b'{"schema_version": 1, "kind": "check", "cells": [{}]}',
        ]
    )
)
def test_show_of_any_bytes(content: bytes) -> None:
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "result.json").write_bytes(content)
        assert show(Path(folder)) == 2
        assert set(listing(Path(folder))) == {"result.json"}


def test_brackets_in_names_are_shown_as_they_are(finished: Path, tmp_path: Path) -> None:
    result = json.loads((finished / "result.json").read_text())
    result["title"] = "half [/way]"
    result["cells"][0]["methods"][0]["name"] = "plain [bold] :smile:"
    folder = tmp_path / "[/x]"
    folder.mkdir(parents=True)
    (folder / "result.json").write_text(json.dumps(result))
    done = CliRunner().invoke(app, ["show", str(folder)])
    assert done.exit_code == 0 and done.exception is None, done.output
    assert all(text in done.output for text in ("half [/way]", "plain [bold] :smile:", "[/x]/result.json"))
    with BarProgress("[/x]") as progress:
        progress.step(0, "[/y]")


def test_dollars_in_names_are_no_formulas(tmp_path: Path) -> None:
    figure = new_figure(3, 2)
    axes = figure.subplots()
    axes.loglog([1, 10, 100], [1, 100, 1e4], label="$_^$")
    axes.legend(title="a $^$")
    axes.set(title="$\\x$", xlabel="$^_$")
    figure.suptitle("$_$")
    save(figure, tmp_path, "a")
    assert sorted(listing(tmp_path)) == ["a.pdf", "a.png"]
    assert "mathdefault" in axes.xaxis.get_ticklabels()[1].get_text()
    assert axes.xaxis.get_ticklabels()[1].get_parse_math() and not axes.title.get_parse_math()


# ---- writes that fail ----


@contextmanager
def failing(call: int, what: str) -> Iterator[list[int]]:
    """The `call`-th `os.replace`, `os.fsync` or opening for writing fails as on a full disk; the list counts them."""
    count = [0]

    def guard(real: Callable[..., Any], counts: Callable[..., bool] = lambda *a, **k: True) -> Callable[..., Any]:
        def wrapped(*args: Any, **kwargs: Any) -> Any:
            if counts(*args, **kwargs):
                count[0] += 1
                if count[0] == call:
                    raise OSError(28, "No space left on device")
            return real(*args, **kwargs)

        return wrapped

    def writing(file: Any, mode: str = "r", *args: Any, **kwargs: Any) -> bool:
        return "w" in mode and not str(file).startswith("/dev")

    targets = {
        "replace": (os, "replace", guard(os.replace)),
        "fsync": (os, "fsync", guard(os.fsync)),
        "open": (builtins, "open", guard(builtins.open, writing)),
    }
    with mock.patch.object(targets[what][0], targets[what][1], targets[what][2]):
        yield count


@pytest.mark.parametrize("what", ["replace", "fsync", "open"])
def test_a_failed_write_keeps_the_old_file_and_leaves_nothing_else(tmp_path: Path, what: str) -> None:
    writers: dict[str, Callable[[Path, int], Any]] = {
        "a.npz": lambda path, k: save_proposal(path, Product(GaussianLobe(0.1 * k, 0.2), WrappedGaussian(0.5))),
        "a.json": lambda path, k: files.write_json(path, {"schema_version": 1, "k": k}),
        "b.npz": lambda path, k: files.write_arrays(path, {"k": np.full(3, k)}),
    }
    if what == "replace":
        writers["a.exr"] = lambda path, k: write_exr(path, {"Y": np.full((2, 2), float(k))})
    for name, write in writers.items():
        write(tmp_path / name, 1)
    before = listing(tmp_path)
    for name, write in writers.items():
        with failing(1, what), pytest.raises(OSError, match="No space"):
            write(tmp_path / name, 2)
        assert listing(tmp_path) == before
        write(tmp_path / name, 2)
        assert listing(tmp_path)[name] != before[name]
        before = listing(tmp_path)


def cheap(directory: Any, job: Any, say: Any) -> None:
    """Writes what a cell writes, a saved proposal included, without computing anything."""
    save_proposal(directory.proposal_path(job.index, "fitted"), Product(GaussianLobe(0.1, 0.2), WrappedGaussian(0.5)))
    data = {"index": job.index, "label": job.label, "identity": job.identity, "value": job.index**2}
    directory.write_cell(job.index, data, {"x": np.arange(job.index + 1)})


@pytest.mark.parametrize("what", ["replace", "fsync", "open"])
def test_a_run_whose_writes_fail_anywhere_is_resumed(tmp_path: Path, what: str) -> None:
    (tmp_path / "tiny.toml").write_text(TINY)
    experiment = load(tmp_path / "tiny.toml")
    with mock.patch.object(runner, "run_job", cheap):
        whole = runner.run(experiment, tmp_path / "whole", workers=0).result["cells"]
        for call in range(1, 100):
            with failing(call, what) as count:
                try:
                    outcome = runner.run(experiment, tmp_path / str(call), workers=0)
                except (OSError, RunFailure):
                    pass
                if count[0] < call:  # one more than there are
                    break
            path = runner.run_directory(experiment, tmp_path / str(call)).path
            assert not (path / "result.json").exists() and not list(path.rglob("*.tmp"))
            for written in path.rglob("*.json"):
                json.loads(written.read_text())
            for written in path.rglob("proposals/*.npz"):
                load_proposal(written)
            kept = {p: p.stat().st_mtime_ns for p in path.glob("cells/*.json")}
            outcome = runner.run(experiment, tmp_path / str(call), workers=0)
            assert not outcome.skipped and outcome.result["cells"] == whole
            assert all(p.stat().st_mtime_ns == time for p, time in kept.items())
        assert call > 8


# ---- the command line ----


words = st.sampled_from(
    [
        "run",
        "show",
        "presets",
        "check",
        "--set",
        "--out",
        "out",
        "--force",
        "--workers",
        "0",
        "-1",
        "x",
        "bad.toml",
        "gone.toml",
        ".",
        "",
        "--help",
        "--plots",
        "fiber.eta=0.5",
        "a=b",
        "--",
        "-h",
        "\x00",
        "ü",
        "--set=x=1",
        "nowhere",
        "/dev/null",
        "--nonsense",
        "a" * 300,
    ]
)


@fuzz(120)
@given(st.lists(words, max_size=5))
def test_any_arguments(arguments: list[str]) -> None:
    with tempfile.TemporaryDirectory() as name, mock.patch.dict(os.environ):
        here = Path.cwd()
        os.chdir(name)
        try:
            Path("bad.toml").write_text("[fiber]\neta = 0.5\n")
            before = listing(Path())
            done = CliRunner().invoke(app, arguments)
            if done.exception is not None and not isinstance(done.exception, SystemExit):
                raise done.exception
            assert done.exit_code in (0, 2), (arguments, done.exit_code, done.output)
            assert "Traceback" not in done.output and listing(Path()) == before
        finally:
            os.chdir(here)
