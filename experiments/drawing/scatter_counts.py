"""Draws and tabulates the grid's scatter counts against exact ones."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from dsfit.experiment.plots.style import look
from dsfit.figures import Data, Table
from dsfit.figures.page import Page
from experiments._scatter_counts_compare import LEAST_IN_BIN

SHOWN = 48
"""Resolution of the grid whose shares of uncrossed rays are drawn, that of rendered scenes: the nearest one to it."""
MOST_N = 5.0


def figures(data: Data, page: Page) -> dict[str, Figure]:
    """Bias and scatter by resolution; shares of uncrossed rays, and the two rules for v."""
    arrays = data.arrays
    grid = page.figure(0.56)
    left, right = grid.subplots(1, 2)
    _by_resolution(left, data, 100 * arrays["counts.bias"], 100 * arrays["error.counts.bias"])
    left.set_ylabel("bias of n / %")
    left.axhline(0, color="black", linewidth=0.8, zorder=0.5)
    _by_resolution(right, data, arrays["counts.scatter"], arrays["error.counts.scatter"])
    right.set_ylabel("scatter of N at given n / Poisson")
    right.axhline(1, color="black", linewidth=0.8, zorder=0.5)
    grid.legend(handles=_key(data), loc="outside lower center", ncols=3, frameon=False)
    lit = page.figure(0.62)
    left, right = lit.subplots(1, 2)
    _uncrossed(left, data)
    _rules(right, data)
    lines = [
        Line2D([], [], color="black", linewidth=0.8, label="left: exp(-n); right: v = exp(-n)"),
        Line2D([], [], color="black", linewidth=0.8, linestyle="--", label="v = 1 for n ≤ 1/2, else 0"),
    ]
    lit.legend(handles=_key(data) + lines, loc="outside lower center", ncols=2, frameon=False)
    return {"grid": grid, "lit": lit}


def captions(data: Data) -> dict[str, str]:
    """What the two figures show."""
    arrays, record = data.arrays, data.record
    r = _shown(data)
    bias, scatter = 100 * arrays["counts.bias"][:, r], arrays["counts.scatter"][:, r]
    poisson, rule = (arrays[f"counts.brier_{name}"][:, r, record["points"].index("fibres")]
                     for name in ("poisson", "threshold"))  # fmt: skip
    voxels, rays = record["resolutions"][r], f"{record['rays']:,} rays for each geometry and kind of points"
    bars = "bars: one standard error (jackknife)"
    return {
        "grid": f"Numbers of fibres that rays cross, from a grid of densities (n) against exact ones of the geometry "
        f"(N), over the resolution of the grid; {rays}, which start on fibres (filled) or where a camera sees them "
        f"(hollow) and go in all directions; {bars}. Left: mean n over mean N less 1. Right: root mean square of N "
        f"about its mean at given n, over that of Poisson numbers. At {voxels} voxels the bias lies between "
        f"{bias.min():+.1f} % and {bias.max():+.1f} %, the scatter between {scatter.min():.2f} and "
        f"{scatter.max():.2f} of Poisson's.",
        "lit": f"Left: share of rays that cross no fibre against the n that a grid of {voxels} voxels expects, in bins "
        f"of at least {LEAST_IN_BIN} rays; lines: the two rules for v, exp(-n) and 1 up to n = 1/2. Right: mean square "
        f"error of v by either rule as a forecast of N = 0, over the resolution, points on fibres; {rays}, {bars}. At "
        f"{voxels} voxels it is {poisson.min():.3f} to {poisson.max():.3f} with exp(-n), {rule.min():.3f} to "
        f"{rule.max():.3f} with the threshold.",
    }


def _shown(data: Data) -> int:
    """Index of the resolution that is nearest to `SHOWN`."""
    resolutions = data.record["resolutions"]
    return min(range(len(resolutions)), key=lambda k: abs(resolutions[k] - SHOWN))


def _key(data: Data) -> list[Line2D]:
    names = [Line2D([], [], label=name.replace("_", " "), markersize=4, **look(k))
             for k, name in enumerate(data.record["geometries"])]  # fmt: skip
    kinds = [
        Line2D([], [], color="0.3", marker="o", markersize=4, label="points on fibres"),
        Line2D([], [], color="0.3", marker="o", markersize=4, linestyle=":", mfc="white", label="points seen"),
    ]
    return names + kinds


def _style(k: int, seen: bool) -> dict[str, Any]:
    return look(k) | {
        "linestyle": ":" if seen else "-",
        "markerfacecolor": "white" if seen else None,
        "linewidth": 1.2,
        "markersize": 4,
    }


def _by_resolution(axis: Axes, data: Data, value: np.ndarray, error: np.ndarray) -> None:
    """A line for each geometry and kind of points, with standard errors."""
    resolutions = np.array(data.record["resolutions"], dtype=float)
    for k in range(len(data.record["geometries"])):
        for j, where in enumerate(data.record["points"]):
            shifted = resolutions * 2 ** (0.05 * (2 * j - 1))  # bars beside, not upon one another
            style = _style(k, where == "seen")
            axis.errorbar(shifted, value[k, :, j], yerr=error[k, :, j], elinewidth=0.7, **style)
    _resolutions(axis, data)


def _resolutions(axis: Axes, data: Data) -> None:
    ticks = data.record["resolutions"]
    axis.set_xscale("log", base=2)
    axis.set_xticks(ticks, [str(tick) for tick in ticks])
    axis.minorticks_off()
    axis.set_xlabel("voxels along the longest side")
    axis.grid(True)


def _uncrossed(axis: Axes, data: Data) -> None:
    """Share of rays with N = 0 against n, and exp(-n)."""
    arrays, resolutions = data.arrays, data.record["resolutions"]
    r = _shown(data)
    x = np.linspace(0, MOST_N, 100)
    axis.plot(x, np.exp(-x), color="black", linewidth=0.8)
    axis.step([0, 0.5, 0.5, MOST_N], [1, 1, 0, 0], color="black", linewidth=0.8, linestyle="--")
    for k in range(len(data.record["geometries"])):
        for j, where in enumerate(data.record["points"]):
            names = ("bins.n", "bins.zero", "error.bins.zero", "bins.rays")
            n, share, error, rays = (arrays[name][k, r, j] for name in names)
            some = (rays >= LEAST_IN_BIN) & (n < MOST_N)
            style = _style(k, where == "seen") | {"linestyle": "none"}
            axis.errorbar(n[some], share[some], yerr=error[some], elinewidth=0.7, **style)
    axis.set(xlabel=f"n, {resolutions[r]} voxels", ylabel="share of rays with N = 0")
    axis.grid(True)


def _rules(axis: Axes, data: Data) -> None:
    """Mean square error of v, by rule; points on fibres."""
    arrays = data.arrays
    j = data.record["points"].index("fibres")
    for k in range(len(data.record["geometries"])):
        for rule, line in (("poisson", "-"), ("threshold", "--")):
            name = f"counts.brier_{rule}"
            value, error = arrays[name][k, :, j], arrays[f"error.{name}"][k, :, j]
            style = _style(k, False) | {"linestyle": line}
            axis.errorbar(data.record["resolutions"], value, yerr=error, elinewidth=0.7, **style)
    _resolutions(axis, data)
    axis.set_ylim(bottom=0)
    axis.set_ylabel("mean of (v - [N = 0])², on fibres")


def tables(data: Data) -> list[Table]:
    """Counts; what images make of them; other treatments; steps; speed."""
    record = data.record
    rays = f"{record['rays']} rays for each geometry and kind of points; ± one standard error (jackknife)."
    counts = (
        f"Numbers of fibres that rays cross, N counted and n expected by the grid. Bias: mean n over mean N less 1. "
        f"Scatter: RMS of N about its mean at given n, over that of Poisson numbers. {rays}"
    )
    lit = (
        "What images make of the counts: mean a^N, and beside it exp(-n (1 - a)), its mean for Poisson numbers of mean "
        "n; share of rays for which the rule n ≤ 1/2 and N = 0 disagree, of these wrongly lit; mean of (v - [N = 0])² "
        f"for v = exp(-n) and by the rule. {rays}"
    )
    others = (
        "Bias, mean exp(-n) less the share of N = 0, and mean of (exp(-n) - [N = 0])², for the default (a quarter of a "
        "voxel on, the own fibre taken off, the sine with the term for its spread), with other starts, which keep the "
        f"own fibre, and with the root of the mean square sine alone. {rays}"
    )
    steps = f"RMS error of n by the step of the march, in voxels, against 1/16; scatter of N at given n beside. {rays}"
    where = ["geometry", "points", "grid"]
    step_names = [f"step {step:g}" for step in record["steps"]]
    return [
        _table(data, "counts", counts, [*where, "mean N", "bias", "n ≤ 1: n - N", "scatter", "N = 0", "exp(-n)"],
               _counts),
        _table(data, "lit", lit, [*where, "0.3^N", "0.3^n", "0.7^N", "0.7^n", "rule wrong", "wrongly lit",
                                  "error, exp(-n)", "error, rule"], _lit),
        _table(data, "others", others, [*where, "default", *record["others"]], _others),
        _table(data, "steps", steps, [*where, "mean n", "scatter of N", *step_names], _steps),
        _speed(data),
    ]  # fmt: skip


def _table(data: Data, name: str, caption: str, head: list[str], cells: Any) -> Table:
    """A row for each geometry, kind of points and grid."""
    record = data.record
    rows = [
        [geometry.replace("_", " "), where, str(resolution), *cells(data.arrays, (g, r, p))]
        for g, geometry in enumerate(record["geometries"])
        for p, where in enumerate(record["points"])
        for r, resolution in enumerate(record["resolutions"])
    ]
    return Table(name, caption, head, rows, "ll" + "r" * (len(head) - 2))


def _counts(arrays: Any, at: tuple[int, ...]) -> list[str]:
    return [
        f"{arrays['counts.mean_N'][at]:.2f}",
        _percent(arrays["counts.bias"][at], arrays["error.counts.bias"][at]),
        f"{arrays['counts.few'][at]:+.3f} ± {arrays['error.counts.few'][at]:.3f}",
        f"{arrays['counts.scatter'][at]:.2f} ± {arrays['error.counts.scatter'][at]:.2f}",
        f"{arrays['counts.zero'][at]:.3f}",
        f"{arrays['counts.exp'][at]:.3f}",
    ]


def _percent(value: float, error: float) -> str:
    return f"{100 * value:+.1f} ± {100 * error:.1f} %"


def _lit(arrays: Any, at: tuple[int, ...]) -> list[str]:
    powers = [f"{arrays[f'counts.{kind}power_{a}'][at]:.3f}" for a in ("0.3", "0.7") for kind in ("", "mean_")]
    shares = [f"{100 * arrays[f'counts.{name}'][at]:.1f} %" for name in ("wrong", "wrongly_lit")]
    return powers + shares + [f"{arrays[f'counts.brier_{rule}'][at]:.4f}" for rule in ("poisson", "threshold")]


def _others(arrays: Any, at: tuple[int, ...]) -> list[str]:
    bias, v, zero, square = (arrays[f"counts.{name}"][at] for name in ("bias", "exp", "zero", "brier_poisson"))
    others = zip(*(arrays[f"others.{name}"][at] for name in ("bias", "exp_less_zero", "brier")), strict=True)
    treatments = [(bias, v - zero, square), *others]
    return [f"{100 * shift:+.1f} %, {less:+.3f}, {error:.4f}" for shift, less, error in treatments]


def _steps(arrays: Any, at: tuple[int, ...]) -> list[str]:
    steps = [f"{error:.3f}" for error in arrays["steps.rms"][at]]
    return [f"{arrays['counts.mean_n'][at]:.2f}", f"{arrays['counts.deviation'][at]:.2f}", *steps]


def _speed(data: Data) -> Table:
    arrays, record = data.arrays, data.record
    rows = []
    for g, geometry in enumerate(record["geometries"]):
        for r in range(len(record["resolutions"])):
            shape = " x ".join(str(count) for count in arrays["voxels"][g, r])
            cells = [f"{value:.0f}" for value in arrays["speed.nanoseconds"][g, r]]
            cells += [f"{arrays['speed.memory'][g, r] / 1e6:.2f}", f"{arrays['speed.seconds'][g, r]:.2f}"]
            rows.append([geometry.replace("_", " "), shape, *cells])
    caption = (
        f"Nanoseconds of one core a ray, float32, from points on fibres (auto is here {record['speed']['backend']}); "
        "memory with both forms of the moments; seconds to fill the grid."
    )
    return Table("speed", caption, ["geometry", "grid", *record["speed_kinds"], "memory / MB", "seconds"], rows)
