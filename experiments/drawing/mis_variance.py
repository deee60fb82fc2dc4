"""Draws and tabulates the variance of the MIS heuristics."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from dsfit.experiment.files import number
from dsfit.experiment.plots.style import COLORS, MARKERS
from dsfit.figures import Data, Table
from dsfit.figures.page import Page

MODELS = ("multi-sample", "one-sample")


def figures(data: Data, page: Page) -> dict[str, Figure]:
    """Heuristics against each other, measurement against quadrature, and shares of the samples."""
    return {"heuristics": _heuristics(data, page), "measured": _measured(data, page), "shares": _shares(data, page)}


def captions(data: Data) -> dict[str, str]:
    """What the figures show."""
    record, ratios = data.record, _ratios(data)
    names, first = record["rules"], record["set_names"][0]
    median = {name: np.median(ratios[:, 0, names.index(name), 0]) for name in ("maximum", "optimal")}
    one = float(np.median(ratios[:, 0, names.index("balance"), 1]))
    quick = float(np.median(_efficiencies(data)[:, 0, names.index("balance"), 1]))
    z_variance, z_mean = _z(data)
    plain = [k for k, name in enumerate(names) if name != "optimal"]

    def best(rule: str) -> str:
        exact = (data.arrays[f"pair{k}.exact"][names.index(rule), 0] for k in range(len(record["pairs"])))
        return ", ".join(f"{data.arrays['shares'][np.argmin(row)]:.2f}" for row in exact)

    each = f"{record['repeats']} estimates of {record['samples']:,} samples"
    return {
        "heuristics": f"Variance per sample (top) and variance times CPU time (bottom) of every weighting over those "
        f"of multi-sample balance, for {len(record['set_names'])} sets of proposals (columns) with equal shares; a dot "
        f"for each of {len(ratios)} contexts, bars: medians. Variances are exact, by quadrature; times as measured on "
        f"one thread. With {first}: maximum {median['maximum']:.2g} and optimal {median['optimal']:.2g} times balance "
        f"in the median, one-sample balance {one:.2g} times, and {quick:.2g} "
        "times with the time that its samples take.",
        "measured": f"Left: variance measured ({each}) over that by quadrature, for three weightings in both models, ± "
        "one standard error; large errors belong to heavy-tailed weights. Right: deviations of measured variances "
        "(without optimal, whose control variates are estimated) and means from quadrature in standard errors, with "
        f"the normal density: root mean square {_rms(z_variance[:, :, plain]):.2f} and {_rms(z_mean):.2f}.",
        "shares": f"Variance of pairs of proposals over the share of the samples that the first one gets, "
        f"{record['pair_preset']} hair, θ_r = {number(record['pair_theta_r_deg']):g}°, in the multi-sample (top) and "
        f"the one-sample model (bottom). Lines: quadrature; dots: measured, {each}, ± one standard error; stars: least "
        "variance; diamonds: one proposal alone, where it is within the scale. Best shares in the "
        f"multi-sample model: {best('balance')} for balance, {best('optimal')} for optimal.",
    }


def tables(data: Data) -> list[Table]:
    """Heuristics over all contexts; all contexts; the best shares."""
    return [_summary(data), _contexts(data), _best_shares(data)]


def _ratios(data: Data) -> np.ndarray:
    """Variance over that of multi-sample balance, `[context, set, rule, model]`."""
    exact = data.arrays["exact"]
    flat = exact.reshape(-1, *exact.shape[3:])
    return flat / flat[:, :, :1, :1]


def _efficiencies(data: Data) -> np.ndarray:
    """Variance x seconds over that of multi-sample balance."""
    seconds = data.arrays["seconds_per_sample"]
    return _ratios(data) * (seconds / seconds[:, :1, :1])


def _heuristics(data: Data, page: Page) -> Figure:
    record = data.record
    figure = page.figure(0.86)
    axes = figure.subplots(2, len(record["set_names"]), sharex=True, sharey="row", squeeze=False)
    rows = (_ratios(data), _efficiencies(data))
    for column, name in enumerate(record["set_names"]):
        for axis, values in zip(axes[:, column], rows, strict=True):
            for m in range(len(MODELS)):
                _dots(axis, values[:, column, :, m], 0.34 * (m - 0.5), COLORS[m])
            axis.axhline(1, color="0.6", lw=0.8, zorder=0)
            axis.set(yscale="log")
            axis.grid(True, axis="y")
        axes[0, column].set_title(name)
        axes[1, column].set_xticks(range(len(record["rules"])), record["rules"], rotation=60, ha="right")
    axes[0, 0].set_ylabel("variance per sample\nover that of balance")
    axes[1, 0].set_ylabel("variance × CPU time\nover that of balance")
    handles = [
        Line2D([], [], color=COLORS[m], marker="o", ls="", ms=4, label=f"{model} model")
        for m, model in enumerate(MODELS)
    ]
    handles.append(Line2D([], [], color="0.2", marker="_", ls="", ms=7, mew=1.6, label="median over contexts"))
    figure.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False)
    return figure


def _dots(axis: Any, values: np.ndarray, offset: float, color: str) -> None:
    """One column of dots for each rule, spread by the context's index, and their median."""
    count, rules = values.shape
    spread = np.linspace(-0.11, 0.11, count) if count > 1 else np.zeros(1)
    for r in range(rules):
        axis.plot(r + offset + spread, values[:, r], "o", ms=2.2, color=color, alpha=0.65, mew=0)
    axis.plot(np.arange(rules) + offset, np.median(values, axis=0), "_", ms=7, mew=1.6, color="0.2")


