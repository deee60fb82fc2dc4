"""Every wrong equation of the chapter is rejected, its correction passes the same check, and the README says so."""

from __future__ import annotations

import dataclasses
import functools
import math
import re
from pathlib import Path

import pytest
import torch
from scipy import stats

import dsfit
from dsfit.bsdf.conventions import Convention
from dsfit.checks.controls import CONTROLS, TYPOS, parts, position, run, trial
from dsfit.checks.controls.base import Control, Trial
from dsfit.checks.controls.energy import energy_gap, outgoing_energy, remainder, smooth_bsdf
from dsfit.checks.controls.scene import DEG, SCENE, THETA_R, bsdf, context, integrand, nodes, terms
from dsfit.checks.controls.transmittance import traced_lobes
from dsfit.checks.finding import judge
from dsfit.errors import InputError
from dsfit.figures import Data
from dsfit.frame import cos_inclination
from experiments.drawing.errata import tables
from experiments.errata import rows

ROOT = Path(__file__).parents[2]
# chi-square and z-score controls, whose corrected p-values are drawn anew with every seed
DRAWN = ("clamp", "mirror_angle", "azimuth_clamp", "cosine_inverse", "front_only", "variance_argument")


@functools.cache
def tried(name: str) -> Trial:
    return trial(name, 1)


@functools.cache
def readme_table() -> list[str]:
    """Lines of the README's section, from the sentence about the scene to the end of the table."""
    text = (ROOT / "README.md").read_text()
    section = text.split("\n## Errata of the chapter\n")[1].split("\n## ")[0]
    lines = section.splitlines()
    start = next(k for k, line in enumerate(lines) if line.startswith("Measured in"))
    end = max(k for k, line in enumerate(lines) if line.startswith("|"))
    return lines[start : end + 1]


def table_of(effects: dict[str, str]) -> list[str]:
    """Lines of the experiment's table with these effects."""
    (table,) = tables(Data({}, {"scene": SCENE, "errata": rows(effects)}))
    return [line for line in table.markdown().splitlines() if line.startswith("|")]


def cells_of(line: str) -> list[str]:
    return [cell.strip().replace("`", "") for cell in re.split(r"(?<!\\)\|", line)[1:-1]]


def numbers_of(text: str) -> list[float]:
    return [float(x.replace("−", "-")) for x in re.findall(r"[-−]?\d+(?:\.\d+)?(?:e-?\d+)?", text)]


@pytest.mark.parametrize("name", CONTROLS)
def test_printed_form_is_rejected_and_corrected_form_passes(name: str) -> None:
    found = tried(name)
    findings = CONTROLS[name].findings(found)
    assert [verdict for _, verdict in judge(findings, 0.001)] == ["pass", "pass"], findings
    # the other way round nothing may pass: the check tells the forms apart, and the suite can fail
    swapped = dataclasses.replace(found, printed=found.corrected, corrected=found.printed)
    assert [verdict for _, verdict in judge(CONTROLS[name].findings(swapped), 0.001)] == ["fail", "fail"]
    # and the README's row is this control, with these numbers
    row = next(line for line in readme_table() if f"(`{name}`)" in line)
    wanted = next(line for line in table_of({name: found.effect}) if f"({name})" in line)
    for column, (written, measured) in enumerate(zip(cells_of(row), cells_of(wanted), strict=True)):
        if column != 3:
            assert written == measured
    effect, measured_effect = cells_of(row)[3], cells_of(wanted)[3]
    words = [re.sub(r"[-−]?\d+(?:\.\d+)?(?:e-?\d+)?", "#", text) for text in (effect, measured_effect)]
    assert words[0] == words[1]
    assert numbers_of(effect) == pytest.approx(numbers_of(measured_effect), rel=0.01)


def test_readme_has_every_erratum_and_no_other() -> None:
    lines = readme_table()
    wanted = table_of(dict.fromkeys(CONTROLS, ""))
    assert lines[0].startswith(f"Measured in: {SCENE}") and cells_of(lines[2]) == cells_of(wanted[0])
    assert [cells_of(line)[:3] for line in lines[4:]] == [cells_of(line)[:3] for line in wanted[2:]]
    assert len(lines) == 4 + len(CONTROLS) + len(TYPOS)


