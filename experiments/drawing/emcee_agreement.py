"""Draws the walkers' marginals beside the proposal's and the quadrature's, their joint density, and the costs."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from dsfit.experiment.files import number
from dsfit.experiment.plots.style import COLORS
from dsfit.figures import Data, Table
from dsfit.figures.page import Page
from experiments.drawing._emcee_corner import corner
from experiments.drawing._emcee_costs import ACCURACY, costs, costs_figure

CHAIN, PROPOSAL = COLORS[0], COLORS[1]
AXES = (("theta", "θᵢ / °", 90.0), ("phi", "φ / °", 180.0), ("size", "ln |F|", None))
_SMALL, _MOST = 7, 4.5


def figures(data: Data, page: Page) -> dict[str, Figure]:
    """A page of marginals for each context, the joint densities, and the costs."""
    found = {f"marginals_{k}": _marginals(data, page, k) for k in range(data.record["contexts"])}
    return found | {"corner": corner(data, page), "costs": costs_figure(data, page)}


def captions(data: Data) -> dict[str, str]:
    """What the figures show."""
    ensembles, walkers, steps, burn_in = data.record["sizes"]
    cells = [cell for _, cell in _cells(data)]
    walked = f"{ensembles} ensembles of {walkers} walkers ({steps} steps after {burn_in} of burn-in) on |F|"
    found = {}
    for k in range(data.record["contexts"]):
        own = [cell for name, cell in _cells(data) if name.endswith(str(k))]
        theta_r, n, v = own[0]["context"]
        least = min(number(cell["p"]["chains_quadrature"]) for cell in own)
        found[f"marginals_{k}"] = (
            f"Marginals of |F| / ∫|F| at θ_r = {theta_r:g}°, n = {n:g}, v = {v:g}, a row for each fibre, constant "
            f"light: places of {walked} (blue), {own[0]['samples']:,} weighted samples of the fitted proposal (orange) "
            "and quadrature (black); bars: ± 2 standard errors. Below each: deviations of both from the quadrature in "
            f"standard errors, with a band of ± 2. Means of the walkers against "
            f"the quadrature: p = {least:.2g} at least."
        )
    theta_r, n, v = next(c["context"] for name, c in _cells(data) if name.endswith(str(data.record["shown"])))
    ratios = [found_costs.chain_integral / found_costs.proposal_integral for found_costs in map(costs, cells)]
    found["corner"] = (
        f"Joint density of inclination and azimuth at θ_r = {theta_r:g}°, n = {n:g}, v = {v:g}: share of the places of "
        f"{walked} in cells of 5° × 10° (colours), and what contains 50, 90 and 99 % of |F| by quadrature (lines); "
        "beside each the marginals of the walkers (filled) and by quadrature (steps)."
    )
    found["costs"] = (
        f"Evaluations of |F| for one effective sample (left) and for the integral with a standard error of "
        f"{100 * ACCURACY:g} % (right), by walkers, bridged to the proposal for the integral, and by the fitted "
        "proposal alone; without the fit, which both need. Bars: ± 2 standard errors of the effective number. "
        f"For the integral walkers take {min(ratios):.3g} to {max(ratios):.3g} times as many."
    )
    return found


def tables(data: Data) -> list[Table]:
    """How chains mixed and agree, and what the same error costs."""
    return [_mixing(data), _agreement(data), _costs(data)]


def _cells(data: Data) -> list[tuple[str, dict[str, Any]]]:
    return [(name, data.record["cells"][name]) for name in data.record["order"]]


def label(cell: dict[str, Any]) -> str:
    """A cell in tables."""
    theta_r, n, v = cell["context"]
    return f"{cell['preset']}, {theta_r:g}°, {n:g}, {v:g}"


def _marginals(data: Data, page: Page, context: int) -> Figure:
    names = [name for name in data.record["order"] if name.endswith(str(context))]
    figure = page.figure(0.14 + 0.25 * len(names))
    theta_r, n, v = data.record["cells"][names[0]]["context"]
    figure.suptitle(f"θ_r = {theta_r:g}°, n = {n:g}, v = {v:g}", fontsize=8)
    axes = figure.subplots(2 * len(names), 3, height_ratios=(2.4, 1) * len(names))
    for row, name in enumerate(names):
        axes[2 * row + 1, 0].set_ylabel("z", fontsize=_SMALL, rotation=0)
        for column, (axis, text, reach) in enumerate(AXES):
            main, strip = axes[2 * row, column], axes[2 * row + 1, column]
            edges = (
                data.arrays[f"{name}.size.edges"] if reach is None else np.linspace(-reach, reach, _bins(data, axis))
            )
            _densities(main, data, f"{name}.{axis}", edges)
            _residuals(strip, data, f"{name}.{axis}", edges)
            for panel in (main, strip):
                panel.set_xlim(edges[0], edges[-1])
                if reach is not None:
                    panel.set_xticks(np.linspace(-reach, reach, 5))
                panel.grid(True)
                panel.tick_params(labelsize=6)
            main.tick_params(labelbottom=False)
            if row == len(names) - 1:
                strip.set_xlabel(text, fontsize=_SMALL, labelpad=1)
            elif reach is not None:
                strip.tick_params(labelbottom=False)
        axes[2 * row, 0].set_ylabel(f"{data.record['cells'][name]['preset']}\nper degree", fontsize=_SMALL)
    upper = axes[0, 0].secondary_xaxis(
        "top", functions=(lambda x: (theta_r - x) / 2, lambda d: theta_r - 2 * d)
    )  # fmt: skip
    upper.set_xlabel("θ_d = (θ_r − θᵢ) / 2, degrees", fontsize=_SMALL, labelpad=5)
    upper.tick_params(labelsize=6)
    handles = [
        Patch(color=CHAIN, alpha=0.3, label="walkers"),
        Line2D(
            [],
            [],
            color=PROPOSAL,
            marker="o",
            markersize=3,
            linestyle="",
            label="fitted proposal, weighted",
        ),
        Line2D([], [], color="black", linewidth=0.9, label="quadrature"),
        Patch(color="#eeeeee", label="± 2 standard errors"),
    ]
    figure.legend(
        handles=handles, loc="outside lower center", ncols=4, frameon=False, fontsize=_SMALL, columnspacing=1.5
    )
    return figure


def _bins(data: Data, axis: str) -> int:
    return data.record["bins"][axis] + 1


def _densities(panel: Any, data: Data, key: str, edges: np.ndarray) -> None:
    """Shares of p* over the width of bins."""
    width, middle = np.diff(edges), (edges[1:] + edges[:-1]) / 2
    chain, own, exact = (data.arrays[f"{key}.{kind}"] / width for kind in ("chain", "proposal", "quadrature"))
    error, own_error = (2 * data.arrays[f"{key}.{kind}_error"] / width for kind in ("chain", "proposal"))
    panel.stairs(chain, edges, fill=True, color=CHAIN, alpha=0.3)
    panel.errorbar(middle, chain, error, fmt="none", ecolor=CHAIN, elinewidth=0.8)
    panel.stairs(exact, edges, color="black", linewidth=0.9)
    panel.errorbar(
        middle, own, own_error, fmt="o", color=PROPOSAL, markersize=1.6, elinewidth=0.8
    )  # fmt: skip
    panel.set_ylim(0, None)


def _residuals(panel: Any, data: Data, key: str, edges: np.ndarray) -> None:
    """Deviations from the quadrature, each in its own standard error; bins that hold less than 1e-5 are left out."""
    middle = (edges[1:] + edges[:-1]) / 2
    exact = data.arrays[f"{key}.quadrature"]
    seen = exact > 1e-5
    panel.axhspan(-2, 2, color="#eeeeee")
    panel.axhline(0, color="black", linewidth=0.6)
    for kind, color, shift in (("chain", CHAIN, -0.15), ("proposal", PROPOSAL, 0.15)):
        error = data.arrays[f"{key}.{kind}_error"]
        z = np.divide(data.arrays[f"{key}.{kind}"] - exact, error, out=np.zeros(len(exact)), where=error > 0)
        at = middle + shift * (edges[1] - edges[0])
        panel.plot(at[seen], np.clip(z[seen], -_MOST, _MOST), ".", color=color, markersize=2.5)
    panel.set(ylim=(-_MOST - 0.5, _MOST + 0.5), yticks=(-4, 0, 4))


def _plain(value: Any, digits: str) -> str:
    return f"{number(value):{digits}}".replace("-", "−")


def _mixing(data: Data) -> Table:
    rows = []
    for _, cell in _cells(data):
        rows.append(
            [
                label(cell),
                _plain(cell["r_hat"], ".3f"),
                f"{_plain(cell['tau'], '.1f')} ± {_plain(cell['tau_error'], '.1f')}",
                _plain(cell["autocorrelation"], ".1f"),
                f"{_plain(cell['acceptance'], '.3f')} ± {_plain(cell['acceptance_error'], '.3f')}",
                _plain(cell["bulk_ess"], ",.0f"),
                f"{_plain(cell['between_ess'], ',.0f')} ± {_plain(cell['between_ess_error'], ',.0f')}",
                _plain(cell["proposal_ess"], ",.0f"),
                "; ".join(cell["reasons"]) or "yes",
            ]
        )
    ensembles, walkers, steps, burn_in = data.record["sizes"]
    samples = data.record["cells"][data.record["order"][0]]["samples"]
    caption = (
        f"How {ensembles} ensembles of {walkers} walkers mixed in {steps} steps after {burn_in} of burn-in. τ: emcee's "
        f"integrated autocorrelation time in steps, walkers about their own means, mean over ensembles; τ about all: "
        f"with walkers about the mean of all, which is what the effective number (of {ensembles * walkers * steps:,} "
        f"places) by traces rests on. By scatter: from the variance of the ensembles' means. Worst of sin θ_i, cos φ, "
        f"sin φ and log |F|. Proposal: Kish's number for {samples:,} weighted samples."
    )
    head = (
        "fibre, θ_r, n, v", "R-hat", "τ", "τ about all", "acceptance", "effective, by traces", "by scatter",
        "effective, proposal", "mixed",
    )  # fmt: skip
    return Table("mixing", caption, head, rows, "lrrrrrrrl")


def _agreement(data: Data) -> Table:
    rows = []
    for _, cell in _cells(data):
        exact = number(cell["quadrature"])
        ratios = [
            f"{_plain(1e4 * (number(cell[key]) / exact - 1), '+.2f')} ± "
            f"{1e4 * number(cell[f'{key}_error']) / exact:.2f}"
            for key in ("bridge", "importance")
        ]
        p = [f"{number(cell['p'][key]):.2g}" for key in ("chains_quadrature", "marginals", "means", "bridge")]
        rows.append([label(cell), f"{exact:.6f}", *ratios, *p])
    count = 4 * len(rows)
    caption = (
        f"∫ |F| dω by quadrature, and what bridge sampling between walkers and proposal, and importance sampling "
        f"alone, deviate from it, in 1e-4 of it, with standard errors. p-values: means of the walkers against those of "
        f"the quadrature; marginals and means of the walkers against those of the weighted proposal; the bridge's "
        f"integral against the quadrature's. Of {count} p-values from samples that agree, the smallest is below "
        f"{1 - 0.99 ** (1 / count):.1g} in one of a hundred runs."
    )
    head = (
        "fibre, θ_r, n, v", "quadrature", "bridge", "importance", "p: walkers, quadrature", "p: marginals",
        "p: means", "p: bridge",
    )  # fmt: skip
    return Table("agreement", caption, head, rows)


def _costs(data: Data) -> Table:
    rows = []
    for _, cell in _cells(data):
        found = costs(cell)
        rows.append(
            [
                label(cell),
                _plain(found.chain_each, ".1f"),
                f"{found.proposal_each:.4f}",
                f"{found.chain_integral:,.0f}",
                f"{found.proposal_integral:,.0f}",
                f"{found.chain_seconds:.2g}",
                f"{found.proposal_seconds:.2g}",
                f"{found.fit_seconds:.2g}",
            ]
        )
    caption = (
        f"Evaluations of |F| for one effective sample, and for ∫ |F| dω with a standard error of {ACCURACY:.1%}: "
        f"walkers bridged to the proposal, with the burn-in of one ensemble, and the proposal alone; seconds of one "
        f"core for the integral, and of the fit, which both need. Walkers are advanced 256 at a time and the proposal "
        f"is evaluated all at once, so that evaluations, not seconds, compare the methods. Walkers alone have no "
        f"integral."
    )
    head = (
        "fibre, θ_r, n, v", "an effective sample: walkers", "proposal", "the integral: walkers", "proposal",
        "s: walkers", "s: proposal", "s: fit",
    )  # fmt: skip
    return Table("costs", caption, head, rows)
