"""Draws the progress of fits from samples, where they end, and what noise and devices do; tabulates the ends."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from dsfit.experiment.plots.style import COLORS, MARKERS
from dsfit.figures import Data, Table
from dsfit.figures.page import Page

METHODS = {"gauss_newton": "Gauss-Newton", "two_draws": "the same, two answers a sample", "adam": "Adam"}


def figures(data: Data, page: Page) -> dict[str, Figure]:
    """Progress without noise; with noise; where all ended; the stream and the gradients."""
    return {
        "progress": _progress(data, page),
        "noise": _noise(data, page),
        "ends": _ends(data, page),
        "stream_gradients": _stream_gradients(data, page),
    }


def captions(data: Data) -> dict[str, str]:
    """What the figures show."""
    arrays, record = data.arrays, data.record
    scenes, seeds = record["scenes"], record["seeds"]
    quiet = [(k, i) for k, i in enumerate(arrays["gauss_newton.scenes"]) if scenes[i]["noise"] is None]
    ends = np.array(
        [
            np.median(10 ** arrays["gauss_newton.log10_excess"][k, :, -1]) / arrays["quadrature.excess"][i]
            for k, i in quiet
        ]
    )
    cost = np.array(
        [
            np.median(arrays["gauss_newton.evaluations"][k, :, -1]) / arrays["quadrature.evaluations"][i]
            for k, i in quiet
        ]
    )
    best = int(np.argmax(arrays["gradients.log10_factor"]))
    factor, stream = (
        10 ** arrays["gradients.log10_factor"][best],
        np.median(10 ** arrays["stream.log10_median"], axis=0),
    )
    judged = "judged on finer quadrature nodes than any fit saw"
    return {
        "progress": f"Progress of Gauss-Newton fits to samples only, without noise: excess over that of the fit by "
        f"quadrature, {judged}, against evaluations of the integrand (left) and seconds (right), both over those of "
        f"the fit by quadrature with its nodes. Lines: medians of {seeds} seeds, bands: their range; a line below 1 "
        f"left of 1 is better for less. After {' to '.join(f'{x:.2g}' for x in (cost.min(), cost.max()))} times the "
        f"evaluations the excess is {ends.min():.2g} to {ends.max():.2g} times that of the quadrature fit.",
        "noise": f"The same where the light is noisy: every answer is the radiance times a random factor, lognormal or "
        f"0 or ten (roulette). Excess without the noise, {judged}; medians and ranges of {seeds} seeds, with one and "
        "with two independent answers for each sample; Adam after as many evaluations as one answer. Black: the fit by "
        "quadrature, which sees no noise; where a line stays at the start (dotted), no step was certain enough.",
        "ends": f"Where all fits ended, {judged}: medians (marks) and ranges (lines) of {seeds} seeds; scenes: fibre, "
        "inclination of the view, fibres in front, light (constant if none is named), noise. Gauss-Newton and Adam "
        "have the same evaluations.",
        "stream_gradients": f"Left: excess of one network trained on samples of a stream of contexts, at contexts not "
        f"trained on, median and worst over contexts, which falls from {stream[0]:.2g} to {stream[-1]:.2g} in the "
        "median. Right: how many times lower the variance of the gradient is with each device than with the plain "
        f"estimator, at equal evaluations; bars: 95 % intervals by the bootstrap; at most {factor:.2g} times "
        f"({record['plans'][best]}).",
    }


def _name(scene: dict[str, Any], noise: bool = True) -> str:
    light = "" if scene["light_width_deg"] is None else f", {scene['light_width_deg']:g}° light"
    tail = f", {scene['noise']}" if noise and scene["noise"] else ""
    return f"{scene['preset']} {scene['theta_r_deg']:g}°, n = {scene['n']:g}{light}{tail}"


def _progress(data: Data, page: Page) -> Figure:
    """Excess and cost over those of the quadrature fit, which is the point (1, 1): a colour a preset, a line a context;
    median and range of seeds."""
    arrays, scenes = data.arrays, data.record["scenes"]
    figure = page.figure(0.66)
    axes = figure.subplots(1, 2, sharey=True)
    rows = [(k, i) for k, i in enumerate(arrays["gauss_newton.scenes"]) if scenes[i]["noise"] is None]
    presets = list(dict.fromkeys(scenes[i]["preset"] for _, i in rows))
    seen: dict[str, int] = dict.fromkeys(presets, 0)
    for k, i in rows:
        preset = scenes[i]["preset"]
        color, line = COLORS[presets.index(preset)], ("-", "--", "-.", ":")[seen[preset] % 4]
        seen[preset] += 1
        ratio = 10 ** arrays["gauss_newton.log10_excess"][k] / arrays["quadrature.excess"][i]
        for axis, key in zip(axes, ("evaluations", "seconds"), strict=True):
            x = np.median(arrays[f"gauss_newton.{key}"][k], axis=0) / arrays[f"quadrature.{key}"][i]
            label = _name(scenes[i]) if key == "evaluations" else None
            axis.plot(x, np.median(ratio, axis=0), color=color, linestyle=line, linewidth=1.2, label=label)
            axis.fill_between(x, ratio.min(0), ratio.max(0), color=color, alpha=0.1, linewidth=0)
    for axis, label in zip(
        axes, ("evaluations / those of the quadrature fit", "time / that of the quadrature fit"), strict=True
    ):
        axis.axhline(1.0, color="black", linewidth=0.8, zorder=0.5)
        axis.axvline(1.0, color="black", linewidth=0.8, zorder=0.5)
        axis.plot(1.0, 1.0, "D", color="black", markersize=4, label=None)
        axis.set(xscale="log", yscale="log", xlabel=label)
        _plain_log(axis)
    axes[0].plot([], [], "D", linestyle="none", color="black", markersize=4, label="fit by quadrature")
    axes[0].set_ylabel("excess / excess of the quadrature fit")
    figure.legend(loc="outside lower center", ncols=2, frameon=False)
    return figure


def _noise(data: Data, page: Page) -> Figure:
    """A panel for each kind of noise: one answer a sample, and two."""
    arrays, scenes = data.arrays, data.record["scenes"]
    noisy = [i for i, scene in enumerate(scenes) if scene["noise"] is not None]
    figure = page.figure(0.5)
    for axis, i in zip(figure.subplots(1, max(len(noisy), 1), sharey=True, squeeze=False)[0], noisy, strict=False):
        for color, name in zip(COLORS, ("gauss_newton", "two_draws"), strict=False):
            k = list(arrays[f"{name}.scenes"]).index(i)
            x = np.median(arrays[f"{name}.evaluations"][k], axis=0)
            excess = 10 ** arrays[f"{name}.log10_excess"][k]
            answers = "one answer a sample" if name == "gauss_newton" else "two answers a sample"
            axis.plot(x, np.median(excess, axis=0), color=color, label=answers)
            axis.fill_between(x, excess.min(0), excess.max(0), color=color, alpha=0.15, linewidth=0)
        k = list(arrays["adam.scenes"]).index(i)
        _range(axis, np.median(arrays["adam.evaluations"][k]), 10 ** arrays["adam.log10_excess"][k, :, -1], 2, "Adam")
        axis.axhline(arrays["start"][i], color=COLORS[7], linewidth=1, linestyle=":", label="start")
        axis.axhline(arrays["quadrature.excess"][i], color="black", linewidth=0.8, label="quadrature, without noise")
        axis.set(xscale="log", yscale="log", xlabel="evaluations of the integrand", title=_name(scenes[i]))
        _plain_log(axis)
    if noisy:
        figure.axes[0].set_ylabel("excess")
        handles, labels = figure.axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False)
    return figure


def _ends(data: Data, page: Page) -> Figure:
    """Where every method ended, a row a scene."""
    arrays, scenes = data.arrays, data.record["scenes"]
    figure = page.figure(0.25 + 0.045 * len(scenes))
    axis = figure.subplots()
    for i in range(len(scenes)):
        axis.plot([arrays["start"][i]] * 2, [i - 0.35, i + 0.35], color=COLORS[7], linewidth=1.5,
                  label=None if i else "start")  # fmt: skip
        axis.plot(arrays["quadrature.excess"][i], i - 0.27, "D", color="black", markersize=4,
                  label=None if i else "fit by quadrature")  # fmt: skip
    for k, name in enumerate(key for key in METHODS if f"{key}.scenes" in arrays):
        label: str | None = METHODS[name]
        for row, i in enumerate(arrays[f"{name}.scenes"]):
            found, y = 10 ** arrays[f"{name}.log10_excess"][row, :, -1], i - 0.09 + 0.18 * k
            axis.plot([found.min(), found.max()], [y, y], color=COLORS[k], linewidth=1.5)
            axis.plot(np.median(found), y, MARKERS[k], color=COLORS[k], markersize=4, label=label)
            label = None
    axis.set_yticks(range(len(scenes)), [_name(scene) for scene in scenes])
    axis.set(xscale="log", xlabel="excess: median and range of seeds", ylim=(len(scenes) - 0.5, -0.5))
    axis.grid(True, axis="x")
    figure.legend(loc="outside lower center", ncols=3, frameon=False)
    return figure


def _stream_gradients(data: Data, page: Page) -> Figure:
    """Excess of the amortised proposal over evaluations; variance of the gradient against the plain estimator."""
    arrays = data.arrays
    figure = page.figure(0.45)
    left, right = figure.subplots(1, 2)
    x = np.maximum(arrays["stream.evaluations"], 1000.0)
    for k, name in enumerate(("median", "worst")):
        value = 10 ** arrays[f"stream.log10_{name}"]
        left.plot(x, np.median(value, axis=0), "o-", color=COLORS[k], label=name, markersize=3.5)
        left.fill_between(x, value.min(0), value.max(0), color=COLORS[k], alpha=0.15, linewidth=0)
    left.set(xscale="log", yscale="log", xlabel="evaluations (left end: 0)", ylabel="excess")
    left.set_title("one network, contexts not trained on")
    left.set_ylim(bottom=10 ** np.floor(np.log10(left.get_ylim()[0])))
    left.legend(frameon=False)
    plans = data.record["plans"]
    low, factor, high = (10 ** arrays[f"gradients.log10_{key}"] for key in ("low", "factor", "high"))
    right.hlines(range(len(plans)), low, high, color=COLORS[0])
    right.plot(factor, range(len(plans)), "o", color=COLORS[0], markersize=4)
    right.set_yticks(range(len(plans)), plans)
    right.set(xscale="log", xlabel="variance of plain / variance, 95 %", ylim=(len(plans) - 0.5, -0.5))
    right.set_title("gradient of the variance")
    for axis in (left, right):
        _plain_log(axis)
    return figure


def _range(axis: Axes, x: float, values: np.ndarray, k: int, label: str) -> None:
    axis.plot([x, x], [values.min(), values.max()], color=COLORS[k], linewidth=1.5)
    axis.plot(x, np.median(values), MARKERS[k], color=COLORS[k], markersize=4, label=label)


def _plain_log(axis: Axes) -> None:
    """A grid, and no numbers between the decades."""
    axis.grid(True)
    for one in (axis.xaxis, axis.yaxis):
        if one.get_scale() == "log":
            one.set_major_locator(LogLocator(10))
            one.set_minor_formatter(NullFormatter())


def tables(data: Data) -> list[Table]:
    """Where fits ended: medians over seeds, with the range."""
    arrays, rows = data.arrays, []
    for i, scene in enumerate(data.record["scenes"]):
        for name in METHODS:
            if f"{name}.scenes" not in arrays or i not in arrays[f"{name}.scenes"]:
                continue
            k = list(arrays[f"{name}.scenes"]).index(i)
            found = 10 ** arrays[f"{name}.log10_excess"][k, :, -1]
            evaluations = np.median(arrays[f"{name}.evaluations"][k, :, -1])
            ratio = np.median(arrays[f"{name}.seconds"][k, :, -1]) / arrays["quadrature.seconds"][i]
            rows.append([
                _name(scene), METHODS[name], f"{arrays['start'][i]:.2g}", f"{arrays['quadrature.excess'][i]:.2g}",
                f"{np.median(found):.2g}", f"{found.min():.2g} to {found.max():.2g}",
                f"{arrays['quadrature.evaluations'][i]:.0f}", f"{evaluations:.0f}", f"{ratio:.2g}",
            ])  # fmt: skip
    caption = (
        f"Excess at the start, of the fit by quadrature, and of fits to samples only: median and range of "
        f"{data.record['seeds']} seeds; evaluations of the integrand (an answer each); seconds over those of the fit "
        "by quadrature."
    )
    head = ["scene", "method", "start", "quadrature", "samples", "range", "evaluations, quadrature",
            "evaluations, samples", "seconds ratio"]  # fmt: skip
    ends = Table("ends", caption, head, rows, "llrrrrrrr")
    factors = [
        [name, *(f"{10 ** arrays[f'gradients.log10_{key}'][k]:.3g}" for key in ("factor", "low", "high"))]
        for k, name in enumerate(data.record["plans"])
    ]
    title = "By what factor a device lowers the variance of the gradient at equal evaluations, with its 95 % interval."
    return [ends, Table("gradients", title, ["device", "factor", "from", "to"], factors)]
