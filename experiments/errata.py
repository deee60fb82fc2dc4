"""The chapter's errata: every printed equation that is wrong, its correction, and what the slip does to the light."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from dsfit.checks.controls import CONTROLS, SCENE, TYPOS, position
from dsfit.checks.controls.base import Control, Typo
from dsfit.experiment.files import number
from dsfit.figures import Close, Data, Experiment, Settings, Work
from experiments._check_runs import findings, names

MOST = 16.0
"""Decades beyond which a rejection is as clear as it needs to be."""


class Errata(Settings):
    """`controls` are wrong equations by name, all if the list is empty; `seed` places what is drawn."""

    controls: list[str]
    seed: int


def compute(settings: Errata, work: Work) -> Data:
    """Puts each wrong equation and its correction through the same check.

    Arrays, one value per control: `decades` of the p-value, or of the bound over the deviation, with which the printed
    form is rejected (16 at most), `needed` for a rejection, and `ratio`, the integral as printed over the right one
    (nan where the effect is another).
    """
    overrides = (f"check.controls.controls={names(settings.controls)}", f"estimate.seed={settings.seed}")
    directory = work.run("controls.toml", overrides)
    found = findings(directory, "controls")
    printed = {f["subject"]: f for f in found if f["case"].startswith("printed")}
    controls = [control for control in CONTROLS.values() if control.name in printed]
    own = [printed[control.name] for control in controls]
    arrays = {
        "decades": np.array([_decades(number(f["value"])) for f in own]),
        "needed": np.array([_decades(number(f["bound"])) for f in own]),
        "ratio": np.array([number(f["data"].get("ratio", math.nan)) for f in own]),
    }
    labels = [f"{control.equations}  {control.name}" for control in controls]
    effects = {name: finding["detail"] for name, finding in printed.items()}
    verdict = directory.result()["report"]["verdict"]
    return Data(arrays, {"scene": SCENE, "controls": labels, "errata": rows(effects), "verdict": verdict})


def _decades(value: float) -> float:
    return min(max(-math.log10(value), 0.0), MOST) if value > 0 else MOST


def rows(effects: Mapping[str, str]) -> list[dict[str, str]]:
    """All errata in the order of the equations, those without effect among them; controls without a measured effect
    (by name) are left out."""
    chosen: list[Control | Typo] = [*(c for c in CONTROLS.values() if c.name in effects), *TYPOS]
    return [_row(item, effects) for item in sorted(chosen, key=position)]


def _row(item: Control | Typo, effects: Mapping[str, str]) -> dict[str, str]:
    row = {"equations": item.equations, "printed": item.printed, "corrected": item.corrected, "kind": item.kind}
    if isinstance(item, Control):
        return {**row, "control": item.name, "check": item.check, "effect": effects[item.name]}
    return {**row, "control": "", "check": "", "effect": ""}


EXPERIMENT = Experiment(
    title="Errata of the chapter, with their measured effects",
    shows="Every wrong equation is rejected by a check that its correction passes; most bias the light by tens of "
    "per cent, some are no densities at all.",
    settings=Errata,
    compute=compute,
    minutes=0.3,
    reproduces={
        "decades": Close(0.05),  # of p-values of fixed samples, and of quadratures
        "ratio": Close(1e-4),
    },
    small=('controls=["cosine_cdf", "transmittance_cdf", "box_muller_zero", "density_twice"]',),
)