def test_every_wrong_equation_is_covered() -> None:
    """The right ones are (1)-(3) and (26)-(30); the others are each named by a control or a misprint."""
    named: set[int] = set()
    for item in (*CONTROLS.values(), *TYPOS):
        named |= {int(x) for x in re.findall(r"\((\d+)\)", item.equations)}
    assert set(range(1, 39)) - named == {1, 2, 3, 26, 27, 28, 29, 30}
    assert [position(c) for c in CONTROLS.values()] == sorted(position(c) for c in CONTROLS.values())


def test_equations_26_to_30_are_right() -> None:
    phi = torch.linspace(-math.pi, math.pi, 20_001, dtype=torch.float64)
    assert float(torch.trapezoid(torch.cos(phi / 2), phi)) == pytest.approx(4.0, abs=1e-7)
    assert float(torch.trapezoid(torch.cos(phi / 2) / 4, phi)) == pytest.approx(1.0, abs=1e-7)


def test_what_counts_as_rejected() -> None:
    def verdicts(found: Trial) -> list[str]:
        control = Control("x", "(1)", "a", "b", "bias", "c", lambda seed: found)
        return [verdict for _, verdict in judge(control.findings(found))]

    assert verdicts(Trial(1e-7, 0.5, None, "")) == ["pass", "pass"]
    assert verdicts(Trial(1e-5, 0.5, None, "")) == ["fail", "pass"]
    assert verdicts(Trial(1e-7, 1e-7, None, "")) == ["pass", "fail"]
    assert verdicts(Trial(2.0, 0.05, 0.1, "")) == ["pass", "pass"]
    assert verdicts(Trial(0.5, 0.05, 0.1, "")) == ["fail", "pass"]
    assert verdicts(Trial(2.0, 0.2, 0.1, "")) == ["pass", "fail"]
    assert verdicts(Trial(math.nan, 0.05, 0.1, "")) == ["pass", "pass"]
    assert verdicts(Trial(math.nan, math.nan, 0.1, "")) == ["pass", "fail"]
    assert verdicts(Trial(math.nan, math.nan, None, "")) == ["fail", "fail"]
    assert verdicts(Trial(0.0, 0.0, 0.0, "")) == ["fail", "pass"]


def test_parts_are_chosen_by_name() -> None:
    assert parts() == list(CONTROLS)
    assert parts(controls=["clamp", "reach"]) == ["clamp", "reach"]
    with pytest.raises(InputError):
        parts(controls=["no_such_control"])
    with pytest.raises(InputError):
        run("no_such_control", seed=1)
    told: list[str] = []
    outcome = run("cosine_cdf", seed=3, say=told.append, controls=["cosine_cdf"])
    assert [f.suite for f in outcome.findings] == ["controls"] * 2 and len(told) == 1


def test_terms_are_those_of_the_bsdf() -> None:
    theta_i, phi, weight = nodes()
    viewer, (n, v) = torch.full_like(theta_i, THETA_R), (3.0, 0.5)
    scene = terms()
    value = bsdf()(theta_i, viewer, phi, n, v)[:, 0]
    assert torch.allclose(scene.total * cos_inclination(theta_i), value, rtol=1e-10, atol=0)
    truth = float(dsfit.reference(integrand(), context(), 1e-6).value)
    assert scene.integral() == pytest.approx(truth, rel=1e-4)


@pytest.mark.parametrize(
    ("name", "switches"),
    [
        ("density_twice", {"density_power": 2}),
        ("back_pi", {"back_factor": "pi"}),
        ("azimuth_constant", {"scattered_azimuth": "constant"}),
        ("back_argument", {"back_argument": "theta_diff+theta_r"}),
    ],
)
def test_effects_agree_with_the_conventions_own_reference(name: str, switches: dict) -> None:
    """The ratio put together from terms, against adaptive cubature of the BSDF in that convention."""
    wrong = dsfit.Integrand(bsdf().replace(convention=Convention(**switches), precision="exact"))
    values = [float(dsfit.reference(scene, context(), 1e-4).value) for scene in (wrong, integrand())]
    assert tried(name).data["ratio"] == pytest.approx(values[0] / values[1], rel=1e-3)


