"""The experiment `stochastic_fit`: curves of fits, standard errors over seeds, and a small run from end to end."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from dsfit.errors import InputError
from dsfit.figures import Data, Work
from dsfit.figures.catalogue import find
from dsfit.figures.data import read_data, write_data
from dsfit.figures.page import Page
from dsfit.figures.verify import compare
from experiments import _stochastic_fit_runs as runs
from experiments import stochastic_fit
from experiments.drawing import stochastic_fit as drawing

ROOT = Path(__file__).parents[2]


def test_a_fit_that_ended_early_stays_where_it_ended() -> None:
    long, short = [(0, 0.0, 1.0), (10, 1.0, 0.1), (20, 2.0, 0.01)], [(0, 0.0, 1.0), (10, 1.5, 0.2)]
    found = runs.together([[long, short]])
    assert found["evaluations"].tolist() == [[[0, 10, 20], [0, 10, 10]]]
    assert found["log10_excess"][0, 1].tolist() == pytest.approx([0, math.log10(0.2), math.log10(0.2)])
    assert found["seconds"][0, 1, 2] == 1.5
    assert (found["log10_excess_error"][0, :, 0] == 0).all() and found["log10_excess_error"][0, 0, 1] > 0


def test_errors_are_the_spread_of_seeds_own_or_pooled() -> None:
    values = np.array([[0.0, 2.0, 4.0], [1.0, 1.0, 1.0]])
    error = runs.spread(values)
    assert error[0].tolist() == pytest.approx([2.0] * 3)  # its own
    assert error[1].tolist() == pytest.approx([math.sqrt(2.0)] * 3)  # these seeds happen to agree
    assert runs.spread(values[:, :1]).tolist() == [[0.0], [0.0]]


def test_samples_that_were_only_drawn_are_not_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    def fake(start, radiance, context, seed, watch, **options):
        for step in range(3):
            watch(SimpleNamespace(step=step, evaluations=100 * (step + 1), seconds=0.0), start)
        return SimpleNamespace(evaluations=300, seconds=0.0, proposal=start)

    monkeypatch.setattr(runs, "fit_stochastic", fake)
    curve = runs.by_samples(None, None, None, lambda proposal: 0.5, 0, True)
    assert [used for used, _, _ in curve] == [100, 200, 300] and all(excess == 0.5 for _, _, excess in curve)


def test_noise_has_to_be_known(tmp_path: Path) -> None:
    settings = find(ROOT, "stochastic_fit").settings(
        ('scenes=[{preset="blond", theta_r_deg=0.0, n=0.0, noise="loud"}]',)
    )
    with pytest.raises(InputError, match=r"scenes.0.noise.*lognormal or roulette"):
        stochastic_fit.compute(settings, Work(tmp_path, ROOT, lambda what: None))


def _data() -> Data:
    """Two scenes, the second noisy, as a run stores them."""
    scenes = [
        {"preset": "blond", "theta_r_deg": 45.0, "n": 3.0, "light_width_deg": 3.0, "noise": None, "parameters": 21},
        {"preset": "blond", "theta_r_deg": 45.0, "n": 3.0, "light_width_deg": None, "noise": "roulette",
         "parameters": 20},
    ]  # fmt: skip
    curve = [[(512, 1.0, 0.02 * f), (1024, 2.0, 0.01 * f)] for f in (1.0, 1.5, 2.0)]
    arrays = {"start": np.array([0.1, 0.1])}
    arrays |= {f"quadrature.{key}": np.full(2, v) for key, v in
               (("excess", 0.01), ("evaluations", 9000.0), ("seconds", 1.0))}  # fmt: skip
    for name, where in (("gauss_newton", [0, 1]), ("two_draws", [1]), ("adam", [0, 1])):
        found = runs.together([[c[-1:] for c in curve] if name == "adam" else curve] * len(where))
        arrays |= {f"{name}.scenes": np.array(where)} | {f"{name}.{key}": v for key, v in found.items()}
    arrays |= {"stream.evaluations": np.array([0.0, 20480.0]), "stream.seconds": np.ones((3, 2))}
    for name in ("median", "worst"):
        arrays |= {f"stream.log10_{name}": np.full((3, 2), -2.0), f"stream.log10_{name}_error": np.full((3, 2), 0.1)}
    for k, name in enumerate(("low", "factor", "high")):
        arrays[f"gradients.log10_{name}"] = np.array([0.0, 2.0]) + 0.2 * (k - 1)
    arrays["gradients.error"] = np.full(2, 0.1)
    return Data(arrays, {"scenes": scenes, "plans": ["plain", "replay"], "seeds": 3})


def test_table_has_medians_and_ranges() -> None:
    ends, gradients = drawing.tables(_data())
    assert [row[:2] for row in ends.rows] == [
        ["blond 45°, n = 3, 3° light", "Gauss-Newton"],
        ["blond 45°, n = 3, 3° light", "Adam"],
        *(["blond 45°, n = 3, roulette", name] for name in drawing.METHODS.values()),
    ]
    assert ends.rows[0][2:] == ["0.1", "0.01", "0.015", "0.01 to 0.02", "9000", "1024", "2"]
    assert gradients.rows[1] == ["replay", "100", "63.1", "158"]


def test_pictures_are_drawn_from_the_data() -> None:
    figures = drawing.figures(_data(), Page(150.0))
    assert set(figures) == {"progress", "noise", "ends", "stream_gradients"}
    for figure in figures.values():
        figure.draw_without_rendering()


def test_other_seeds_agree_and_other_fits_do_not() -> None:
    rules, data = stochastic_fit.EXPERIMENT.reproduces, _data()
    fits, factor = "gauss_newton.log10_excess", "gradients.log10_factor"
    for name, shift, verdict in ((fits, 0.2, "agrees"), (fits, 2.0, "deviates"),
                                 ("stream.log10_worst", 0.1, "agrees"), ("stream.log10_worst", 1.0, "deviates"),
                                 (factor, 0.1, "agrees"), (factor, 1.0, "deviates"),
                                 ("adam.seconds", 5.0, "agrees"), ("start", 0.01, "deviates")):  # fmt: skip
        other = dataclasses.replace(data, arrays={**data.arrays, name: data.arrays[name] + shift})
        assert compare(other, data, rules)["verdict"] == verdict, (name, shift)


@pytest.mark.slow
def test_a_small_run(tmp_path: Path) -> None:
    pytest.importorskip("optimistix")
    settings = find(ROOT, "stochastic_fit").settings(stochastic_fit.EXPERIMENT.small)
    write_data(tmp_path, stochastic_fit.compute(settings, Work(tmp_path, ROOT, lambda what: None)))
    data = read_data(tmp_path)
    assert compare(data, data, stochastic_fit.EXPERIMENT.reproduces)["verdict"] == "agrees"
    assert data.arrays["gauss_newton.evaluations"].shape == (2, 2, 2)
    assert data.arrays["quadrature.excess"][0] < data.arrays["start"][0]
    assert drawing.figures(data, Page(150.0)) and drawing.tables(data)[0].rows
