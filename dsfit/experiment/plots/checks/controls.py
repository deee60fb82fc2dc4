"""How clearly each wrong equation was rejected, and what it does to the light of the suite's scene."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from dsfit.checks.controls import CONTROLS
from dsfit.experiment.files import number
from dsfit.experiment.plots.style import COLORS, new_figure
from dsfit.experiment.rundir import RunDirectory

_RATIOS = (0.2, 0.3, 0.5, 0.7, 1.0, 1.4, 2.0)
_DECADES = 16.0  # beyond it a rejection is as clear as it needs to be


def figures(directory: RunDirectory, result: dict[str, Any]) -> Iterator[tuple[str, Figure]]:
    """One figure of two panels, a row for each control in the order of the equations."""
    findings = [f for cell in result["cells"] if cell["suite"] == "controls" for f in cell["findings"]]
    rejected = {f["subject"]: f for f in findings if f["case"].startswith("printed") and f["subject"] in CONTROLS}
    rows = [rejected[name] for name in CONTROLS if name in rejected]
    if not rows:
        return
    figure = new_figure(9.0, 1.2 + 0.19 * len(rows))
    clear, effect = figure.subplots(1, 2, sharey=True)
    for k, finding in enumerate(rows):
        decades = min(max(_decades(finding), 0.0), _DECADES)
        clear.plot([0, decades], [k, k], color="#bbbbbb", linewidth=1)
        clear.plot(decades, k, ">" if decades == _DECADES else "o", color=COLORS[0], markersize=4)
        clear.plot(-math.log10(number(finding["bound"])), k, "|", color=COLORS[1], markersize=8)
        if "ratio" in finding["data"]:
            ratio = number(finding["data"]["ratio"])
            effect.plot([1, ratio], [k, k], color="#bbbbbb", linewidth=1)
            effect.plot(ratio, k, "o", color=COLORS[0], markersize=4)
    labels = [f"{CONTROLS[f['subject']].equations}  {f['subject']}" for f in rows]
    clear.set_yticks(range(len(rows)), labels, fontsize=7)
    clear.invert_yaxis()
    clear.set_xlabel("decades of p, or of deviation over bound (bar: needed)")
    clear.set_title("how clearly the printed form is rejected")
    effect.set_xscale("log")
    effect.set_xticks(_RATIOS, [f"{ratio:g}" for ratio in _RATIOS], minor=False)
    effect.xaxis.set_minor_locator(NullLocator())
    effect.axvline(1, color="#555555", linewidth=1)
    effect.set_xlabel("integral as printed over the right one")
    effect.set_title("effect on the light of the scene")
    for axis in (clear, effect):
        axis.grid(True, axis="x", color="#dddddd")
        axis.xaxis.label.set_size(8)
    yield "controls", figure


def _decades(finding: dict[str, Any]) -> float:
    value = number(finding["value"])
    return -math.log10(value) if value > 0 else _DECADES
