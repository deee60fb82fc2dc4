"""`experiments/scatter_counts.py`: its numbers on counts whose law is known, and a small run from end to end."""

from __future__ import annotations

import importlib
import json
from pathlib import Path
from types import ModuleType

import pytest
import torch

from tests.render.grid_cases import F64, generator, uneven, uniform

FOLDER = Path(__file__).parents[2] / "experiments"


@pytest.fixture(autouse=True)
def scripts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(FOLDER))


def script(name: str) -> ModuleType:
    return importlib.import_module(name)


def test_poisson_numbers_are_told_as_such() -> None:
    n = 6 * uniform(20_000) ** 2
    found = script("_scatter_counts_compare").compare(n, torch.poisson(n, generator=generator(1)), n <= 1)
    assert found["mean_n"] - found["mean_N"] == pytest.approx(0.0, abs=4 * found["error"])
    assert found["few"][0] == pytest.approx(0.0, abs=4 * found["few"][1])
    assert found["scatter"] / found["poisson"] == pytest.approx(1.0, abs=0.03)
    assert found["zero"] == pytest.approx(found["exp"], abs=0.015)
    for mean, expected in found["powers"].values():
        assert mean == pytest.approx(expected, abs=0.015)
    rule = found["rule"]
    assert rule["wrong"] == pytest.approx(rule["wrongly_lit"] + rule["wrongly_dark"])
    assert found["brier"]["poisson"] < found["brier"]["threshold"] == pytest.approx(rule["wrong"])
    for entry in found["bins"][:6]:
        assert entry["zero"] == pytest.approx(entry["exp"], abs=0.06)
    assert found["bins"][-1] is None


def test_other_laws_and_biases_show() -> None:
    compare, n = script("_scatter_counts_compare").compare, 0.5 + 5 * uniform(20_000)
    clumped = 3 * torch.poisson(n / 3, generator=generator(1))
    found = compare(n, clumped, n <= 1)
    assert found["scatter"] / found["poisson"] == pytest.approx(3**0.5, abs=0.06)
    assert found["zero"] > found["exp"] + 0.1
    biased = compare(1.1 * n, torch.poisson(n, generator=generator(2)), n <= 1, bins=False)
    assert biased["mean_n"] / biased["mean_N"] == pytest.approx(1.1, abs=0.02)
    assert biased["scatter"] / biased["poisson"] == pytest.approx(1.0, abs=0.03)  # about the mean at given n
    assert "bins" not in biased
    even = compare(n, n.round(), n <= 1)
    assert even["scatter"] / even["poisson"] < 0.3


def test_without_the_term_for_the_spread_more_is_crossed() -> None:
    counts, grid = script("scatter_counts"), uneven()
    origin = grid.low + (grid.high - grid.low) * uniform(50, 3)
    direction = 2 * uniform(50, 3, seed=1) - 1
    plain, rooted = grid.crossings(origin, direction), counts.rooted(grid)(origin, direction)
    assert bool((rooted > plain).all()) and float(((rooted - plain) / plain).max()) < 0.12
    by_torch = counts.rooted(uneven(mode="eager"))(origin, direction)
    assert torch.allclose(by_torch, rooted, rtol=1e-5)
    assert torch.equal(grid.crossings(origin, direction), plain)


def test_a_small_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    counts = script("scatter_counts")
    counts.main(["--out", str(tmp_path), "--quick"])
    assert {path.suffix for path in tmp_path.iterdir()} == {".json", ".md", ".png", ".pdf"}
    data = json.loads((tmp_path / counts.NAME).read_text())
    assert [row["points"] for row in data["rows"]] == ["fibres", "seen"] * 4
    for row in data["rows"]:
        assert abs(row["mean_n"] - row["mean_N"]) < 5 * row["error"] + 0.1 * row["mean_N"]
        assert row["steps"]["0.25"] < row["steps"]["1"] < 0.1 * row["mean_n"]
        assert row["others"]["half a voxel on"]["mean_n"] < row["others"]["from the point itself"]["mean_n"]
        assert row["mean_n"] < row["others"]["root of the mean square sine"]["mean_n"]
    assert all(least > 0 for row in data["speed"] for least in row["nanoseconds"].values())
    printed = capsys.readouterr().out
    assert printed.count("| double_block |") == 2 * 6 + 2 and "nan" not in printed


def test_points_lie_on_fibres() -> None:
    counts = script("scatter_counts")
    strands = counts._strands("block", True)
    origin, direction, own, radius = counts.on_fibres(strands, 200)
    near = (strands.points[None] - origin[:, None]).norm(dim=-1).argmin(-1)
    assert float((strands.strand_of_point[near] == own).to(F64).mean()) > 0.95
    assert torch.allclose(direction.norm(dim=-1), torch.ones(200, dtype=F64))
    assert float(radius.min()) >= float(strands.radius.min()) and float(radius.max()) <= float(strands.radius.max())
