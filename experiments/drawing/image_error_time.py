"""Draws error against run time in images and pictures of equal time; tabulates times to equal error."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, NullFormatter

from dsfit.experiment.compare_render_curve import Time
from dsfit.experiment.plots.style import COLORS
from dsfit.experiment.race_report import seconds
from dsfit.figures import Data, Table
from dsfit.figures.page import Page
from experiments._image_times import TIMES, unpack_time

_WAYS = (
    ("uniform", "uniform", COLORS[0], "o"),
    ("M_R only", "M_R only", COLORS[1], "s"),
    ("best heuristic mix", "best heuristic mix", COLORS[5], "P"),
    ("best heuristic mix + light", "best heuristic mix + light", COLORS[3], "D"),
    ("light alone", "light alone", COLORS[4], "v"),
    ("amortised, guided", "amortised, guided", COLORS[6], "^"),
)
"""Techniques to tell apart (without ", Sobol"), their names, colours and marks; the others are grey."""
_GREY = "#cccccc"
_SOBOL = ", Sobol"
_MARKS = {"measured": "", "extrapolated": "~", "at most": "<", "more": ">"}


def figures(data: Data, page: Page) -> dict[str, Figure]:
    """Curves of every scene; and, scene by scene, pictures of equal time with maps of their errors."""
    scenes = data.record["scenes"]
    drawn = {"curves": _curves(data, page)}
    return drawn | {f"crops_{scene['name']}": _crops(data, page, scene) for scene in scenes if scene["pictures"]}


def captions(data: Data) -> dict[str, str]:
    """What the figures show."""
    found = {
        "curves": "Relative error of images (root of the relative mean square over covered pixels) against CPU time of "
        "one thread, proposals already trained. Solid: Sobol points, dashed: random ones; dotted: a few pixels decide, "
        "so that the error is understated. Bars: standard errors over pixels. The grey level is the reference's own "
        "error, which has been taken out of the others; dotted levels: the errors that times are compared at.",
    }
    for scene in data.record["scenes"]:
        found[f"crops_{scene['name']}"] = (
            f"{scene['title']}: part of the picture after {seconds(data.record['equal_seconds'])} of CPU time "
            "(proposals already trained), and its relative error; last the reference."
        )
    return found


def _curves(data: Data, page: Page) -> Figure:
    scenes = data.record["scenes"]
    lines = math.ceil(len(scenes) / 2)
    figure = page.figure(0.16 + 0.42 * lines)
    axes = figure.subplots(lines, 2, squeeze=False)
    for axis, scene in zip(axes.flat, scenes, strict=False):
        _panel(axis, data, scene)
    for axis in list(axes.flat)[len(scenes) :]:
        axis.set_visible(False)
    for row in axes:
        row[0].set_ylabel("relative error")
    for axis in axes[-1]:
        axis.set_xlabel("CPU time / s")
    handles = [Line2D([], [], color=color, marker=mark, markersize=3.5, label=name) for _, name, color, mark in _WAYS]
    handles += [
        Line2D([], [], color=_GREY, label="others"),
        Line2D([], [], color="#555555", label="Sobol points"),
        Line2D([], [], color="#555555", linestyle=(0, (4, 2)), label="random points"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False)
    return figure


def _panel(axis: Axes, data: Data, scene: dict[str, Any]) -> None:
    name = scene["name"]
    axis.set(xscale="log", yscale="log")
    axis.set_title(scene["title"], fontsize=8)
    curves, heavy = data.arrays[f"{name}.curves"], data.arrays[f"{name}.heavy"]
    ways = {key: (color, mark) for key, _, color, mark in _WAYS}
    for k, technique in enumerate(scene["techniques"]):
        _, time, error, spread = (curves[k, :, j].astype(float) for j in range(4))
        good = np.isfinite(error) & (error > 0)
        color, mark = ways.get(technique["name"].removesuffix(_SOBOL), (_GREY, None))
        line = ":" if heavy[k] else "-" if technique["sobol"] else (0, (4, 2))
        style = {"color": color, "marker": mark, "markersize": 3, "linestyle": line, "zorder": 3 if mark else 1}
        style |= {"linewidth": 1.1 if mark else 0.6, "markerfacecolor": color if technique["sobol"] else "white"}
        bars = np.minimum(spread[good], 0.9 * error[good]) if mark else None
        axis.errorbar(time[good], error[good], yerr=bars, elinewidth=0.6, markeredgewidth=0.8, **style)
    own = float(data.arrays[f"{name}.own_error"])
    axis.axhline(own, color="#999999", linewidth=1)
    for target in scene["targets"]:
        axis.axhline(target, color="#555555", linestyle=":", linewidth=0.8)
    low, high = axis.get_ylim()
    axis.set_ylim(min(low, own / 1.5), min(high, 10.0))
    axis.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    axis.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{100 * y:g} %"))
    for way in (axis.xaxis, axis.yaxis):
        way.set_minor_formatter(NullFormatter())
    axis.tick_params(labelsize=7)
    axis.grid(True)


def _crops(data: Data, page: Page, scene: dict[str, Any]) -> Figure:
    """A column for every technique, picture above error, and the reference."""
    name, count = scene["name"], len(scene["pictures"])
    figure = page.figure(0.45)
    axes = figure.subplots(2, count + 1, squeeze=False)
    for axis in axes.flat:
        axis.set(xticks=[], yticks=[])
        axis.spines[:].set_visible(False)
    image = None
    for k, technique in enumerate(scene["pictures"]):
        above, below = axes[0][k], axes[1][k]
        _show(above, data.arrays[f"{name}.picture.{k}"])
        above.set_title(_two_lines(technique), fontsize=6.5, pad=3)
        error = 1e-3 * 10 ** (data.arrays[f"{name}.map.{k}"] / 255 * 4.0)
        image = below.imshow(error, norm=LogNorm(0.01, 1.0), cmap="magma", interpolation="nearest")
        facts = scene["at_equal_time"][k]
        below.set_xlabel(f"{_percent(float(facts['error']))}\n{facts['samples']} per hit", fontsize=6.5, labelpad=2)
    last = axes[0][count]
    _show(last, data.arrays[f"{name}.reference"])
    last.set_title("reference", fontsize=6.5, pad=3)
    last.set_xlabel(_percent(float(data.arrays[f"{name}.own_error"])), fontsize=6.5, labelpad=2)
    axes[1][count].set_facecolor("none")
    bar = figure.colorbar(image, cax=axes[1][count].inset_axes((0.6, 0.05, 0.16, 0.9)), extend="both")
    bar.ax.yaxis.set_ticks_position("left")
    bar.ax.yaxis.set_label_position("left")
    bar.ax.tick_params(labelsize=6.5)
    bar.set_ticks([0.01, 0.1, 1.0], labels=["1 %", "10 %", "100 %"])
    bar.ax.minorticks_off()
    bar.set_label("relative error", fontsize=6.5, labelpad=1)
    return figure


def _two_lines(name: str) -> str:
    """A name above a picture that is narrower."""
    return name.replace(" + ", "\n+ ") if " + " in name else name.replace(_SOBOL, ",\nSobol")


def _percent(value: float) -> str:
    return f"{100 * value:.0f} %" if value >= 0.1 else f"{100 * value:.2g} %"


def _show(axis: Axes, picture: np.ndarray) -> None:
    shown = np.repeat(picture, 3, axis=-1) if picture.shape[-1] == 1 else picture
    axis.imshow(shown, interpolation="nearest")


def tables(data: Data) -> list[Table]:
    """Times to the first target, all scenes; ratios to equal error; and the references."""
    return [_times(data), _ratios(data), _references(data)]


def _names(data: Data) -> list[str]:
    """Techniques of all scenes in their order."""
    return list(dict.fromkeys(t["name"] for scene in data.record["scenes"] for t in scene["techniques"]))


def _found(data: Data, scene: dict[str, Any], technique: str, target: int, key: str) -> Time | None:
    """One entry of `SCENE.times`; None where the technique did not run, or its error is understated."""
    places = [t["name"] for t in scene["techniques"]]
    if technique not in places:
        return None
    pair = data.arrays[f"{scene['name']}.times"][places.index(technique), target, TIMES.index(key)]
    return unpack_time(pair)


def _title(scene: dict[str, Any], target: int) -> str:
    return f"{scene['name'].replace('_', ' ')}, {100 * scene['targets'][target]:g} %"


def _times(data: Data) -> Table:
    scenes = data.record["scenes"]
    rows = [
        [name, *(_time(_found(data, scene, name, 0, "prepared")) for scene in scenes)] for name in _names(data)
    ]  # fmt: skip
    caption = (
        "CPU time of one thread to a relative error, proposals already prepared. ~: extrapolated by 1/t (random points "
        "only); >: not reached in that time."
    )
    return Table("times", caption, ["technique", *(_title(scene, 0) for scene in scenes)], rows)


def _time(found: Time | None) -> str:
    return "-" if found is None or found.how not in _MARKS else _MARKS[found.how] + seconds(found.seconds)


def _ratios(data: Data) -> Table:
    """The best amortised technique with Sobol points and with random ones against its peers, at every target."""
    head = ["scene, error", "technique", "time", "all counted", "heuristic alike", "heuristic", "uniform"]
    rows = []
    for scene in data.record["scenes"]:
        for target in range(len(scene["targets"])):
            for name in _best(data, scene, target):
                own = [_found(data, scene, name, target, key) for key in TIMES]
                cells = [*(_time(found) for found in own[:2]), *(_ratio(found) for found in own[2:])]
                rows.append([_title(scene, target), name, *cells])
    caption = (
        "The amortised technique that is soonest at equal error, with random points and with Sobol's. Time: prepared; "
        "all counted: with training. Ratios: how many times as long others take, prepared: the best of the chapter's "
        "heuristics with the same points and light sampling or none alike; the best of them with random points and "
        "without light sampling; uniform random directions. ~: extrapolated; <, >: bounds."
    )
    return Table("ratios", caption, head, rows, "llrrrrr")


def _best(data: Data, scene: dict[str, Any], target: int) -> list[str]:
    found = []
    for sobol in (False, True):
        own = [t["name"] for t in scene["techniques"] if t["kind"] in ("amortised", "guided") and t["sobol"] == sobol]
        times = {name: _found(data, scene, name, target, "prepared") for name in own}
        reached = {
            name: time.seconds for name, time in times.items() if time and time.how in _MARKS and time.how != "more"
        }
        if reached:
            found.append(min(reached, key=lambda name: (reached[name], name)))
    return found


def _ratio(found: Time | None) -> str:
    if found is None or found.how not in _MARKS or not found.seconds > 0:
        return "-"
    text = f"{found.seconds:.2g}" if found.seconds < 100 else f"{float(f'{found.seconds:.2g}'):.0f}"
    return f"{_MARKS[found.how]}{text}"


def _references(data: Data) -> Table:
    head = ["scene", "pixels", "hits", "own error / %", "second technique"]
    rows = [
        [
            scene["title"],
            f"{scene['pixels'][0]} × {scene['pixels'][1]}",
            f"{scene['hits']:,}",
            f"{100 * float(data.arrays[scene['name'] + '.own_error']):.2f}",
            "agrees" if scene["check"] == "agree" else "differs",
        ]
        for scene in data.record["scenes"]
    ]
    caption = (
        "References: their own error, which is taken out of all others, and whether an independent technique agrees."
    )
    return Table("references", caption, head, rows, "lrrrl")
