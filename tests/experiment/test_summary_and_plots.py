"""Tables and figures of stored results, from numbers made up here."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from dsfit.experiment import plots, summary
from dsfit.experiment.plots.maps import _different
from dsfit.experiment.plots.style import short, spread
from dsfit.experiment.rundir import RunDirectory


def method(
    name: str, kind: str, excess: Any, seconds: Any, fit: float = 0.0, rule: str | None = None
) -> dict[str, Any]:
    variance = "inf" if excess == "inf" else max(excess, 0) + 0.01
    estimates = [
        {
            "samples": n,
            "repeats": 8,
            "rmse": 1 / n**0.5,
            "rmse_error": 0.1 / n**0.5,
            "predicted_rmse": 1.1 / n**0.5,
            "claimed_rmse": 1 / n**0.5,
            "bias": 0.0,
            "seconds": [n * 1e-5, n * 1.1e-5, n * 1.3e-5],
        }
        for n in (16, 64)
    ]
    return {
        "name": name,
        "kind": kind,
        "excess": excess,
        "largest_weight": 2.0,
        "variance": variance,
        "weights_rule": rule,
        "predicted_over_measured": 1.1,
        "seconds_per_sample": 1e-5,
        "seconds_to_1_percent": seconds,
        "fit": {"seconds": fit} if fit else None,
        "estimates": estimates,
    }


def result(cells: int = 2, methods: int = 4) -> dict[str, Any]:
    def cell(index: int) -> dict[str, Any]:
        found = [
            method("uniform", "uniform", 2.0, 1.0),
            method("best", "heuristic_mix", 0.1 * (index + 1), 0.1, 2.0, "best"),
            method("fitted", "fitted", 0.001, 0.01, 5.0),
            method("front only", "single", "inf", "inf"),
            *(method(f"more {k}", "single", -0.01, 0.5) for k in range(methods - 4)),
        ]
        context = {"theta_r_deg": 10.0 * index, "phi_r_deg": 0.0, "n": 1.0, "v": None}
        identity = {"grid": {"fiber.eta": 1.4 + 0.1 * (index % 2)}, "context": context}
        return {"index": index, "label": f"blond, θr {10 * index}°", "identity": identity, "methods": found}

    return {
        "name": "made-up",
        "title": "Made up",
        "kind": "sweep",
        "config": {"estimate": {"dtype": "float64", "repeats": 8}, "output": {"maps": 1}},
        "provenance": {"sessions": [{"workers": 2}]},
        "cells": [cell(i) for i in range(cells)],
    }


def test_rows_are_medians_worst_cases_and_ratios_within_cells() -> None:
    uniform, best, fitted, front = summary.rows(result()["cells"])
    assert best["excess_median"] == pytest.approx(0.15) and best["excess_worst"] == pytest.approx(0.2)
    assert fitted["speedup_over_uniform"] == pytest.approx(100) and fitted["speedup_over_best_mix"] == pytest.approx(10)
    assert fitted["excess_below_best_mix"] == pytest.approx(150)
    assert fitted["excess_below_best_mix_worst"] == pytest.approx(100)
    assert fitted["seconds_to_1_percent_with_fit"] == pytest.approx(5.01) and fitted["fit_seconds"] == 5
    # against uniform, the fastest without a fit: 5 s / (1 s - 0.01 s)
    assert fitted["pays_after"] == math.ceil(5 / 0.99) and math.isnan(uniform["pays_after"])
    assert math.isinf(front["excess_worst"]) and front["speedup_over_uniform"] == 0


def test_the_table_is_text_everyone_can_read() -> None:
    console = Console(width=170, record=True, file=open("/dev/null", "w"))  # noqa: SIM115
    console.print(summary.terminal_table(result()))
    text = console.export_text()
    assert all(word in text for word in ("Made up (2 contexts)", "fitted", "inf", "10 ms", "5.01 s"))
    lines = summary.markdown(result()).splitlines()
    table = [line for line in lines if line.startswith("|")]
    assert len(table) == 6 and len({line.count("|") for line in table}) == 1


@pytest.mark.parametrize(("cells", "methods"), [(2, 4), (9, 12)])
def test_figures_are_drawn_whatever_the_number_of_cells_and_methods(tmp_path: Path, cells: int, methods: int) -> None:
    data, directory = result(cells, methods), RunDirectory(tmp_path)
    shape = (11, 13)
    arrays = {f"density_{k}": np.full(shape, 0.1 * (k + 1), dtype=np.float32) for k in range(methods)}
    arrays |= {
        "integrand": np.ones(shape),
        "theta_deg": np.linspace(-90, 90, 11),
        "phi_deg": np.linspace(-180, 180, 13),
    }
    for cell in data["cells"]:
        directory.write_cell(cell["index"], cell, arrays)
    written = {p.name for p in plots.draw_all(directory, data)}
    expected = {"convergence.png", "excess.png", "maps-0000.png"} | ({"sweep.png"} if cells > 1 else set())
    assert {name for name in written if name.endswith("png")} == expected
    assert {name.replace("png", "pdf") for name in expected} < written


def test_the_same_density_is_drawn_once() -> None:
    same = np.ones((2, 2))
    assert _different({"density_0": same, "density_1": same, "density_2": 2 * same}, 3) == [0, 2]


def test_small_helpers() -> None:
    assert spread(3, 6) == [0, 1, 2] and spread(36, 6) == [0, 7, 14, 21, 28, 35] and spread(5, 1) == [0]
    assert short("a" * 50, 20).startswith("aaaa") and len(short("a" * 50, 20)) <= 20 and short("abc", 20) == "abc"
    assert [summary._short(x) for x in (0.0, 1.234, 12345.0, math.inf, math.nan)] == [
        "0",
        "1.23",
        "1.2e+04",
        "inf",
        "-",
    ]
    assert [summary._time(x) for x in (2.0, 0.0123, 4.5e-6, 3e-9)] == ["2 s", "12.3 ms", "4.5 us", "3 ns"]


def test_labels_of_minor_ticks_stay_formulas(tmp_path: Path) -> None:
    from dsfit.experiment.plots.style import new_figure, save

    figure = new_figure(3.0, 3.0)
    axes = figure.subplots()
    axes.plot([0, 1], [4, 9])
    axes.set(yscale="log", title="costs $1 to $2")
    save(figure, tmp_path, "ticks")
    labels = axes.yaxis.get_ticklabels(minor=True)
    assert any("$" in label.get_text() for label in labels)
    assert all(label.get_parse_math() for label in labels)
    assert not axes.title.get_parse_math()


def test_a_pipe_in_a_name_does_not_part_cells() -> None:
    data = result()
    for cell in data["cells"]:
        cell["methods"][2]["name"] = "fit | all"
    line = next(line for line in summary.markdown(data).splitlines() if "fit \\" in line)
    assert line.startswith("| fit \\| all | ") and line.replace("\\|", "").count("|") == 13
