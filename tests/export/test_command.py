"""`dsfit export` on configs and saved proposals."""

from __future__ import annotations

import copy
from pathlib import Path

import pytest
import torch
from typer.testing import CliRunner

import dsfit
from dsfit.cli import app
from dsfit.errors import InputError
from dsfit.export.sources import bsdf_of, from_config, from_proposal
from dsfit.export.writer import KNOWN
from tests.export import cases
from tests.kernels import cases as kernels

CONFIG = """
[fiber]
preset = "blond"
[amortise]
hidden = [8]
[[methods]]
name = "uniform"
kind = "uniform"
"""


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "hair.toml").write_text(CONFIG)
    return tmp_path


def invoke(*arguments: str) -> tuple[int, str]:
    result = CliRunner().invoke(app, ["export", *arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.output


def test_a_saved_proposal_becomes_a_header(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dsfit.export.writer.KNOWN", KNOWN[:1])
    dsfit.save_proposal(here / "blond.npz", cases.proposal())
    code, said = invoke("blond.npz", "-o", "out/hair.h", "--example", "out/example.cpp", "--namespace", "blond")
    assert code == 0 and "out/hair.h" in said and "MB" in said
    written = (here / "out" / "hair.h").read_text()
    assert "loaded from: blond.npz, SHA-256" in written and "namespace blond {" in written
    assert "blond::sample(" in (here / "out" / "example.cpp").read_text()


def test_the_bsdf_of_a_proposal_is_its_fibre() -> None:
    own = bsdf_of(cases.proposal())
    for name, value in kernels.bsdf().fiber.parameters().items():
        assert torch.equal(getattr(own.fiber, name), value), name
    assert float(own.d_f) == 0.7 and float(own.d_b) == 0.7


@pytest.mark.slow
def test_a_proposal_of_other_equations_needs_its_config(here: Path) -> None:
    changed = copy.deepcopy(cases.proposal())
    changed.lobes.direct += 0.01
    dsfit.save_proposal(here / "other.npz", changed)
    with pytest.raises(InputError, match="config"):
        from_proposal(here / "other.npz")


def test_a_config_and_a_proposal_go_together(here: Path) -> None:
    dsfit.save_proposal(here / "blond.npz", cases.proposal())
    bsdf, proposal, facts = from_config(here / "hair.toml", [], here / "blond.npz", None)
    assert torch.equal(bsdf.fiber.sigma_a, kernels.bsdf().fiber.sigma_a)
    assert torch.equal(proposal.network.weights[-1], cases.proposal().network.weights[-1])
    assert "blond.npz" in facts["loaded from"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("none.toml",), "none.toml"),
        (("none.npz",), "none.npz"),
        (("hair.toml", "--set", "fiber.eccentricity=0.9", "--steps", "0"), "eccentricity"),
        (("hair.toml", "--set", 'bsdf.azimuthal="simplified"', "--steps", "0"), "azimuthal"),
        (("hair.toml", "--set", 'bsdf.convention="printed"', "--steps", "0"), "convention"),
        (("hair.toml", "--namespace", "class", "--steps", "0"), "namespace"),
        (("blond.npz", "--steps", "3"), "--steps"),
        (("hair.toml", "--proposal", "blond.npz", "--steps", "3"), "steps"),
        (("hair.toml", "--proposal", "blond.npz", "--set", 'fiber.preset="black"'), "fibre"),
    ],
)
def test_what_is_wrong_is_named_and_nothing_written(arguments: tuple[str, ...], words: str, here: Path) -> None:
    dsfit.save_proposal(here / "blond.npz", cases.proposal())
    code, said = invoke(*arguments, "-o", "out.h")
    assert code == 2 and words in said.replace("\n", " "), said
    assert not (here / "out.h").exists()


@pytest.mark.slow
def test_a_config_is_trained_the_same_way_twice(here: Path) -> None:
    for name in ("a.h", "b.h"):
        code, said = invoke("hair.toml", "-o", name, "--steps", "20", "--set", "amortise.inclinations=32")
        assert code == 0, said
    first, second = ((here / name).read_text() for name in ("a.h", "b.h"))
    assert first == second and "training: 20 steps, 512 contexts, seed" in first


@pytest.mark.slow
@pytest.mark.skipif(not cases.has_compiler(), reason="no C++ compiler")
def test_the_benchmark_names_every_operation(here: Path) -> None:
    code, said = invoke("hair.toml", "-o", "hair.h", "--steps", "0", "--benchmark")
    assert code == 0, said
    for words in ("prepare:", "eval:", "sample + pdf + eval:", "shade:", "-O3 -march=native", "kernel"):
        assert words in said
