"""Heuristics against fits: shares sum to one, excess agrees with its definition, drawing."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dsfit import excess as quadrature_excess
from dsfit.experiment.heuristic_mix import best_mix
from dsfit.experiment.methods import Setting, structured_start
from dsfit.experiment.plots.style import styled
from dsfit.figures import Data, catalogue
from dsfit.figures.data import read_data, write_data
from dsfit.figures.experiment import Work
from dsfit.figures.page import Page
from dsfit.proposals import AmortisedProposal
from experiments._heuristics_fits_lobes import (
    GROUPS,
    amortised_lobes,
    fitted_shapes,
    fitted_weights,
    group,
    mix_weights,
)
from experiments._mis_spot import integrand, proposals
from experiments.drawing import heuristics_fits as drawing
from experiments.heuristics_fits import EXPERIMENT, METHODS, context, contexts, excess

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def setting() -> Setting:
    return Setting(None, integrand("brown"), context(35.0, 1.0))  # type: ignore[arg-type]


def test_shares_of_every_kind_sum_to_one(setting: Setting) -> None:
    mix = best_mix(setting, list(proposals("brown").values()))
    assert mix_weights(list(proposals("brown")), mix.fractions).sum() == pytest.approx(1, abs=1e-12)
    start = structured_start(setting.integrand, setting.context)
    assert fitted_weights(start).sum() == pytest.approx(1, abs=1e-12)
    weights, shapes = amortised_lobes(AmortisedProposal(setting.integrand.bsdf), context([-60.0, 0.0, 70.0], [1, 0, 9]))
    assert weights.shape == (3, len(GROUPS)) and shapes.shape == (3, len(GROUPS), 3)
    assert weights.sum(1) == pytest.approx(1, abs=1e-9)
    assert weights[1, [GROUPS.index(f"{x}_scattered") for x in ("R", "TT", "TRT")]].sum() == pytest.approx(0, abs=1e-9)


def test_components_find_their_group() -> None:
    assert [GROUPS[group(x)] for x in ("M_TT", "MG_R", "R_scattered_low", "front", "back", "transmittance_cosine")] == [
        "TT", "R_scattered", "R_scattered", "broad", "back", "broad",
    ]  # fmt: skip


def test_shapes_are_those_of_the_components(setting: Setting) -> None:
    start = structured_start(setting.integrand, setting.context)
    shapes = fitted_shapes(start)
    lobe = start.components[start.names.index("TT")].longitudinal
    values = [math.degrees(float(getattr(lobe, key)().detach())) for key in ("mode", "below", "above")]
    assert shapes[GROUPS.index("TT")] == pytest.approx(values)
    assert (shapes[:, 1:] > 0).all()


def test_excess_agrees_with_the_library(setting: Setting) -> None:
    start = structured_start(setting.integrand, setting.context)
    expected = quadrature_excess(setting.integrand, start, setting.context)
    assert excess(setting, [start]) == pytest.approx(float(expected.value), rel=2e-2, abs=1e-5)


def test_order_of_the_methods_that_must_hold(setting: Setting) -> None:
    modules = list(proposals("brown").values())
    mix = best_mix(setting, modules)
    used = [k for k, share in enumerate(mix.fractions) if share > 0]
    equal = [1 / len(modules)] * len(modules)
    mixed = excess(setting, [modules[k] for k in used], [mix.fractions[k] for k in used], mix.heuristic, mix.model)
    balance = excess(setting, modules, equal)
    assert mixed <= 1.01 * balance
    assert excess(setting, modules, equal, "optimal") <= balance
    start = structured_start(setting.integrand, setting.context)
    wrong = structured_start(setting.integrand, context(-35.0, 1.0))
    assert 0 <= excess(setting, [start]) < excess(setting, [wrong])


def made_up() -> Data:
    """Data of the shape that the experiment stores."""
    rng = np.random.default_rng(1)
    settings = catalogue.find(ROOT, "heuristics_fits").settings(("n=[0.0, 1.0, 8.0]", "theta_r_deg=[-60.0, 0.0, 60.0]"))
    where = np.array([at for part in contexts(settings).values() for at in part])
    arrays: dict[str, Any] = {}
    for preset in settings.presets:
        arrays[f"{preset}.contexts"] = where
        arrays[f"{preset}.excess"] = 10 ** rng.uniform(-4, 2, (len(where), len(METHODS)))
        arrays[f"{preset}.excess"][0, 4] = -0.01
        for key in ("error", "error_se", "seconds"):
            arrays[f"{preset}.timed.{key}"] = 10 ** rng.uniform(-3, -2, (len(METHODS), len(settings.timed_samples)))
        for part, points in (("theta_r", settings.theta_r_deg), ("n", settings.n)):
            arrays[f"{preset}.{part}.dense"] = np.linspace(min(points), max(points), 7)
            for kind, count in (("mix", 3), ("fitted", 3), ("amortised", 7)):
                arrays[f"{preset}.{part}.{kind}"] = rng.dirichlet(np.ones(len(GROUPS)), count)
            arrays[f"{preset}.{part}.shape"] = rng.uniform(1, 9, (3, len(GROUPS), 3))
            arrays[f"{preset}.{part}.amortised_shape"] = rng.uniform(1, 9, (7, len(GROUPS), 3))
    seconds = {key: 0.5 for key in ("training", "nodes", "mix", "start", "fit", "amortised")}
    record = {**settings.model_dump(), "methods": list(METHODS), "groups": list(GROUPS),
              "seconds": {preset: seconds for preset in settings.presets}}  # fmt: skip
    return Data(arrays, record)


def test_data_are_drawn_and_tabulated(tmp_path: Path) -> None:
    write_data(tmp_path, made_up())
    data = read_data(tmp_path)
    with styled():
        found = drawing.figures(data, Page())
    assert set(found) == {"excess", "time", *(f"{x}_{p}" for x in ("shares", "shapes") for p in ("blond", "brown"))}
    tables = {table.name: table for table in drawing.tables(data)}
    assert set(tables) == {"excess", "costs", "agreement"}
    first = data.arrays["blond.excess"]
    assert tables["excess"].rows[0][2] == f"{np.median(first[:, 0]):.2g}"


@pytest.mark.slow
def test_a_small_run_improves_on_the_heuristics(tmp_path: Path) -> None:
    settings = catalogue.find(ROOT, "heuristics_fits").settings((*EXPERIMENT.small, "max_steps=15"))
    data = EXPERIMENT.compute(settings, Work(tmp_path, ROOT, lambda what: None))
    found = data.arrays["blond.excess"]
    index = {name: k for k, name in enumerate(METHODS)}
    assert (found[:, index["fitted"]] <= found[:, index["structured start"]]).all()
    assert (found[:, index["fitted"]] < 0.1 * found[:, index["best mix"]]).all()
    for kind in ("mix", "fitted", "amortised"):
        assert data.arrays[f"blond.theta_r.{kind}"].sum(-1) == pytest.approx(1, abs=1e-6)
    write_data(tmp_path, data)
    with styled():
        assert drawing.figures(read_data(tmp_path), Page())