def _z(data: Data) -> tuple[np.ndarray, np.ndarray]:
    """Deviations of measured variances and means from quadrature in their standard errors, `[context, set, rule,
    model]`."""
    a = data.arrays
    shape = (-1, *a["exact"].shape[3:])
    variance = (a["variance"] - a["exact"]) / np.hypot(a["variance_se"], a["quadrature_error"])
    return variance.reshape(shape), ((a["mean"] - 1) / a["mean_se"]).reshape(shape)


def _measured(data: Data, page: Page) -> Figure:
    a, record = data.arrays, data.record
    figure = page.figure(0.46)
    left, right = figure.subplots(1, 2, width_ratios=(1.25, 1))
    shown = [k for k, name in enumerate(record["rules"]) if name in ("balance", "maximum", "optimal")]
    for color, marker, k in zip(COLORS, MARKERS, shown, strict=False):
        exact, value, error = (a[name][..., k, :].ravel() for name in ("exact", "variance", "variance_se"))
        left.errorbar(
            exact, value / exact, error / exact, fmt=marker, ms=2.6, lw=0.6, color=color, alpha=0.7,
            label=record["rules"][k],
        )  # fmt: skip
    left.axhline(1, color="0.4", lw=0.8)
    left.set(xscale="log", xlabel="N Var / |∫F|², quadrature", ylabel="measured / quadrature")
    left.grid(True)
    left.legend(frameon=False, loc="upper left")
    z_variance, z_mean = _z(data)
    plain = [k for k, name in enumerate(record["rules"]) if name != "optimal"]
    samples = (("variance", z_variance[:, :, plain]), ("mean", z_mean))
    edges = np.linspace(-5, 5, 26)
    for color, (name, z) in zip(COLORS, samples, strict=False):
        inside = np.clip(z.ravel(), -4.99, 4.99)
        right.hist(inside, edges, density=True, histtype="step", color=color, label=name, lw=1.2)
    x = np.linspace(-5, 5, 201)
    right.plot(x, np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi), color="0.4", lw=0.9, label="N(0, 1)")
    right.set(xlabel="deviation / standard error", ylabel="density")
    right.legend(frameon=False, loc="upper left")
    return figure


