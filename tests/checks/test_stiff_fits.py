"""The stiff fits suite: its judgement of honest and lying solvers, and the problems that are quick."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from dsfit.checks import stiff_fits
from dsfit.checks.stiff_fits.cases import Limits, toy_case
from dsfit.checks.stiff_fits.compare import compare
from dsfit.checks.stiff_fits.examine import FALSE_CLAIM, examine, gradient_of, shown_gain
from dsfit.checks.stiff_fits.fits import FITS, gaussian_cases, gaussians, mass, nodes_of, one_context
from dsfit.checks.stiff_fits.liars import LIARS, LIMITS, SOLVER, caught, honest_case, is_caught
from dsfit.checks.stiff_fits.toys import TOYS
from dsfit.errors import InputError
from dsfit.fit.solvers import SOLVERS

pytest.importorskip("jax")
QUICK = ["optimistix.lm", "torch.lbfgs", "torch.adam"]


@pytest.fixture(scope="module")
def control():
    return honest_case()


def test_an_honest_solver_has_no_fault(control):
    seen = examine(control, SOLVER, LIMITS)
    assert seen.faults == [] and seen.steps == 1 and not seen.converged and seen.shown > 0.1
    assert seen.mass == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize("liar", LIARS, ids=lambda liar: liar.name)
def test_every_liar_is_caught_by_name(liar, control):
    seen = caught(liar, control)
    assert is_caught(liar, seen), seen.faults


def test_controls_part_reports_what_was_caught_and_what_was_not(monkeypatch):
    outcome = stiff_fits.run("controls", seed=1)
    assert [f.verdict(0.01) for f in outcome.findings] == ["pass"] * (1 + len(LIARS))
    harmless = replace(LIARS[0], name="does nothing", spoil=lambda case, solved: solved)
    monkeypatch.setattr(stiff_fits, "LIARS", (harmless,))
    assert [f.verdict(0.01) for f in stiff_fits.run("controls", seed=1).findings] == ["pass", "fail"]


@pytest.mark.parametrize("name", list(TOYS))
@pytest.mark.parametrize("solver", QUICK)
def test_toys(name, solver):
    (case,) = TOYS[name]()
    seen = examine(case, solver, Limits())
    assert seen.faults == []
    if solver == "torch.lbfgs":
        assert seen.solved, seen
    assert math.isfinite(seen.objective) and seen.objective <= seen.start


@pytest.mark.parametrize("name, solved", [("width_10", True), ("twin_lobes", True), ("width_1e-4", False)])
def test_gaussian_fits(name, solved):
    for case in FITS[name]():
        if case.objective in ("excess", "log_excess"):
            solver = "optimistix.lm" if case.objective == "excess" else "torch.lbfgs"
            seen = examine(case, solver, Limits())
            # A lobe that falls between the nodes cannot be seen by any fit, which stays where it is and says so.
            assert seen.faults == [] and seen.solved == solved, seen


def test_scale_of_the_integrand_does_not_matter():
    seen = []
    for scale in (1.0, 1e-290):
        cases = gaussian_cases(
            lambda: gaussians([(1.0, 0.0, 0.5)]), [(1.0, 0.2, 0.15)], "scale", scale, objectives=("excess",)
        )
        seen.append(examine(cases[0], "optimistix.lm", Limits()))
    assert seen[0].objective == pytest.approx(seen[1].objective, rel=1e-6) and seen[0].solved


def test_density_that_vanishes_is_said():
    excess = FITS["misses_support"]()[0]
    seen = examine(excess, "optimistix.lm", Limits())
    assert seen.faults == [] and not seen.converged and "vanishes at" in seen.reason and math.isinf(seen.objective)


def test_zero_integrand_is_refused_by_name():
    (case,) = FITS["zero_integrand"]()
    seen = examine(case, "torch.lbfgs", Limits())
    assert seen.refused and seen.faults == [] and seen.solved
    assert examine(replace(case, refuses="context"), "torch.lbfgs", Limits()).faults


def test_mass_sees_what_is_missing():
    context = one_context()
    proposal = gaussians([(1.0, 0.2, 1e-4), (1.0, -0.4, 1.0)])
    assert mass(proposal, context) == pytest.approx(1.0, abs=1e-6)
    nodes = nodes_of(proposal, context)
    assert float((nodes.weight * nodes.value[:, 0]).sum()) == pytest.approx(1.0, abs=1e-3)


def test_gain_is_what_the_slope_promises_and_the_step_brings():
    (case,) = TOYS["redundant"]()
    gradient = gradient_of(case.value, case.start)
    gain = shown_gain(case.value, case.model, case.start, gradient, math.inf)
    assert gain == pytest.approx(float(case.value(case.start)) - case.optimum, rel=1e-3)
    # over the ridge: a valley 1 lower lies within reach, but the slope here leads nowhere
    hilly = toy_case("hilly", lambda y: torch.cat([1 + torch.cos(4 * y), 0 * y]), torch.zeros(1).double(), 0.0)
    at = torch.full((1,), 1e-9, dtype=torch.float64)
    assert shown_gain(hilly.value, hilly.model, at, gradient_of(hilly.value, at), 2.0) < 1e-6


def test_parts_and_names():
    assert set(stiff_fits.parts()) == {*TOYS, *FITS, "controls"}
    assert stiff_fits.parts(problems=["grazing"], solvers=["optimistix.lm"]) == ["grazing"]
    with pytest.raises(InputError, match="problems"):
        stiff_fits.parts(problems=["easy"])
    with pytest.raises(InputError, match="solvers"):
        stiff_fits.parts(solvers=["scipy.lm"])


def test_run_and_comparison():
    outcome = stiff_fits.run("no_effect", seed=1, solvers=["torch.lbfgs", "torch.adam"])
    assert [f.verdict(0.01) for f in outcome.findings] == ["pass", "pass"]
    assert outcome.arrays["objective"].shape == (2,)
    rows = compare(f.to_dict() for f in outcome.findings)
    assert [row.problems for row in rows] == [1, 1] and rows[0].solved == 1 and rows[0].faulty == 0
    assert all(row.solver in SOLVERS for row in rows)


@pytest.mark.parametrize("name", ["idle_parameter", "tiny_integrand"])
def test_adam_does_not_claim_convergence_on_a_log_excess_that_a_step_still_lowers(name):
    case = next(case for case in FITS[name]() if case.objective == "log_excess")
    seen = examine(case, "torch.adam", Limits())
    assert seen.faults == [] and (seen.shown <= FALSE_CLAIM or not seen.converged)


def test_figure_marks_false_claims():
    from dsfit.experiment.plots.checks.stiff_fits import figures

    findings = [
        f.to_dict() for f in stiff_fits.run("no_effect", seed=1, solvers=["torch.lbfgs", "torch.adam"]).findings
    ]
    findings[1]["value"] = 1.0
    cells = [{"suite": "stiff_fits", "findings": findings}, {"suite": "other", "findings": []}]
    ((name, figure),) = figures(None, {"cells": cells})
    axes = figure.axes[0]
    assert name == "stiff_fits" and [t.get_text() for t in axes.texts] == ["", "✗"]
    assert [t.get_text() for t in axes.get_xticklabels()] == ["lbfgs", "adam"]
    assert list(figures(None, {"cells": cells[1:]})) == []


@pytest.mark.slow
@pytest.mark.parametrize("name", ["narrow_beside_wide", "black_behind_20", "grazing", "opaque"])
def test_extreme_fibres(name):
    outcome = stiff_fits.run(name, seed=1)
    assert [f.detail for f in outcome.findings if f.verdict(0.01) != "pass"] == []
    best = next(f for f in outcome.findings if f.subject == "optimistix.lm" and f.case.endswith("excess"))
    assert best.data["objective"] < 0.2 * best.data["start"]
