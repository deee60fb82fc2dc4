"""Amortised proposals from configs: the experiment of their own, and the method of a comparison."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import dsfit
from dsfit.experiment import runner, summary
from dsfit.experiment.plots import draw_all
from dsfit.experiment.reader import ConfigError
from dsfit.experiment.validation import load

AMORTISE = """
kind = "amortise"
[amortise]
steps = 2
hidden = [4]
inclinations = 3
pairs = 2
check = 0
"""
COMPARE = """
[contexts]
theta_r_deg = [30]
n = [2]
[[methods]]
name = "amortised"
kind = "amortised"
file = "amortised.npz"
file_seconds = 12.5
[estimate]
samples = [16]
repeats = 4
rounds = 1
rtol = 1e-3
[output]
plots = false
"""


@pytest.fixture(scope="module")
def outcome(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """One small run, on contexts fewer than the shipped grid's."""
    from dsfit.fit.amortise import unseen

    folder = tmp_path_factory.mktemp("amortise")
    patch = pytest.MonkeyPatch()
    patch.setattr(unseen, "INCLINATIONS_DEG", (-60.0, 10.0, 89.0))
    patch.setattr(unseen, "DEPTHS", (1.0, 30.0))
    path = folder / "first.toml"
    path.write_text(AMORTISE + f"[output]\ndir = '{folder / 'runs'}'\n")
    found = runner.run(load(path), workers=0)
    patch.undo()
    return found


def test_a_run_holds_the_proposal_and_its_excess(outcome: Any) -> None:
    (cell,) = outcome.result["cells"]
    assert cell["held_out"]["contexts"] == cell["start"]["contexts"] == 3 * 7
    assert 0 < cell["held_out"]["median"] <= cell["held_out"]["p95"] <= cell["held_out"]["p99"]
    assert cell["held_out"]["p99"] <= cell["held_out"]["worst"] < 1
    assert cell["training"]["steps"] == 2 and cell["training"]["contexts"] == 6
    assert len(cell["beyond"]) == 16 and {b["n"] for b in cell["beyond"]} == {0.0, 100.0, 300.0, 1e4}
    arrays = outcome.directory.arrays(0)
    assert float(np.median(arrays["excess"])) == pytest.approx(cell["held_out"]["median"])
    proposal = dsfit.load_proposal(outcome.directory.path / cell["file"])
    assert isinstance(proposal, dsfit.AmortisedProposal)
    worst = int(arrays["excess"].argmax())
    context = dsfit.Context(np.radians(arrays["theta_r_deg"][worst]), n=arrays["n"][worst], v=arrays["v"][worst])
    bsdf = dsfit.DualScattering(dsfit.Fiber.preset("blond"), precision="table")
    exact = dsfit.excess(dsfit.Integrand(bsdf), proposal, context, 1e-2)
    assert float(exact.value) == pytest.approx(cell["held_out"]["worst"], rel=1e-2)


def test_tables_and_figure_have_the_numbers(outcome: Any) -> None:
    (cell,) = outcome.result["cells"]
    text = summary.markdown(outcome.result)
    assert "blond" in text and f"{cell['held_out']['median']:.3g}" in text and "Beyond" in text
    table = summary.terminal_table(outcome.result)
    assert table.row_count == 1
    written = draw_all(outcome.directory, outcome.result)
    assert [p.name for p in written] == ["amortised.png", "amortised.pdf"]
    assert all(p.stat().st_size > 10_000 for p in written)


def test_a_saved_proposal_takes_part_in_comparisons(outcome: Any, tmp_path: Path) -> None:
    (cell,) = outcome.result["cells"]
    (tmp_path / "amortised.npz").write_bytes((outcome.directory.path / cell["file"]).read_bytes())
    path = tmp_path / "compare.toml"
    path.write_text(COMPARE)
    (method,) = runner.run(load(path), tmp_path / "runs", workers=0).result["cells"][0]["methods"]
    assert method["kind"] == "amortised" and method["fit"]["seconds"] == 12.5
    assert 0 < method["excess"] < 0.05


def test_comparisons_take_the_closed_forms_too(tmp_path: Path) -> None:
    path = tmp_path / "compare.toml"
    path.write_text(COMPARE.replace('file = "amortised.npz"\nfile_seconds = 12.5', "steps = 0"))
    (method,) = runner.run(load(path), tmp_path / "runs", workers=0).result["cells"][0]["methods"]
    assert method["fit"]["steps"] == 0 and method["fit"]["seconds"] > 0
    assert 0 < method["excess"] < 0.05


@pytest.mark.parametrize(
    ("text", "key"),
    [
        (AMORTISE + "seconds = 3.0\n", "amortise.seconds"),
        (AMORTISE + "[fiber]\neccentricity = 0.9\n", "fiber.eccentricity"),
        (AMORTISE + "layers = 3\n", "amortise.layers"),
        (AMORTISE + "defensive = 1.0\n", "amortise.defensive"),
        (COMPARE, "methods.0.file"),
        (COMPARE.replace('file = "amortised.npz"\n', ""), "methods.0.file_seconds"),
        (COMPARE.replace("file_seconds = 12.5", "steps = 3"), "methods.0.steps"),
        (
            COMPARE.replace('file = "amortised.npz"\nfile_seconds = 12.5', "steps = 3\nseconds = 1.0"),
            "methods.0.seconds",
        ),
    ],
)
def test_configs_that_do_not_work_are_refused(text: str, key: str, tmp_path: Path) -> None:
    path = tmp_path / "wrong.toml"
    path.write_text(text)
    with pytest.raises(ConfigError) as error:
        load(path)
    assert error.value.field == key


def test_a_proposal_of_another_fibre_or_a_damaged_file_is_refused(outcome: Any, tmp_path: Path) -> None:
    (cell,) = outcome.result["cells"]
    saved = (outcome.directory.path / cell["file"]).read_bytes()
    path, file = tmp_path / "wrong.toml", tmp_path / "amortised.npz"
    path.write_text(COMPARE + '[fiber]\npreset = "black"\n')
    file.write_bytes(saved)
    with pytest.raises(ConfigError, match="fibre"):
        load(path)
    path.write_text(COMPARE)
    file.write_bytes(saved[: len(saved) // 2])
    with pytest.raises(ConfigError, match="methods"):
        load(path)
