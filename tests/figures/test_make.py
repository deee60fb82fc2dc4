"""What is up to date and what is not, and that nothing is left half made."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from dsfit.errors import InputError
from dsfit.figures import Data, state
from dsfit.figures.catalogue import BrokenExperiment, Entry, find, names
from dsfit.figures.data import read_data, write_data
from dsfit.figures.make import Look, is_up_to_date, make
from dsfit.figures.thesis import thesis


def quiet(what: str) -> None:
    """Nobody listens."""


def calls(out: Path, name: str = "toy_a") -> int:
    """How often it has computed."""
    return len((out / name / "files" / "calls.txt").read_text())


@pytest.fixture
def toy(add) -> Entry:
    return find(add("toy_a"), "toy_a")


def contents(folder: Path) -> dict[str, bytes]:
    """All pictures, tables and data."""
    paths = [path for kind in ("figures/*", "tables/*", "data.*") for path in folder.glob(kind)]
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}


def test_made_once_then_up_to_date(toy: Entry, tmp_path: Path):
    assert not is_up_to_date(toy, tmp_path)
    done = make(toy, tmp_path, say=quiet)
    assert (done["computed"], done["drawn"]) == (True, True)
    assert is_up_to_date(toy, tmp_path)
    done = make(toy, tmp_path, say=quiet)
    assert (done["computed"], done["drawn"]) == (False, False)
    assert calls(tmp_path) == 1
    assert {"figures/curve.png", "figures/curve.pdf", "tables/values.md", "tables/values.tex"} < set(
        contents(tmp_path / "toy_a")
    )


def test_the_order_of_drawing_is_kept(add, tmp_path: Path):
    draw = """second, first = page.figure(0.5), page.figure(0.5)
    second.subplots(), first.subplots()
    return {"z_first": first, "curve": figure, "a_last": second}"""
    entry = find(add("toy_a", draw=draw), "toy_a")
    make(entry, tmp_path, say=quiet)
    drawn = state.read_state(tmp_path / "toy_a" / "drawn.json")
    wanted = ["z_first", "curve", "a_last"]
    assert state.in_order(drawn["figures"]) == wanted
    text = thesis({"toy_a": drawn})
    assert sorted(wanted, key=lambda name: text.index(f"fig:toy_a:{name}")) == wanted
    assert state.in_order({"b": {}, "a": {"place": "?"}, "c": {"place": 0}}) == ["c", "a", "b"]


def test_two_computations_and_two_drawings_give_the_same_bytes(toy: Entry, tmp_path: Path):
    make(toy, tmp_path / "one", say=quiet)
    make(toy, tmp_path / "two", say=quiet)
    first = contents(tmp_path / "one" / "toy_a")
    assert first == contents(tmp_path / "two" / "toy_a")
    assert make(toy, tmp_path / "one", say=quiet, only_draw=True, force=True)["drawn"]
    assert contents(tmp_path / "one" / "toy_a") == first


def test_force_computes_anew_without_what_was_kept(toy: Entry, tmp_path: Path):
    make(toy, tmp_path, say=quiet)
    (tmp_path / "toy_a/files/rubbish").write_text("x")
    assert make(toy, tmp_path, say=quiet, force=True)["computed"]
    assert calls(tmp_path) == 1 and not (tmp_path / "toy_a/files/rubbish").exists()


def test_another_setting_computes_anew_and_is_written_down(toy: Entry, tmp_path: Path):
    make(toy, tmp_path, say=quiet)
    assert is_up_to_date(toy, tmp_path, ["scale=2.0"]) and not is_up_to_date(toy, tmp_path, ["scale=5.0"])
    make(toy, tmp_path, ["scale=5.0"], say=quiet)
    assert "scale = 5.0" in (tmp_path / "toy_a/settings.toml").read_text()
    assert read_data(tmp_path / "toy_a").arrays["y"][-1] == 5
    assert not is_up_to_date(toy, tmp_path)


@pytest.mark.parametrize(
    ("file", "old", "new", "computes", "draws"),
    [
        ("experiments/toy_a.py", "x**2", "x**3", True, True),
        ("experiments/toy_a.py", "Powers.", "Powers of x.", False, False),
        ("experiments/toy_a.py", "x = np", "# a remark\n    x = np", False, False),
        ("experiments/toy_a.py", "minutes=0.1", "minutes=0.2", False, True),
        ("experiments/drawing/toy_a.py", "50 %", "60 %", False, True),
        ("configs/figures/toy_a.toml", "2.0", "2.5", True, True),
        ("configs/figures/toy_a.toml", "factor", "another remark", False, False),
    ],
)
def test_changes_of_code_and_settings(toy, add, tmp_path, file, old, new, computes, draws, monkeypatch):
    make(toy, tmp_path, say=quiet)
    path = toy.root / file
    path.write_text(path.read_text().replace(old, new))
    settings = toy.settings()
    if "minutes" in old:  # what the module says is known when it is imported anew
        monkeypatch.setattr(Entry, "description", lambda self: {"minutes": 0.2})
    from dsfit.figures.make import is_computed

    assert is_computed(toy, tmp_path / "toy_a", settings) is not computes
    assert is_up_to_date(toy, tmp_path) is not (computes or draws)


def test_code_that_is_imported_from_the_folder_counts(add, tmp_path: Path):
    root = add("toy_b", compute="from experiments._toy_help import one; one()")
    (root / "experiments/_toy_help.py").write_text("def one():\n    return 1\n")
    entry = find(root, "toy_b")
    make(entry, tmp_path, say=quiet)
    assert is_up_to_date(entry, tmp_path)
    (root / "experiments/_toy_help.py").write_text("def one():\n    return 2\n")
    assert not is_up_to_date(entry, tmp_path)


def test_a_file_that_was_read_counts(add, tmp_path: Path):
    root = add("toy_c", compute='work.file("configs/map.txt").read_text()')
    entry = find(root, "toy_c")
    with pytest.raises(InputError, match="configs/map.txt"):
        make(entry, tmp_path, say=quiet)
    (root / "configs/map.txt").write_text("1")
    make(entry, tmp_path, say=quiet)
    assert is_up_to_date(entry, tmp_path)
    (root / "configs/map.txt").write_text("2")
    assert not is_up_to_date(entry, tmp_path)


TINY = """
[contexts]
theta_r_deg = [0.0]
n = [0]
[[methods]]
name = "uniform"
kind = "uniform"
[estimate]
samples = [16]
repeats = 2
rounds = 1
rtol = 1e-2
[output]
maps = 0
"""


def test_a_config_that_was_run_counts(add, tmp_path: Path):
    root = add("toy_d", compute='work.run("tiny.toml", ("estimate.seed=7",))')
    (root / "configs/tiny.toml").write_text(TINY)
    entry = find(root, "toy_d")
    make(entry, tmp_path, say=quiet)
    assert is_up_to_date(entry, tmp_path)
    (root / "configs/tiny.toml").write_text("# a remark\n" + TINY)
    assert is_up_to_date(entry, tmp_path)
    (root / "configs/tiny.toml").write_text(TINY.replace("repeats = 2", "repeats = 3"))
    assert not is_up_to_date(entry, tmp_path)


DAMAGE = ["data.npz", "data.json", "computed.json", "drawn.json", "figures/curve.png", "tables/values.tex"]


def damaged(path: Path, how: str) -> None:
    """Damage a file; of state files it is the key that changes, as a flipped bit of a note need not matter."""
    content = path.read_bytes()
    middle = len(content) // 2
    if how == "missing":
        path.unlink()
    elif how == "changed" and path.name in ("computed.json", "drawn.json"):
        path.write_text(json.dumps({**json.loads(content), "key": "0"}))
    else:
        changed = content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :]
        path.write_bytes({"empty": b"", "cut": content[:middle], "changed": changed}[how])


@pytest.mark.parametrize("name", DAMAGE)
def test_damage_to_any_file_is_noticed_and_mended(toy: Entry, tmp_path: Path, name: str):
    make(toy, tmp_path / "whole", say=quiet)
    whole = contents(tmp_path / "whole/toy_a")
    for how in ("missing", "empty", "changed", "cut"):
        shutil.copytree(tmp_path / "whole", tmp_path / how)
        damaged(tmp_path / how / "toy_a" / name, how)
        assert not is_up_to_date(toy, tmp_path / how), how
    done = make(toy, tmp_path / "cut", say=quiet)
    assert done["computed"] is (name in DAMAGE[:3])
    assert contents(tmp_path / "cut/toy_a") == whole


def test_a_failing_attempt_leaves_the_older_data_and_pictures_whole(toy: Entry, tmp_path: Path, monkeypatch):
    make(toy, tmp_path, say=quiet)
    before = contents(tmp_path / "toy_a")

    def fail(settings, work):
        raise RuntimeError("planted")

    broken = Entry(toy.name, toy.root, type(toy.experiment)("t", "s", toy.experiment.settings, fail, 1.0))
    with pytest.raises(RuntimeError, match="planted"):
        make(broken, tmp_path, ["scale=7.0"], say=quiet)
    assert contents(tmp_path / "toy_a") == before
    assert make(toy, tmp_path, say=quiet, only_draw=True)["computed"] is False
    monkeypatch.setattr(toy.drawing, "tables", fail)
    with pytest.raises(TypeError):
        make(toy, tmp_path, say=quiet, look=Look(100.0))
    assert contents(tmp_path / "toy_a") == before


def test_data_that_do_not_belong_together_are_not_drawn(toy: Entry, tmp_path: Path):
    make(toy, tmp_path, say=quiet)
    write_data(tmp_path / "toy_a", Data({"x": np.zeros(9), "y": np.zeros(9)}, {}))
    with pytest.raises(InputError, match="no whole data"):
        make(toy, tmp_path, say=quiet, only_draw=True)


def test_nothing_to_draw(toy: Entry, tmp_path: Path):
    with pytest.raises(InputError, match="no whole data"):
        make(toy, tmp_path / "none", say=quiet, only_draw=True)


def test_width_and_formats_are_part_of_what_is_up_to_date(toy: Entry, tmp_path: Path):
    make(toy, tmp_path, say=quiet)
    assert not is_up_to_date(toy, tmp_path, look=Look(85.0))
    assert not is_up_to_date(toy, tmp_path, look=Look(150.0, pgf=True))


def test_names_errors_and_broken_modules(add):
    root = add("toy_e")
    add("toy_f")
    (root / "experiments/toy_f.py").write_text("import nothing_of_this_name\n")
    add("toy_g")
    (root / "experiments/toy_g.py").write_text("EXPERIMENT = 3\n")
    (root / "experiments/drawing/_help.py").write_text("")
    assert names(root) == ["toy_e", "toy_f", "toy_g"]
    with pytest.raises(InputError, match="toy_e.*did you mean"):
        find(root, "toy_ee")
    with pytest.raises(BrokenExperiment, match="nothing_of_this_name"):
        find(root, "toy_f")
    with pytest.raises(BrokenExperiment, match="no dsfit.figures.Experiment"):
        find(root, "toy_g")


@pytest.mark.parametrize("change", ["scale=x", "scale=nan", "sale=1.0", "scale"])
def test_wrong_settings_are_refused(toy: Entry, change: str):
    with pytest.raises(InputError):
        toy.settings([change])


def test_missing_packages_are_named(add, tmp_path: Path):
    root = add("toy_h")
    path = root / "experiments/toy_h.py"
    path.write_text(path.read_text().replace("minutes=0.1,", 'minutes=0.1, needs=("nothing_of_this_name",),'))
    with pytest.raises(InputError, match="nothing_of_this_name missing"):
        make(find(root, "toy_h"), tmp_path, say=quiet)


def test_state_files_are_read_only_if_whole(tmp_path: Path):
    assert state.read_state(tmp_path / "none.json") == {}
    (tmp_path / "bad.json").write_text("{")
    assert state.read_state(tmp_path / "bad.json") == {}
