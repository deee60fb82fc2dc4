"""Errata, planted faults, the stability atlas and stiff fits as experiments, from findings of single parts."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dsfit.checks import controls, stability
from dsfit.checks.controls import TYPOS
from dsfit.checks.stability.function import CLASSES
from experiments.planted_faults import strongest
from tests.experiments.canned_runs import Canned, Run, check_result, column, data_of, drawn


def test_errata_tell_rejection_and_effect(tmp_path: Path) -> None:
    found = [f.to_dict() for name in ("cosine_cdf", "density_twice") for f in controls.run(name, seed=1).findings]
    work = Canned({"controls.toml": Run(check_result("controls", found))})
    data = data_of("errata", work, tmp_path, ('controls=["cosine_cdf", "density_twice"]',))
    assert work.asked[0].check.controls.controls == ["cosine_cdf", "density_twice"]
    assert [label.split()[-1] for label in data.record["controls"]] == ["density_twice", "cosine_cdf"]
    assert data.arrays["ratio"][0] == pytest.approx(0.957, abs=1e-3) and math.isnan(data.arrays["ratio"][1])
    assert (data.arrays["decades"] > data.arrays["needed"]).all() and (data.arrays["decades"] <= 16).all()
    figures, tables = drawn("errata", data)
    assert len(tables["errata"].rows) == 2 + len(TYPOS)
    assert "not a density: P(π) = 4" in column(tables["errata"], "measured effect")
    assert len(figures["errata"].axes[0].get_yticklabels()) == 2


def test_all_errata_are_named_in_the_settings_as_all(tmp_path: Path) -> None:
    found = [f.to_dict() for f in controls.run("cosine_cdf", seed=1).findings]
    work = Canned({"controls.toml": Run(check_result("controls", found))})
    data_of("errata", work, tmp_path)
    assert work.asked[0].check.controls.controls == "all"


def test_what_a_fault_showed() -> None:
    where, found = strongest("R + TT + TRT + remainder = 1, lossless: 0.043 > 1e-09")
    assert where == "R + TT + TRT + remainder = 1, lossless"
    assert (found["deviation"], found["bound"]) == (0.043, 1e-9) and math.isnan(found["decades"])
    where, found = strongest("TT, balance, one-sample: p = 2e-17")
    assert where == "TT, balance, one-sample" and found["decades"] == pytest.approx(16.7, abs=0.01)
    assert strongest("proposal: p = 0")[1]["decades"] == 300
    assert strongest("nothing reported")[0] == "nothing reported"


def fault(name: str, failed: int, text: str, quiet: bool = True) -> list[dict[str, Any]]:
    data = {"module": "m", "slip": "s", "suite": "furnace", "expected": True, "failed": failed, "strongest": text}
    healthy = {"subject": f"not {name}", "value": 0.0 if quiet else 1.0, "data": {}}
    return [{"subject": name, "value": 0.0, "data": data}, healthy]


def test_faults_caught_missed_and_feigned(tmp_path: Path) -> None:
    found = [*fault("a", 2, "mass: 0.1 > 1e-05"), *fault("b", 0, "nothing reported"), *fault("c", 1, "x: p = 0", False)]
    work = Canned({"faults.toml": Run(check_result("faults", found))})
    data = data_of("planted_faults", work, tmp_path)
    _, tables = drawn("planted_faults", data)
    measured = column(tables["faults"], "measured")
    assert measured == ["mass: 0.1 > 1e-05", "nothing reported", "x: p < 1e-300 (also without the slip)"]
    assert tables["suites"].rows == [["furnace", "3", "2", "3"]]
    assert "2 caught" in tables["faults"].caption and "but where marked" in tables["faults"].caption


def test_atlas_has_the_worst_of_each_function_and_class(tmp_path: Path) -> None:
    found = [f.to_dict() for name in ("mis.balance", "frame.wrap") for f in stability.run(name, seed=1).findings]
    wanted = {"class": "tail", "dtype": "float64", "quantity": "value"}
    mine = [f for f in found if f["subject"] == "mis.balance" and wanted.items() <= f["data"].items()]
    mine[-1]["data"]["worst"], mine[-1]["value"], mine[-1]["data"]["zero"] = 0.5, 0.5, 3
    work = Canned({"stability.toml": Run(check_result("stability", found))})
    data = data_of("stability_atlas", work, tmp_path)
    row, tail = data.record["functions"].index("mis.balance"), list(CLASSES).index("tail")
    assert data.arrays["error.float64.value"][row, tail] == 0.5
    assert data.arrays["fault.float64.value"][row, tail] == 1 and data.arrays["beyond.float64.value"][row, tail]
    assert [name for name, _ in data.record["classes"]] == list(CLASSES)
    figures, tables = drawn("stability_atlas", data)
    assert set(figures) >= {"families", "atlas_float64", "atlas_float32", "naive_float64"}
    regimes = {cells[0].partition(":")[0]: cells[1:] for cells in tables["regimes"].rows}
    assert regimes["tail"][0] == "5.0e-01 mis.balance" and regimes["dark"] == [""] * 4
    assert column(tables["functions"], "function") == ["mis.balance", "frame.wrap"]
    assert "nan" not in tables["functions"].markdown()


def stiff(case: str, solver: str, objective: float, **data: Any) -> dict[str, Any]:
    facts = {
        "solver": solver, "refused": False, "start": 2.0, "optimum": 1.0, "objective": objective, "converged": True,
        "solved": objective < 1.01, "evaluations": 10, "seconds": 0.5, **data,
    }  # fmt: skip
    return {"case": case, "subject": solver, "value": data.get("faults", 0.0), "data": facts}


def test_stiff_fits_tell_what_is_left(tmp_path: Path) -> None:
    found = [
        stiff("easy", "optimistix.lm", 1.0),
        stiff("easy", "torch.adam", 1.01, converged=False),
        stiff("hard", "torch.adam", 2.0, faults=1.0),
        stiff("hard", "optimistix.lm", 1.0, refused=True),
        {"case": "liar", "subject": "liar", "value": 0.0, "data": {}},
    ]
    work = Canned({"stiff_fits.toml": Run(check_result("stiff_fits", found))})
    data = data_of("stiff_fits", work, tmp_path)
    assert data.record["problems"] == ["easy", "hard"]
    np.testing.assert_allclose(data.arrays["left"], [[-6, -2], [math.nan, 0]], atol=1e-9)
    assert data.arrays["faults"].tolist() == [[0, 0], [0, 1]]
    figures, tables = drawn("stiff_fits", data)
    assert column(tables["solvers"], "solver") == ["optimistix.lm", "torch.adam"]
    assert column(tables["solvers"], "false claims / %") == ["0", "50"]
    assert len(figures["stiff_fits"].axes[0].lines) == 2  # a dot and a cross
