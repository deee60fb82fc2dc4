"""Response maps: what is stored of a map, what is drawn of it, and a small run."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dsfit.figures import Data, Work
from dsfit.figures.data import read_data, write_data
from dsfit.figures.page import Page
from experiments.drawing import response_maps as drawing
from experiments.response_maps import ResponseMaps, _integral, _keep, compute


def _maps(steps: int = 121) -> dict[str, np.ndarray]:
    """A lobe around theta = 0 and, as its proposal, the uniform sphere."""
    theta, phi = np.linspace(-90, 90, steps), np.linspace(-180, 180, steps)
    lobe = np.exp(-((theta / 20) ** 2))[:, None] * (1 + 0.5 * np.cos(np.radians(phi)))
    found = {"theta_deg": theta, "phi_deg": phi, "integrand": lobe, "density_2": np.full_like(lobe, 1 / (4 * np.pi))}
    found["integrand"] = lobe / _integral(found, "integrand")
    return found


def test_integral_is_over_solid_angle():
    maps = _maps()
    assert _integral(maps, "density_2") == pytest.approx(1, abs=1e-4)
    assert _integral({**maps, "integrand": np.cos(np.radians(maps["theta_deg"]))[:, None] + 0 * maps["integrand"]},
                     "integrand") == pytest.approx(np.pi**2, rel=1e-4)  # fmt: skip


@pytest.mark.parametrize("thin", [1, 2, 4])
def test_what_is_kept_gives_integrand_and_proposal_back(thin: int):
    maps, arrays = _maps(), {}
    _keep(arrays, "matrix.cell", maps, thin)
    data = Data(arrays, {})
    some = slice(None, None, thin)
    shown = maps["integrand"][some, some] > 1e-5 * maps["integrand"].max()
    for kind, name in (("integrand", "integrand"), ("fitted", "density_2")):
        found = drawing._values(data, "matrix.cell", kind)
        assert found[shown] == pytest.approx(maps[name][some, some][shown], rel=6e-3)  # float16 of a logarithm
    assert arrays["theta_deg"][[0, -1]].tolist() == [-90, 90] and arrays["matrix.cell.ratio"].dtype == np.float16


def _record(settings: ResponseMaps, names: list[tuple[str, float, float, float]]) -> dict:
    cells = {}
    for name, section, n, phi in names:
        methods = {k: {"excess": e, "excess_error": 0.0, "largest_weight": 1 + e}
                   for k, e in (("uniform", 1.0), ("mix", 0.1), ("fitted", 0.001))}  # fmt: skip
        cells[name] = {"eccentricity": section, "n": n, "phi_r_deg": phi, "mean_weight": 1.0,
                       "mean_weight_error": 0.001, **methods}  # fmt: skip
    return {**settings.model_dump(), "cells": cells}


def test_drawn_from_data_alone():
    settings = ResponseMaps(eccentricities=[0.9, 1.0], n=[0.0, 3.0], turned_phi_r_deg=[0.0, 60.0])
    names = [(f"matrix.e{e:g}-n{n:g}-phi40", e, n, 40.0) for e in (0.9, 1.0) for n in (0.0, 3.0)]
    names += [(f"turned.e0.85-n1-phi{phi:g}", 0.85, 1.0, phi) for phi in (0.0, 60.0)]
    arrays: dict[str, np.ndarray] = {}
    for name, *_ in names:
        _keep(arrays, name, _maps(31), 2)
    data = Data(arrays, _record(settings, names))
    made = drawing.figures(data, Page())
    assert set(made) == {"integrands", "against-round", "eccentricity-0.9", "eccentricity-1", "azimuths"}
    matrix, turned = drawing.tables(data)
    assert [len(table.rows) for table in (matrix, turned)] == [4, 2]
    assert matrix.rows[0][:6] == ["0.9", "0", "40", "1", "0.1", "1.0e-03"]


@pytest.mark.slow
def test_small_run(tmp_path: Path):
    pytest.importorskip("jax")
    root = Path(__file__).parents[2]
    settings = ResponseMaps(eccentricities=[1.0], n=[3.0], turned_phi_r_deg=[], max_steps=8, checked=1024)
    write_data(tmp_path, compute(settings, Work(tmp_path, root, lambda what: None)))
    data = read_data(tmp_path)
    ((name, cell),) = data.record["cells"].items()
    assert cell["map_integrals"]["integrand"] == pytest.approx(1, abs=0.01)
    assert cell["map_integrals"]["fitted"] == pytest.approx(1, abs=0.02)
    assert abs(cell["mean_weight"] - 1) < 5 * cell["mean_weight_error"] < 0.02
    assert cell["fitted"]["excess"] < cell["mix"]["excess"] < cell["uniform"]["excess"]
    # a round section and constant light: even in the relative azimuth
    log = data.arrays[f"{name}.integrand"].astype(float)
    assert log == pytest.approx(log[:, ::-1], abs=2e-3)
    # the spread of weights that were drawn is the excess
    spread = cell["mean_weight_error"] ** 2 * settings.checked
    assert spread == pytest.approx(cell["fitted"]["excess"], rel=0.5)
