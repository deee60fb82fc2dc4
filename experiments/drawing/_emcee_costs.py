"""What the same error costs by walkers and by the fitted proposal."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from dsfit.experiment.files import number
from dsfit.experiment.plots.style import COLORS
from dsfit.figures import Data
from dsfit.figures.page import Page

ACCURACY = 1e-3
"""Relative standard error of the integral at which methods are compared."""


@dataclass(frozen=True)
class Costs:
    """Evaluations of |F| and seconds.

    Attributes:
        chain_each, proposal_each: evaluations for one effective sample, burn-in left out; `chain_each_error`: relative
            standard error of the former.
        chain_integral, proposal_integral: evaluations for the integral to `ACCURACY`.
        chain_seconds, proposal_seconds: seconds for that; `fit_seconds`: of the fit, which both need.
    """

    chain_each: float
    chain_each_error: float
    proposal_each: float
    chain_integral: float
    proposal_integral: float
    chain_seconds: float
    proposal_seconds: float
    fit_seconds: float


def costs(cell: dict[str, Any]) -> Costs:
    """From what was measured: errors fall as one over the root of evaluations, for both methods.

    The effective number of walkers is the smaller one of two, by traces and by scatter; the proposal's is
    N / (1 + excess). The bridge takes the walkers' evaluations and the proposal's, and, whatever the error, the burn-in
    of one ensemble.
    """
    bulk, between = number(cell["bulk_ess"]), number(cell["between_ess"])
    evaluations, samples = cell["chain_evaluations"], cell["samples"]
    excess, seconds = number(cell["excess"]), {key: number(value) for key, value in cell["seconds"].items()}
    bridge = (number(cell["bridge_error"]) / number(cell["bridge"]) / ACCURACY) ** 2
    alone = excess / ACCURACY**2
    burn_in = cell["burn_in_evaluations"] / cell["ensembles"]
    walked = evaluations * bridge + burn_in
    each = seconds["chains"] / (evaluations + cell["burn_in_evaluations"])
    return Costs(
        chain_each=evaluations / min(bulk, between),
        chain_each_error=number(cell["between_ess_error"]) / between,
        proposal_each=1 + excess,
        chain_integral=walked + samples * bridge,
        proposal_integral=alone,
        chain_seconds=walked * each + seconds["samples"] * bridge,
        proposal_seconds=seconds["samples"] * alone / samples,
        fit_seconds=seconds["fit"],
    )


def costs_figure(data: Data, page: Page) -> Figure:
    """Two panels of dots, a row for each cell."""
    cells = [data.record["cells"][name] for name in data.record["order"]]
    found = [costs(cell) for cell in cells]
    labels = [
        f"{cell['preset']}, {cell['context'][0]:g}°, {cell['context'][1]:g}, {cell['context'][2]:g}" for cell in cells
    ]
    figure = page.figure(max(0.45, 0.2 + 0.032 * len(cells)))
    figure.set_layout_engine(None)  # by hand: tick labels are longer than the automatic layout expects
    height = figure.get_size_inches()[1]
    left = 0.035 + 0.0086 * max(len(label) for label in labels)
    figure.subplots_adjust(left=left, right=0.98, top=1 - 0.28 / height, bottom=0.75 / height, wspace=0.06)
    each, integral = figure.subplots(1, 2, sharey=True)
    rows = np.arange(len(cells))
    chain = np.array([one.chain_each for one in found])
    error = 2 * chain * np.array([one.chain_each_error for one in found])
    each.errorbar(
        chain, rows, xerr=[np.minimum(error, 0.9 * chain), error], fmt="o", color=COLORS[0], markersize=4,
        label="walkers, ± 2 standard errors",
    )  # fmt: skip
    each.plot([one.proposal_each for one in found], rows, "s", color=COLORS[1], markersize=4, label="fitted proposal")
    each.set(xscale="log", xlabel="evaluations for an effective sample", xlim=(0.7, None))
    integral.plot([one.chain_integral for one in found], rows, "o", color=COLORS[0], markersize=4)
    integral.plot([one.proposal_integral for one in found], rows, "s", color=COLORS[1], markersize=4)
    integral.set(xscale="log", xlabel=f"evaluations for ∫|F| to {100 * ACCURACY:g} %")
    each.set_yticks(rows, labels, fontsize=7)
    each.set_title("rows: fibre, θ_r, n, v", fontsize=7, loc="left")
    each.invert_yaxis()
    for panel in (each, integral):
        panel.grid(True, axis="x")
        panel.xaxis.label.set_size(8)
    figure.legend(loc="lower center", ncols=2, frameon=False)
    return figure