def _shares(data: Data, page: Page) -> Figure:
    record, grid = data.record, data.arrays["shares"]
    figure = page.figure(0.86)
    axes = figure.subplots(2, len(record["pairs"]), sharex=True, sharey="col", squeeze=False)
    for k, pair in enumerate(record["pairs"]):
        exact, value, error = (data.arrays[f"pair{k}.{name}"] for name in ("exact", "variance", "variance_se"))
        top = 1.3 * float(np.max(exact[:, :, (grid > 0.08) & (grid < 0.92)]))
        for m, axis in enumerate(axes[:, k]):
            for r, rule in enumerate(record["rules"]):
                color = COLORS[r % len(COLORS)]
                axis.plot(grid, exact[r, m], color=color, lw=1.1, label=rule)
                best = int(np.argmin(exact[r, m]))
                axis.plot(grid[best], exact[r, m, best], "*", ms=8, color=color, mec="white", mew=0.5, zorder=5)
                axis.errorbar(record["measured_shares"], value[r, m], error[r, m], fmt="o", ms=1.8, lw=0.7, color=color)
            for share, alone in zip((1, 0), data.arrays[f"pair{k}.alone"], strict=True):
                if alone < top:
                    axis.plot(share, alone, "D", ms=4, color="0.3", clip_on=False, zorder=6)
            axis.set(yscale="log", xlim=(0, 1), xticks=(0, 0.5, 1), ylim=(0.8 * np.nanmin(exact), top))
            few = top < 10 * np.nanmin(exact)  # less than a decade: more numbers on the axis
            axis.yaxis.set_major_locator(LogLocator(subs=(1, 2, 4, 6) if few else (1, 3)))
            axis.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{y:g}"))
            axis.yaxis.set_minor_formatter(NullFormatter())
            axis.grid(True)
        names = "\n".join(
            name.replace("transmittance_", "transm. ") for name in (pair["first"], f"and {pair['second']}")
        )
        axes[0, k].set_title(f"{names}, n = {number(pair['n']):g}")
        axes[1, k].set_xlabel(f"share of {pair['first']}")
    for m, model in enumerate(MODELS):
        axes[m, 0].set_ylabel(f"{model} model\nN Var / |∫F|²")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    handles += [
        Line2D([], [], color="0.3", marker="*", ls="", ms=8, label="least variance"),
        Line2D([], [], color="0.3", marker="D", ls="", ms=4, label="one proposal alone"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=5, frameon=False)
    return figure


def _summary(data: Data) -> Table:
    record, ratios, efficiencies = data.record, _ratios(data), _efficiencies(data)
    weights = [k for k, name in enumerate(record["rules"]) if name != "optimal"]
    rows = []
    for (s, name), (m, model) in itertools.product(enumerate(record["set_names"]), enumerate(MODELS)):
        winner = np.array(weights)[np.argmin(ratios[:, s, weights, m], axis=1)]
        for r, rule in enumerate(record["rules"]):
            x, e = ratios[:, s, r, m], efficiencies[:, s, r, m]
            wins = "–" if rule == "optimal" else str(int((winner == r).sum()))
            rows.append([name, model, rule, f"{np.median(x):.3g}", f"{x.min():.3g}", f"{x.max():.3g}", wins,
                         f"{np.median(e):.3g}"])  # fmt: skip
    z_variance, z_mean = _z(data)
    plain = [k for k, name in enumerate(record["rules"]) if name != "optimal"]
    caption = (
        f"Variance per sample with equal shares over that of multi-sample balance, by quadrature, over {len(ratios)} "
        "contexts: median, least, largest; wins: contexts where it is the least of its model, optimal left out, which "
        "is balance with control variates and not a weighting by densities alone. Efficiency: median of variance x CPU "
        "time over that of balance, time as `dsfit.estimate` takes it, whose one-sample model draws in one batch and "
        f"the multi-sample model in one for each proposal. Measured variances, {record['repeats']} x "
        f"{record['samples']} "
        f"samples each, deviate from quadrature by {_rms(z_variance[:, :, plain]):.2f} standard errors in the root "
        f"mean square (largest {np.abs(z_variance[:, :, plain]).max():.1f}), means by {_rms(z_mean):.2f} (largest "
        f"{np.abs(z_mean).max():.1f}); measured variances of optimal lie {100 * _optimal_cost(data):.1f} % above "
        "quadrature in the median: its control variates are estimated from the samples."
    )
    head = ["proposals", "model", "heuristic", "median", "least", "largest", "wins", "efficiency, median"]
    return Table("heuristics", caption, head, rows, "lllrrrrr")


def _optimal_cost(data: Data) -> float:
    """Median over everything of measured over exact variance of the optimal weights, less 1."""
    at = data.record["rules"].index("optimal")
    return float(np.median(data.arrays["variance"][..., at, :] / data.arrays["exact"][..., at, :])) - 1


def _rms(z: np.ndarray) -> float:
    return float(np.sqrt(np.mean(z**2)))


def _contexts(data: Data) -> Table:
    a, record = data.arrays, data.record
    names = record["rules"]
    weights = [k for k, name in enumerate(names) if name != "optimal"]
    rows = []
    axes = (record["presets"], record["theta_r_deg"], record["n"])
    for (i, preset), (j, theta), (k, n) in itertools.product(*(enumerate(axis) for axis in axes)):
        exact, value, error = (a[name][i, j, k, 0, :, 0] for name in ("exact", "variance", "variance_se"))
        best = weights[int(np.argmin(exact[weights]))]
        row = [preset, f"{number(theta):g}", f"{number(n):g}"]
        for rule in ("balance", "maximum", "optimal"):
            r = names.index(rule)
            row += [f"{exact[r]:.3g}", f"{value[r]:.3g} ± {error[r]:.1g}"]
        rows.append([*row, names[best], f"{exact[best] / exact[0]:.3g}"])
    caption = (
        f"N Var / |∫F|² of the multi-sample estimator with equal shares of the proposals “{record['set_names'][0]}”: "
        "by quadrature, and measured with its standard error; the heuristic of least variance (optimal left out), "
        "and its "
        "variance over that of balance."
    )
    head = ["fibre", "θ_r / °", "n", "balance", "measured", "maximum", "measured", "optimal", "measured", "least",
            "over balance"]  # fmt: skip
    return Table("contexts", caption, head, rows, "lrrrrrrrrlr")


def _best_shares(data: Data) -> Table:
    record, grid = data.record, data.arrays["shares"]
    middle, rows = int(np.argmin(np.abs(grid - 0.5))), []
    for k, pair in enumerate(record["pairs"]):
        exact, alone = data.arrays[f"pair{k}.exact"], data.arrays[f"pair{k}.alone"]
        for r, rule in enumerate(record["rules"]):
            row = [f"{pair['first']}, {pair['second']}, n = {number(pair['n']):g}", rule]
            for curve in exact[r]:
                best = int(np.argmin(curve))
                row += [f"{grid[best]:.2f}", f"{curve[best]:.3g}", f"{curve[middle]:.3g}"]
            rows.append([*row, *(f"{x:.3g}" for x in alone)])
    caption = (
        f"Two proposals ({record['pair_preset']}, θ_r = {number(record['pair_theta_r_deg']):g}°): share of the first "
        f"at which the variance N Var / |∫F|² is least (on a grid of {len(grid)}), that variance, and the one with "
        "equal "
        "shares, for the multi-sample and the one-sample model; the variances of the first and of the second alone."
    )
    head = ["proposals", "heuristic", "best share", "least", "equal", "one-sample: best share", "least", "equal",
            "first alone", "second alone"]  # fmt: skip
    return Table("shares", caption, head, rows, "llrrrrrrrr")
