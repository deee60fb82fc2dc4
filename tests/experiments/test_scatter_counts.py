"""The experiment `scatter_counts`: its numbers on counts whose law is known, and a small run from end to end."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from dsfit.figures import Data, Work
from dsfit.figures.catalogue import find
from dsfit.figures.data import read_data, write_data
from dsfit.figures.page import Page
from dsfit.figures.verify import compare as verified
from experiments import scatter_counts as counts
from experiments._scatter_counts_compare import bins, compare, with_errors
from experiments.drawing import scatter_counts as drawing
from tests.render.grid_cases import F64, generator, uneven, uniform

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Data:
    folder = tmp_path_factory.mktemp("scatter_counts")
    settings = find(ROOT, "scatter_counts").settings(counts.EXPERIMENT.small)
    write_data(folder, counts.compute(settings, Work(folder, ROOT, lambda what: None)))
    return read_data(folder)


def test_poisson_numbers_are_told_as_such() -> None:
    n = 6 * uniform(20_000) ** 2
    exact = torch.poisson(n, generator=generator(1))
    found = with_errors("x", compare, n, exact)
    for name in ("bias", "few"):
        assert found[f"x.{name}"] == pytest.approx(0.0, abs=4 * found[f"error.x.{name}"])
    assert found["x.scatter"] == pytest.approx(1.0, abs=min(0.03, 4 * found["error.x.scatter"]))
    for mean, expected in (("zero", "exp"), ("power_0.3", "mean_power_0.3"), ("power_0.7", "mean_power_0.7")):
        assert found[f"x.{mean}"] == pytest.approx(found[f"x.{expected}"], abs=0.015)
    assert found["x.wrong"] == pytest.approx(found["x.wrongly_lit"] + found["x.wrongly_dark"])
    assert found["x.brier_poisson"] < found["x.brier_threshold"] == pytest.approx(found["x.wrong"])
    binned = bins(n, exact)
    assert binned["bins.rays"].sum() == 20_000 and binned["error.bins.zero"][-1] == 1.0
    z = (binned["bins.zero"] - np.exp(-binned["bins.n"]))[:6] / binned["error.bins.zero"][:6]
    assert np.abs(z).max() < 4


def test_errors_are_those_of_means_and_shares() -> None:
    n = 4 * uniform(4000)
    exact = torch.poisson(n, generator=generator(3))
    found = with_errors("x", compare, n, exact)
    assert found["error.x.mean_N"] == pytest.approx(float(exact.std()) / 4000**0.5, rel=0.5)
    share = found["x.zero"]
    assert found["error.x.zero"] == pytest.approx((share * (1 - share) / 4000) ** 0.5, rel=0.5)
    assert with_errors("x", compare, n + 1, exact)["error.x.wrongly_lit"] == 1 / 4000  # none of that kind


def test_other_laws_and_biases_show() -> None:
    n = 0.5 + 5 * uniform(20_000)
    found = compare(n, 3 * torch.poisson(n / 3, generator=generator(1)))
    assert found["scatter"] == pytest.approx(3**0.5, abs=0.06)
    assert found["zero"] > found["exp"] + 0.1
    biased = compare(1.1 * n, torch.poisson(n, generator=generator(2)))
    assert biased["bias"] == pytest.approx(0.1, abs=0.02)
    assert biased["scatter"] == pytest.approx(1.0, abs=0.03)  # about the mean at given n
    assert compare(n, n.round())["scatter"] < 0.3


def test_without_the_term_for_the_spread_more_is_crossed() -> None:
    grid = uneven()
    origin = grid.low + (grid.high - grid.low) * uniform(50, 3)
    direction = 2 * uniform(50, 3, seed=1) - 1
    plain, rooted = grid.crossings(origin, direction), counts.rooted(grid)(origin, direction)
    assert bool((rooted > plain).all()) and float(((rooted - plain) / plain).max()) < 0.12
    by_torch = counts.rooted(uneven(mode="eager"))(origin, direction)
    assert torch.allclose(by_torch, rooted, rtol=1e-5)
    assert torch.equal(grid.crossings(origin, direction), plain)


def test_a_small_run(data: Data) -> None:
    arrays = data.arrays
    assert arrays["counts.bias"].shape == (2, 2, 2) and data.record["points"] == ["fibres", "seen"]
    error = np.maximum(5 * arrays["error.counts.bias"], 0.1)
    assert (np.abs(arrays["counts.bias"]) < error).all()
    step = arrays["steps.rms"]
    assert (step[..., 2] < step[..., 0]).all() and (step[..., 0] < 0.1 * arrays["counts.mean_n"]).all()
    point, half, rooted = np.moveaxis(arrays["others.bias"], -1, 0)
    assert (half < point).all() and (arrays["counts.bias"] < rooted).all()
    assert (arrays["speed.nanoseconds"] > 0).all()


def test_pictures_and_tables_are_made_from_the_data(data: Data) -> None:
    assert set(drawing.figures(data, Page(150.0))) == {"grid", "lit"}
    tables = {table.name: table for table in drawing.tables(data)}
    assert {name: len(table.rows) for name, table in tables.items()} == {
        "counts": 8, "lit": 8, "others": 8, "steps": 8, "speed": 4
    }  # fmt: skip
    assert not any("nan" in cell for table in tables.values() for row in table.rows for cell in row)


def test_what_reproduced_means(data: Data) -> None:
    rules = counts.EXPERIMENT.reproduces
    assert verified(data, data, rules)["verdict"] == "agrees"
    for name, factor, verdict in (("counts.mean_N", 1.1, "agrees"), ("counts.mean_N", 9.0, "deviates"),
                                  ("speed.nanoseconds", 9.0, "agrees"), ("voxels", 2, "deviates")):  # fmt: skip
        other = dataclasses.replace(data, arrays={**data.arrays, name: data.arrays[name] * factor})
        assert verified(other, data, rules)["verdict"] == verdict, name


def test_points_lie_on_fibres() -> None:
    strands = counts._strands("block", 200)
    origin, direction, own, radius = counts.on_fibres(strands, 200)
    near = (strands.points[None] - origin[:, None]).norm(dim=-1).argmin(-1)
    assert float((strands.strand_of_point[near] == own).to(F64).mean()) > 0.95
    assert torch.allclose(direction.norm(dim=-1), torch.ones(200, dtype=F64))
    assert float(radius.min()) >= float(strands.radius.min()) and float(radius.max()) <= float(strands.radius.max())
