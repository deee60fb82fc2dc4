"""Draws and tabulates heuristics against fits."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from dsfit.experiment.files import number
from dsfit.experiment.plots.style import COLORS, MARKERS
from dsfit.figures import Data, Table
from dsfit.figures.page import Page

FLOOR = 3e-5
HEAVY = 0.02
"""Lobes with less weight than this have no centre and width to speak of."""
FILLS = ("#0072B2", "#D55E00", "#009E73", "#7FB8D8", "#EEB080", "#80CDB9", "#CC79A7", "#BBBBBB")
LABELS = ("R", "TT", "TRT", "R scattered", "TT scattered", "TRT scattered", "back", "broad, uniform")
KINDS = (("mix", "mixture of least variance"), ("fitted", "fitted"), ("amortised", "amortised"))
SHOWN = ("R", "TT", "TT_scattered", "back")


def figures(data: Data, page: Page) -> dict[str, Figure]:
    """Excess over contexts; run time; for each fibre the shares and the shapes of the lobes."""
    found = {"excess": _excess(data, page), "time": _time(data, page)}
    for preset in data.record["presets"]:
        found[f"shares_{preset}"] = _shares(data, page, preset)
        found[f"shapes_{preset}"] = _shapes(data, page, preset)
    return found


def captions(data: Data) -> dict[str, str]:
    """What the figures show."""
    record = data.record
    presets, methods = record["presets"], record["methods"]
    count = len(data.arrays[f"{presets[0]}.contexts"])
    medians = [np.median(data.arrays[f"{preset}.excess"], axis=0) for preset in presets]
    of = {name: [row[methods.index(name)] for row in medians] for name in ("best mix", "fitted", "amortised")}
    told = {name: " and ".join(f"{x:.2g}" for x in values) for name, values in of.items()}
    sizes, context = record["timed_samples"], f"θ_r = {number(record['fixed_theta_r_deg']):g}°"
    found = {
        "excess": f"Excess over the least second moment at {count} contexts of each fibre, constant light, judged by "
        "quadrature nodes that no fit has seen. Left: a dot for each context, bar: median; right: share of contexts "
        "below. Optimal weights subtract control variates, so that their excess can be below 0; values below "
        f"{FLOOR:.0e} are drawn there. Medians ({', '.join(presets)}): {told['best mix']} for the best mix of the "
        f"chapter's proposals, {told['fitted']} for fits context by context, {told['amortised']} for one amortised "
        "proposal.",
        "time": f"Relative root mean square error against the median CPU time of one estimate, one thread, of "
        f"{sizes[0]} to {sizes[-1]:,} samples (larger marks: more), at {context}, n = {number(record['fixed_n']):g}; "
        f"bars: 95 % intervals from {record['timed_repeats']} estimates. Times leave out what comes before: the choice "
        "of a mix, the fit, the training (see the table of costs). Marks above one another: there the fixed cost of a "
        "call prevails over that of samples.",
    }
    steps = f"{len(record['theta_r_deg'])} inclinations and {len(record['n'])} numbers of fibres"
    for preset in presets:
        moves = [
            50 * np.abs(np.diff(data.arrays[f"{preset}.theta_r.{kind}"].astype(float), axis=0)).sum(1).mean()
            for kind in ("mix", "fitted")
        ]
        found[f"shares_{preset}"] = (
            f"{preset.capitalize()} hair: shares of the lobes in the mixture of the chapter's proposals of least "
            f"variance (top), in fits context by context (middle, dots: edges at {steps}) and in one amortised "
            "proposal (bottom), over the inclination of the view (left) and n (right, v = exp(-n)). Pale: lobes "
            f"widened by scattering among fibres. From one inclination to the next {moves[0]:.0f} % of the samples of "
            f"the chapter's mix change lobe in the mean, and {moves[1]:.0f} % of the fit's."
        )
        found[f"shapes_{preset}"] = (
            f"{preset.capitalize()} hair: mode (top) and width (bottom, root of the product of both sides) of the "
            "longitudinal lobes over the inclination of the view (left) and n (right). Marks: fits context by context; "
            f"lines: one amortised proposal; drawn only where a lobe has {100 * HEAVY:g} % of the samples or more. "
            f"Over the inclination, the modes of both differ by {_gap(data, preset, 'TT'):.1f}° for TT and by "
            f"{_gap(data, preset, 'R'):.1f}° for R, in the mean."
        )
    return found


def _gap(data: Data, preset: str, lobe: str) -> float:
    """Mean difference in degrees between the modes of fitted and amortised lobes, over inclinations where both are
    heavy."""
    g, key = data.record["groups"].index(lobe), f"{preset}.theta_r"
    points, dense = np.array(data.record["theta_r_deg"], dtype=float), data.arrays[f"{key}.dense"]
    line = np.interp(points, dense, data.arrays[f"{key}.amortised_shape"][:, g, 0])
    share = np.interp(points, dense, data.arrays[f"{key}.amortised"][:, g])
    heavy = np.minimum(share, data.arrays[f"{key}.fitted"][:, g]) >= HEAVY
    gap = np.abs(line - data.arrays[f"{key}.shape"][:, g, 0])[heavy]
    return float(gap.mean()) if len(gap) else float("nan")


def tables(data: Data) -> list[Table]:
    """Excess over contexts, what it takes, and how near the amortised shares are to the fitted ones."""
    return [_summary(data), _costs(data), _agreement(data)]


def _excess(data: Data, page: Page) -> Figure:
    record = data.record
    presets, methods = record["presets"], record["methods"]
    figure = page.figure(0.12 + 0.46 * len(presets))
    axes = figure.subplots(len(presets), 2, sharex="col", squeeze=False)
    for preset, (dots, shares) in zip(presets, axes, strict=True):
        values = data.arrays[f"{preset}.excess"]
        spread = np.linspace(-0.28, 0.28, len(values))
        for m in range(len(methods)):
            x = values[:, m]
            seen = x > FLOOR
            dots.plot(m + spread[seen], x[seen], "o", ms=2.2, mew=0, alpha=0.7, color=COLORS[m])
            dots.plot(m + spread[~seen], np.full(int((~seen).sum()), FLOOR), "v", ms=3, mew=0, color=COLORS[m])
            dots.plot(m, max(float(np.median(x)), FLOOR), "_", ms=15, mew=1.6, color="0.2")
            ordered = np.sort(np.maximum(x, FLOOR))
            shares.step(
                ordered, np.arange(1, len(x) + 1) / len(x), where="post", color=COLORS[m], lw=1.2, label=methods[m]
            )
        dots.set(yscale="log", ylim=(0.7 * FLOOR, None), ylabel="excess", title=preset)
        dots.set_xticks(range(len(methods)), methods, rotation=60, ha="right")
        shares.set(xscale="log", ylim=(0, 1), ylabel="share of contexts below", title=preset)
        for axis in (dots, shares):
            axis.grid(True)
    axes[-1, 1].set_xlabel("excess")
    handles, labels = axes[0, 1].get_legend_handles_labels()
    handles += [
        Line2D([], [], color="0.2", marker="_", ls="", ms=12, mew=1.6),
        Line2D([], [], color="0.4", marker="v", ls="", ms=4),
    ]
    figure.legend(
        handles, [*labels, "median", f"below {FLOOR:.0e}"], loc="outside lower center", ncols=4, frameon=False
    )  # fmt: skip
    return figure


def _time(data: Data, page: Page) -> Figure:
    record = data.record
    presets = record["presets"]
    figure = page.figure(0.6)
    axes = figure.subplots(1, len(presets), squeeze=False)[0]
    for preset, axis in zip(presets, axes, strict=True):
        error, spread, seconds = (data.arrays[f"{preset}.timed.{key}"] for key in ("error", "error_se", "seconds"))
        for m in range(len(record["methods"])):
            x, y, bars = 1e3 * seconds[m], 100 * error[m], 196 * spread[m]
            axis.errorbar(x, y, bars, ls="-", lw=0.5, elinewidth=0.9, color=COLORS[m], alpha=0.7)
            for k in range(len(x)):
                axis.plot(x[k], y[k], MARKERS[m], ms=2.4 + 0.9 * k, mew=0, color=COLORS[m])
        axis.set(
            xscale="log", yscale="log", xlabel="CPU time of an estimate / ms", ylabel="relative error / %",
            title=f"{preset}, θ_r = {number(record['fixed_theta_r_deg']):g}°, n = {number(record['fixed_n']):g}",
        )  # fmt: skip
        _plain_ticks(axis.xaxis)
        _plain_ticks(axis.yaxis)
        axis.grid(True)
    handles = [
        Line2D([], [], color=COLORS[m], marker=MARKERS[m], ms=3.2, lw=1.0, label=name)
        for m, name in enumerate(record["methods"])
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=4, frameon=False)
    return figure


def _plain_ticks(side: Any, subs: tuple[int, ...] = (1, 3)) -> None:
    """Plain numbers on a logarithmic axis."""
    side.set_minor_formatter(NullFormatter())
    side.set_major_locator(LogLocator(subs=subs))
    side.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))


def _slices(data: Data) -> list[tuple[str, np.ndarray, str, str]]:
    """Name, points where fits are, label of the axis and what is fixed, of both slices."""
    record = data.record
    return [
        ("theta_r", np.array(record["theta_r_deg"], dtype=float), "θ_r / °", f"n = {number(record['fixed_n']):g}"),
        ("n", np.array(record["n"], dtype=float), "n", f"θ_r = {number(record['fixed_theta_r_deg']):g}°"),
    ]


def _scale(axis: Any, name: str, points: np.ndarray, margin: float = 0.0) -> None:
    """Limits of a slice; n on a scale that shows 0 and tens."""
    if name == "n":
        axis.set_xscale("function", functions=(np.log1p, np.expm1))
        ticks = [x for x in (0, 1, 2, 4, 8, 16, 30) if points.min() <= x <= points.max()]
        axis.set_xticks(ticks, [str(x) for x in ticks], minor=False)
        axis.set_xticks([], minor=True)
    if points.min() < points.max():
        if name == "n":
            room = margin * np.log1p(points.max())
            axis.set_xlim(np.expm1(np.log1p(points.min()) - room), np.expm1(np.log1p(points.max()) + room))
        else:
            room = margin * np.ptp(points)
            axis.set_xlim(points.min() - room, points.max() + room)


def _shares(data: Data, page: Page, preset: str) -> Figure:
    figure = page.figure(1.12)
    axes = figure.subplots(len(KINDS), 2, sharex="col", sharey=True, squeeze=False)
    for column, (name, points, label, fixed) in enumerate(_slices(data)):
        for axis, (kind, title) in zip(axes[:, column], KINDS, strict=True):
            x = data.arrays[f"{preset}.{name}.dense"] if kind == "amortised" else points
            weights = data.arrays[f"{preset}.{name}.{kind}"]
            axis.stackplot(x, weights.T, colors=FILLS, lw=0)
            if kind != "amortised":
                for edge in np.cumsum(weights, axis=1)[:, :-1].T:
                    axis.plot(x, edge, "o", ms=1.5, color="0.2", mew=0)
            _scale(axis, name, points)
            axis.set(ylim=(0, 1), title=f"{title}, {fixed}")
        axes[-1, column].set_xlabel(label)
    for axis in axes[:, 0]:
        axis.set_ylabel("share")
    handles = [Patch(color=fill, label=text) for fill, text in zip(FILLS, LABELS, strict=True)]
    figure.legend(handles=handles, loc="outside lower center", ncols=4, frameon=False, title=preset)
    return figure


def _shapes(data: Data, page: Page, preset: str) -> Figure:
    """Centre and width (root of the product of both sides) of the heavier lobes: dots fits, lines amortised."""
    record = data.record
    figure = page.figure(0.92)
    axes = figure.subplots(2, 2, sharex="col", sharey="row", squeeze=False)
    for column, (name, points, label, fixed) in enumerate(_slices(data)):
        dense = data.arrays[f"{preset}.{name}.dense"]
        for row, axis in enumerate(axes[:, column]):
            for c, lobe in enumerate(SHOWN):
                g = record["groups"].index(lobe)
                for key, x, weights in (("shape", points, "fitted"), ("amortised_shape", dense, "amortised")):
                    mode, below, above = data.arrays[f"{preset}.{name}.{key}"][:, g].T
                    value = mode if row == 0 else np.sqrt(below * above)
                    heavy = data.arrays[f"{preset}.{name}.{weights}"][:, g] >= HEAVY
                    value = np.where(heavy, value, np.nan)
                    style = {"ls": "", "marker": MARKERS[c], "ms": 3.4} if key == "shape" else {"lw": 1.2}
                    axis.plot(x, value, color=COLORS[c], **style)
            _scale(axis, name, points, margin=0.03)
            axis.grid(True)
        axes[0, column].set_title(fixed)
        axes[1, column].set_xlabel(label)
        axes[1, column].set_yscale("log")
        _plain_ticks(axes[1, column].yaxis, (1, 2, 3, 5))
    axes[0, 0].set_ylabel("mode of θ_h / °")
    axes[1, 0].set_ylabel("width / °")
    handles = [
        Line2D([], [], color=COLORS[c], marker=MARKERS[c], ms=3.4, lw=1.2, label=LABELS[record["groups"].index(lobe)])
        for c, lobe in enumerate(SHOWN)
    ]
    handles += [
        Line2D([], [], color="0.3", marker="o", ls="", ms=3.4, label="fitted to the context"),
        Line2D([], [], color="0.3", lw=1.2, label="amortised"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False, title=preset)
    return figure


def _summary(data: Data) -> Table:
    rows = []
    for preset in data.record["presets"]:
        values = data.arrays[f"{preset}.excess"]
        for m, name in enumerate(data.record["methods"]):
            x = values[:, m]
            ahead = np.median(values[:, m] / values[:, data.record["methods"].index("fitted")])
            rows.append([preset, name, f"{np.median(x):.2g}", f"{x.min():.2g}", f"{np.quantile(x, 0.9):.2g}",
                         f"{x.max():.2g}", f"{ahead:.3g}"])  # fmt: skip
    count = len(data.arrays[f"{data.record['presets'][0]}.contexts"])
    caption = (
        f"Excess over the least second moment at {count} contexts of each fibre, by quadrature nodes that no fit has "
        "seen: median, least, 90 %, largest; last the median of the ratio to the fit. For combinations it is (N Var + "
        "|∫F|²) / M* − 1. Optimal weights subtract control variates, so they are not bound by 0."
    )
    head = ["fibre", "method", "median", "least", "90 %", "largest", "over fitted"]
    return Table("excess", caption, head, rows, "llrrrrr")


def _costs(data: Data) -> Table:
    rows = []
    for preset in data.record["presets"]:
        facts = data.record["seconds"][preset]
        rows.append([preset, *(f"{number(facts[key]):.3g}" for key in ("nodes", "mix", "start", "fit")),
                     f"{1e3 * number(facts['amortised']):.3g}", f"{number(facts['training']):.3g}"])  # fmt: skip
    caption = (
        "CPU seconds: median over contexts of the quadrature nodes, of the best mix on them, of the structured start "
        "and "
        "of its fit; milliseconds of evaluating the amortised proposal at a context; its training, once for the fibre."
    )
    head = ["fibre", "nodes / s", "best mix / s", "start / s", "fit / s", "amortised / ms", "training / s"]
    return Table("costs", caption, head, rows)


def _agreement(data: Data) -> Table:
    """Distance between the shares of fits and of the amortised proposal at the same contexts."""
    rows = []
    groups = data.record["groups"]
    together = {"R": (0, 3), "TT": (1, 4), "TRT": (2, 5), "back": (6,), "broad": (7,)}
    for preset in data.record["presets"]:
        for name, points, _, fixed in _slices(data):
            dense = data.arrays[f"{preset}.{name}.dense"]
            weights = data.arrays[f"{preset}.{name}.amortised"]
            there = np.stack([np.interp(points, dense, weights[:, g]) for g in range(len(groups))], axis=1)
            gap = there - data.arrays[f"{preset}.{name}.fitted"]
            rows.append([preset, f"over {'θ_r' if name == 'theta_r' else 'n'}, {fixed}",
                         *(f"{np.abs(gap[:, list(members)].sum(1)).mean():.3f}" for members in together.values()),
                         f"{0.5 * np.abs(gap).sum(1).mean():.3f}"])  # fmt: skip
    caption = (
        "Mean over a slice of the absolute difference between the amortised and the fitted share of R, TT, TRT (direct "
        "and scattered together), back, and broad; last half the sum over all eight groups (total variation)."
    )
    return Table("agreement", caption, ["fibre", "slice", *together, "all groups"], rows, "ll" + "r" * 6)
