"""Draws the distribution of excesses, their fall with the number of training fibres, and each fibre; tabulates all."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dsfit.experiment.plots.style import COLORS
from dsfit.figures import Data, Table
from dsfit.figures.page import Page

STREAMS = {"angle": "all inclinations", "sphere": "as a renderer meets them"}
MEDIAN, P99 = 0, 2
"""Among the levels of quantiles."""
LEAST = 5e-3
"""Fibres without absorption are drawn there."""


def figures(data: Data, page: Page) -> dict[str, Figure]:
    """Unseen fibres together; each by its absorption."""
    together = page.figure(0.58)
    left, right = together.subplots(1, 2)
    _spread(left, data)
    _curve(right, data)
    together.legend(loc="outside lower center", ncols=2, frameon=False)
    single = page.figure(0.5)
    _by_fiber(single.subplots(), data)
    single.legend(loc="outside lower center", ncols=4, frameon=False)
    return {"unseen": together, "by_fiber": single}


def captions(data: Data) -> dict[str, str]:
    """What the two figures show."""
    arrays, record = data.arrays, data.record
    levels = {key: 10 ** arrays[f"{key}.all.log10"] for key in ("angle.untrained", "angle.trained")}
    median, high = ([values[k] for values in levels.values()] for k in (MEDIAN, P99))
    numbers = arrays["curve.fibers"]
    worst, dark = (
        10 ** arrays["angle.trained.by_fiber.log10"][:, P99],
        arrays["fiber.sigma_a"][: record["unseen"]].max(-1) > 1,
    )
    tails = [float(np.median(worst[some])) if some.any() else float("nan") for some in (~dark, dark)]
    return {
        "unseen": f"Excess of one network for a family of fibres at {record['unseen']} fibres that it has not been "
        "trained on, by quadrature, constant light. Left: share of contexts with a lower excess, before (dotted) and "
        "after training (lines), for inclinations spread evenly and for contexts as a renderer meets them; with all "
        f"inclinations training lowers the median from {median[0]:.2g} to {median[1]:.2g}, the 99th percentile from "
        f"{high[0]:.2g} to {high[1]:.2g}. Right: median and 99th percentile after training with {numbers[0]} to "
        f"{numbers[-1]} fibres; bars: one standard error by the bootstrap over unseen fibres.",
        "by_fiber": f"Median and 99th percentile of the excess over all inclinations for each of {record['unseen']} "
        "unseen fibres, by its largest absorption σ_a per fibre radius; hollow: elliptic sections. The "
        f"99th percentile has its median at {tails[0]:.2g} for σ_a below 1, at {tails[1]:.2g} above.",
    }


def _spread(axis: Axes, data: Data) -> None:
    """Share of pairs of unseen fibres with a lower excess."""
    for color, (name, label) in zip(COLORS, STREAMS.items(), strict=False):
        for stage, line in (("untrained", ":"), ("trained", "-")):
            value = 10 ** data.arrays[f"{name}.{stage}.curve.log10"]
            axis.plot(value, data.record["levels"], line, color=color, label=f"{label}, {stage}")
    axis.set(xscale="log", xlabel="excess", ylabel="share of pairs below", ylim=(0, 1.01))
    axis.set_title("contexts of unseen fibres")
    axis.grid(True)


def _curve(axis: Axes, data: Data) -> None:
    """Median and 99 % by the number of training fibres, with standard errors."""
    numbers = data.arrays["curve.fibers"]
    for k, (color, name) in enumerate(zip(COLORS, STREAMS, strict=False)):
        for level, line in ((MEDIAN, "-"), (P99, "--")):
            log, error = (data.arrays[f"curve.{name}.{key}"][:, level] for key in ("log10", "log10_error"))
            value = 10**log
            bars = [value - 10 ** (log - error), 10 ** (log + error) - value]
            shifted = numbers * 1.04 ** (2 * k - 1)
            axis.errorbar(shifted, value, yerr=bars, color=color, linestyle=line, marker="o", ms=3, elinewidth=0.8)
    for label, line in (("right: median", "-"), ("right: 99th percentile", "--")):
        axis.plot([], [], line, color="0.3", label=label)
    axis.set(xscale="log", yscale="log", xlabel="training fibres", ylabel="excess")
    axis.set_xticks(numbers, [str(k) for k in numbers])
    axis.minorticks_off()
    axis.set_title("trained, with standard errors")
    axis.grid(True)


def _by_fiber(axis: Axes, data: Data) -> None:
    """Each unseen fibre at its largest absorption."""
    largest = np.maximum(data.arrays["fiber.sigma_a"].max(-1), LEAST)
    value = 10 ** data.arrays["angle.trained.by_fiber.log10"]
    for k in range(data.record["unseen"]):
        face = COLORS[0] if data.arrays["fiber.eccentricity"][k] == 1 else "white"
        axis.plot([largest[k]] * 2, value[k, [MEDIAN, P99]], color="#bbbbbb", lw=1, zorder=1)
        for level, marker in ((MEDIAN, "o"), (P99, "^")):
            axis.plot(largest[k], value[k, level], marker, color=COLORS[0], mfc=face, ms=4.5)
    for marker, face, label in (("o", COLORS[0], "median"), ("^", COLORS[0], "99th percentile"),
                                ("s", COLORS[0], "round"), ("s", "white", "elliptic")):  # fmt: skip
        axis.plot([], [], marker, color=COLORS[0], mfc=face, ms=4.5, linestyle="none", label=label)
    axis.set(xscale="log", yscale="log", xlabel="largest σ_a of the channels, per fibre radius")
    axis.set_xticks([LEAST, 0.01, 0.1, 1, 10], ["0", "0.01", "0.1", "1", "10"])
    axis.set_ylabel("excess of an unseen fibre, trained")
    axis.grid(True)


def tables(data: Data) -> list[Table]:
    """Excesses at unseen fibres and presets; against per-fibre training; by number of fibres; where it is worst."""
    arrays, record = data.arrays, data.record
    head = ["median", "95 %", "99 %", "worst"]
    rows = []
    for name, label in STREAMS.items():
        rows.append([f"{label}: untrained", *_cells(arrays, f"{name}.untrained.all")])
        for kind, what in (("all", "trained"), ("round", "trained, round"), ("eccentric", "trained, elliptic")):
            rows.append([f"{label}: {what}", *_cells(arrays, f"{name}.trained.{kind}")])
        for preset in record["presets"]:
            rows.append([f"{label}: {preset}, trained", *_cells(arrays, f"{name}.trained.{preset}")])
    spent = ", ".join(f"{record['table_seconds'][key]:.2f} s ({name})" for key, name in
                      (("round", "round"), ("eccentric", "elliptic"), ("bsdf", "the BSDF's own")))  # fmt: skip
    middle = 10 ** float(arrays["mix.family.log10"][0]), float(np.median(arrays["mix.pairs"]))
    caption = (
        f"Excess at {record['unseen']} unseen fibres and at the presets, none of them trained on. At "
        f"{len(arrays['mix.pairs'])} pairs the median is {middle[0]:.2g}, that of the best mix of the chapter's "
        f"proposals {middle[1]:.2g}. ×/÷: the factor of one standard error, by the bootstrap over fibres (of one "
        f"fibre: over views). Tables of a new fibre: {spent}; targets: {record['target_seconds']:.0f} s."
    )
    own = []
    for name, seconds in zip(record["own"], record["own_seconds"], strict=True):
        own.append([f"{name}: family", *_cells(arrays, f"own.{name}.family")])
        own.append([f"{name}: trained alone, {seconds:.0f} s", *_cells(arrays, f"own.{name}.own")])
    curve = []
    for k, number in enumerate(arrays["curve.fibers"]):
        title = f"{number} fibres, {arrays['curve.steps'][k]} steps, {record['training_seconds'][k]:.0f} s"
        for name, label in (("train", "trained on"), *STREAMS.items()):
            curve.append([f"{title}: {label}", *_cells(arrays, f"curve.{name}", k)])
    worst = [
        [STREAMS[name], str(row["fiber"]), f"{row['excess']:.2g}", f"{row['theta_r_deg']:.0f}", f"{row['n']:.1f}",
         f"{float(row['v']):.2g}"]
        for name in STREAMS for row in record["worst"][name]
    ]  # fmt: skip
    exact = [[f"{arrays[f'exact.{key}'][k]:.4g}" for key in ("used", "exact", "mass")]
             for k in range(len(arrays["exact.used"]))]  # fmt: skip
    return [
        Table("unseen", caption, ["contexts, fibres", *head], rows),
        Table("own", "The family's proposal and one trained for the fibre alone, at contexts that neither has seen.",
              ["fibre", *head], own),
        Table("curve", "Excess by the number of training fibres, at their own contexts and at unseen fibres.",
              ["training", *head], curve),
        Table("worst", "The largest excesses at unseen fibres.",
              ["contexts", "fibre", "excess", "θ_r / °", "n", "v"], worst),
        Table("exact", "Excess by the quadrature used here and by dsfit.excess, for pairs of round fibres, the last "
              "the worst of all; mass of the density.", ["used", "dsfit.excess", "mass"], exact, "rrr"),
    ]  # fmt: skip


def _cells(arrays: Any, name: str, row: int | None = None) -> list[str]:
    """Quantiles as factors: value, and the factor by which one standard error raises it where there is one."""
    log, error, worst = (arrays[f"{name}.{key}"] if row is None else arrays[f"{name}.{key}"][row]
                         for key in ("log10", "log10_error", "worst"))  # fmt: skip
    if np.isnan(worst):
        return [""] * 4
    return [*(f"{10**x:.2g} ×/÷ {10**e:.2f}" for x, e in zip(log, error, strict=True)), f"{worst:.2g}"]
