"""Negative controls: every wrong equation of the chapter, put through a check that must reject it.

A control proves something only if its corrected form passes the same check, so both are findings:

- "printed form is rejected": the p-value of the printed form below 1e-6, or its deviation at least ten bounds;
- "corrected form passes": its p-value in the suite's family, or its deviation within the bound.

`CONTROLS` has them by name, in the order of the equations; `TYPOS` what is misprinted without effect. Each control also
measures what is at stake (`Trial.effect`, `Trial.data`), by quadrature, so that the numbers do not depend on a seed.
"""

from __future__ import annotations

import re
from typing import Any

from dsfit.checks.controls import azimuth, backscatter, longitudinal, scattering, transmittance
from dsfit.checks.controls.base import SUITE, Control, Trial, Typo
from dsfit.checks.controls.scene import SCENE
from dsfit.checks.subject import Outcome, Say, silent
from dsfit.checks.suites import chosen
from dsfit.errors import check_choice


def position(item: Control | Typo) -> float:
    """Where an erratum stands in tables: at its first equation, or after all of a range such as "(4)–(12)"."""
    numbers = [int(x) for x in re.findall(r"\d+", item.equations)]
    return numbers[1] + 0.5 if "–" in item.equations else numbers[0]


CONTROLS: dict[str, Control] = {
    control.name: control
    for control in sorted(
        [
            c
            for module in (scattering, backscatter, longitudinal, azimuth, transmittance)
            for c in module.CONTROLS.values()
        ],
        key=position,
    )
}
"""Errata with an effect, by name."""

TYPOS: tuple[Typo, ...] = (
    Typo("(6), (9), (10)", "N_X(θ, φ), g(…, θ − α_X): θ not defined", "θ_diff in N_X, θ_h in M_X"),
    Typo("(7)", "f_s^back on the left", "f_back, as in (5) and (8)"),
    Typo("(15)", "no equation has this number", "none is missing"),
    Typo("(17), (22)", "a closing parenthesis too many", "β √(−2 ln u_1) cos(2π u_2)"),
    Typo("before (22)", "φ ∈ [π, π]", "φ ∈ [−π, π]"),
    Typo("(23)", "φ_i = φ_r − (π − φ)", "the same, wrapped, as the text below it says"),
    Typo("(36)", "an empty line; M_R^G = g below it", "a list left unfinished"),
)
"""Errata without an effect."""


def parts(controls: Any = "all") -> list[str]:
    """Names of the controls to run: "all" or a list of names.

    Raises:
        InputError: a name that no control has.
    """
    return chosen("check.controls.controls", controls, CONTROLS)


def trial(name: str, seed: int = 1) -> Trial:
    """Put both forms of a control through its check.

    Raises:
        InputError: no control of this name.
    """
    return CONTROLS[check_choice("control", name, tuple(CONTROLS))].trial(seed)


def run(part: str, *, seed: int, say: Say = silent, controls: Any = "all") -> Outcome:
    """The two findings of one control; `controls` only says which parts there are."""
    control = CONTROLS[check_choice("control", part, tuple(CONTROLS))]
    say(f"{control.name}: eq {control.equations}")
    return Outcome(control.findings(control.trial(seed)))


__all__ = ["CONTROLS", "SCENE", "SUITE", "TYPOS", "Control", "Trial", "Typo", "parts", "position", "run", "trial"]