def test_lost_cosines_agree_with_the_conventions_own_reference() -> None:
    """(6), (7) and (9) together."""
    wrong = bsdf().replace(convention=Convention(inverse_cos2=False))
    ratio = [float(dsfit.reference(dsfit.Integrand(b), context(), 1e-4).value) for b in (wrong, bsdf())]
    both = tried("projection").data["ratio"] + tried("back_projection").data["ratio"] - 1
    assert both == pytest.approx(ratio[0] / ratio[1], rel=1e-3)


@pytest.mark.slow
def test_negative_light_agrees_with_the_printed_conventions_own_reference() -> None:
    wrong = dsfit.Integrand(bsdf().replace(convention="printed", precision="exact"))
    values = [float(dsfit.reference(scene, context(), 1e-3).value) for scene in (wrong, integrand())]
    assert tried("all_together").data["integral_ratio"] == pytest.approx(values[0] / values[1], rel=5e-3)


def test_energy_of_a_smooth_fibre() -> None:
    """1 - remainder against values from an independent computation, and the lobes against it at other angles."""
    for degrees, energy in ((0, 0.9924), (30, 0.9904), (60, 0.9728), (80, 0.8859), (85, 0.8594)):
        assert 1 - remainder(degrees * DEG) == pytest.approx(energy, abs=6e-5)
    for degrees in (0, 30, 70):
        angle = degrees * DEG
        assert outgoing_energy(smooth_bsdf().single, angle) == pytest.approx(1 - remainder(angle), abs=1e-5)
    assert energy_gap(lambda i, r, phi: 1.001 * smooth_bsdf().single(i, r, phi)) > 9e-4


def test_traced_rays_carry_the_energies() -> None:
    """Shares of R, TT, TRT at normal incidence without absorption, and TT with it."""
    rays = 400_000
    counts = traced_lobes(0.0, rays, 2)
    for count, share in zip(counts, (0.0750, 0.8618, 0.0557), strict=True):
        assert abs(count / rays - share) < 5 * math.sqrt(share / rays) + 5e-5
    assert traced_lobes(0.1, rays, 3)[1] / rays == pytest.approx(0.7152662947, abs=5 * math.sqrt(0.2 / rays))


def test_figure_has_a_row_for_every_control() -> None:
    from dsfit.experiment.plots.checks.controls import figures

    names = ("cosine_cdf", "transmittance_cdf", "box_muller_zero")
    cells = [{"suite": "controls", "findings": [f.to_dict() for f in run(name, seed=1).findings]} for name in names]
    drawn = dict(figures(None, {"cells": cells}))  # type: ignore[arg-type]
    labels = [label.get_text() for label in drawn["controls"].axes[0].get_yticklabels()]
    assert labels == [f"{CONTROLS[n].equations}  {n}" for n in CONTROLS if n in names]


@pytest.mark.slow
def test_corrected_forms_have_uniform_p_values() -> None:
    """The false-alarm rate is the level: over many seeds the corrected forms' p-values are uniform."""
    p_values = [CONTROLS[name].trial(seed).corrected for name in DRAWN for seed in range(100, 140)]
    assert stats.kstest(p_values, "uniform").pvalue > 0.01, sorted(p_values)[:5]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [2, 3, 4])
def test_rejections_do_not_hang_on_the_seed(seed: int) -> None:
    for name in CONTROLS:
        found = trial(name, seed)
        limit = 1e-6 if found.bound is None else 0.1
        assert found.rejection < limit, (name, found)
        assert numbers_of(found.effect) == pytest.approx(numbers_of(tried(name).effect), rel=1e-6)
