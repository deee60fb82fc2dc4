"""Draws the race; tabulates peers, and who is ahead after how much time."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, NullFormatter

from dsfit.experiment.plots.style import COLORS
from dsfit.experiment.race_report import seconds
from dsfit.experiment.race_summary import Entrant, curve, entrants, rows, winners
from dsfit.figures import Data, Table
from dsfit.figures.page import Page
from experiments._race_points import unpack

_TARGETS = (0.01, 0.001)
_HIGHEST = 3.0
_MOST_NAMED = 7
_GREY = "#c4c4c4"
_MARKERS = "osD^v<>"
_MARKS = {"extrapolated": "~", "at most": "<", "measured": "", "never": "", "far": ""}


def _result(data: Data) -> dict[str, Any]:
    """The run as its reports read it."""
    contexts = [{**context, "v": None} for context in data.record["contexts"]]
    cells = unpack(dict(data.arrays), data.record["peers"], contexts)
    return {"cells": cells, "config": {"race": {"budgets": data.record["budgets"]}}}


def figures(data: Data, page: Page) -> dict[str, Figure]:
    """Left the stream, right the median over single contexts; above everything counted, below already prepared."""
    peers = [e for e in entrants(_result(data)["cells"]) if e.skipped is None]
    named = _named(peers)
    figure = page.figure(1.2)
    axes = figure.subplots(2, 2, squeeze=False)
    for line, counted in enumerate((True, False)):
        for axis, group in zip(axes[line], ("stream", "contexts"), strict=True):
            _panel(axis, peers, named, group, counted)
        axes[line][0].set_ylabel("relative error (RMSE)")
    size = next((e.stream["contexts"] for e in peers if e.stream), 0)
    many = len(data.record["contexts"])
    words = (f"stream of {size:,} contexts", f"one context (median of {many})")
    for line, counted in enumerate(("everything counted", "already prepared")):
        for axis, title in zip(axes[line], words, strict=True):
            axis.set_title(f"{title},\n{counted}")
    for axis in axes[1]:
        axis.set_xlabel("CPU time / s")
    handles = [
        Line2D([], [], color=COLORS[k], marker=_MARKERS[k], markersize=3.5, label=x) for k, x in enumerate(named)
    ]
    if len(named) < len(peers):
        handles.append(Line2D([], [], color=_GREY, label=f"{len(peers) - len(named)} others, see the table"))
    figure.legend(handles=handles, loc="outside lower center", ncols=2, frameon=False)
    return {"race": figure}


def captions(data: Data) -> dict[str, str]:
    """What the figure shows."""
    return {
        "race": "Relative root mean square error against CPU time of one thread, float32, the same compiled BSDF for "
        "all. Points are measured; bands on the stream: 95 % intervals. Dotted: errors understated, as rare large "
        "weights decide; crosses: biased. Dotted levels: 1 % and 0.1 %."
    }


def _named(peers: list[Entrant]) -> list[str]:
    """The first uniform and the first single peer, the best of the chapter's, and those soonest at 1 % on the stream,
    with and without their preparation."""

    def soonest(counted: bool, kinds: tuple[str, ...] = ()) -> list[str]:
        racing = [e for e in peers if e.stream and not e.heavy and (not kinds or e.kind in kinds)]
        times = {e.name: curve(e, e.stream or {}, counted=counted).time_to(_TARGETS[0]).value for e in racing}
        return sorted(times, key=lambda name: (times[name], name))

    first = [next((e.name for e in peers if e.kind == kind), None) for kind in ("uniform", "single")]
    mixes = soonest(False, ("chapter", "stream_mix", "best_mix"))[:1]
    best = [name for pair in zip(soonest(True), soonest(False), strict=True) for name in pair]
    wanted = list(dict.fromkeys(name for name in [*first, *mixes, *best] if name))[:_MOST_NAMED]
    return [e.name for e in peers if e.name in wanted]


def _panel(axis: Axes, peers: list[Entrant], named: list[str], group: str, counted: bool) -> None:
    axis.set(xscale="log", yscale="log")
    axis.grid(True)
    lowest, ends = 1.0, [math.inf, 0.0]
    for peer in sorted(peers, key=lambda e: e.name in named):
        time, error, bands = _points(peer, group, counted)
        keep = np.isfinite(error) & (error <= _HIGHEST) & (error > 0)
        if not keep.any():
            continue
        place = named.index(peer.name) if peer.name in named else -1
        color = COLORS[place] if place >= 0 else _GREY
        style = {"color": color, "linestyle": ":" if peer.heavy else "-", "linewidth": 1.2 if place >= 0 else 0.7}
        marker = "x" if peer.biased else _MARKERS[place] if place >= 0 else None
        axis.plot(time[keep], error[keep], marker=marker, markersize=3, zorder=3 if place >= 0 else 1, **style)
        if bands is not None and place >= 0:
            axis.fill_between(time[keep], bands[0][keep], bands[1][keep], color=color, alpha=0.15, linewidth=0)
        lowest = min(lowest, float(error[keep].min()))
        ends = [min(ends[0], float(time[keep].min())), max(ends[1], float(time[keep].max()))]
    for target in _TARGETS:
        axis.axhline(target, color="#555555", linestyle=":", linewidth=0.8)
    axis.set_ylim(min(lowest, _TARGETS[1]) / 1.5, _HIGHEST * 1.2)
    if ends[1] > 0:
        axis.set_xlim(ends[0] / 1.5, ends[1] * 1.5)
    axis.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"1e{round(math.log10(x))}" if x > 0 else ""))
    axis.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{100 * y:g} %"))
    for way in (axis.xaxis, axis.yaxis):
        way.set_minor_formatter(NullFormatter())


def _points(peer: Entrant, group: str, counted: bool) -> tuple[np.ndarray, np.ndarray, list[np.ndarray] | None]:
    """Seconds and errors as measured: of the stream with the ends of their intervals, or medians over the contexts at
    the rungs that all of them have."""
    own = ([peer.stream] if peer.stream else []) if group == "stream" else peer.contexts or []
    if not own:
        return np.array([]), np.array([]), None
    found = {w: [curve(peer, row, counted=counted, which=w) for row in own] for w in ("value", "low", "high")}
    rungs = min(made.measured for made in found["value"])
    time = np.median([np.array(m.seconds[:rungs], float) + m.before for m in found["value"]], axis=0)
    error, low, high = (np.median([np.array(m.error[:rungs], float) for m in made], axis=0) for made in found.values())
    return time, error, [low, high] if group == "stream" else None


def tables(data: Data) -> list[Table]:
    """One row per peer; and who is ahead."""
    return [_peers(data), _ahead(data)]


def _peers(data: Data) -> Table:
    head = ["peer", "prepare", "ns", "variance", "1 %, all", "0.1 %, all", "1 %", "0.1 %", "one context: 1 %", "0.1 %"]
    lines = []
    for row in rows(_result(data)):
        if row["skipped"]:
            lines.append([row["name"], *["not run"] * (len(head) - 1)])
            continue
        stream, single = row.get("stream"), row.get("contexts")
        notes = [n for n, there in (("biased", row["biased"]), ("heavy tails", row["heavy"])) if there]
        notes += [f"{row['subset']} contexts"] if row["subset"] else []
        cells = [seconds(row["prepare"])]
        cells.append(f"{stream['per_sample'] * 1e9:.0f}" if stream else "-")
        cells.append(f"{single['variance']:.2g}" if single else "-")
        cells += [_time(stream, key) for key in ("0.01", "0.001", "0.01 prepared", "0.001 prepared")]
        cells += [_time(single, key) for key in ("0.01 prepared", "0.001 prepared")]
        lines.append([row["name"] + (f" ({', '.join(notes)})" if notes else ""), *cells])
    caption = (
        "CPU time to 1 % and 0.1 % relative error of the whole stream, with all that is prepared counted and without, "
        "and of one context (median), prepared. ns: nanoseconds a sample of the stream; variance: relative, of a "
        "sample (median over contexts). ~: extrapolated from the longest estimate; <: at most; (N contexts): too slow "
        "for all, times scaled; heavy tails: errors are understated."
    )
    return Table("peers", caption, head, lines)


def _time(group: dict[str, Any] | None, key: str) -> str:
    if group is None:
        return "-"
    found = group["to"][key]
    return _MARKS[found["how"]] + seconds(found["seconds"])


def _ahead(data: Data) -> Table:
    found = winners(_result(data))
    budgets = data.record["budgets"]
    lines = []
    for group, where in (("stream", "stream"), ("contexts", "one context")):
        for counted, how in ((True, "all counted"), (False, "prepared")):
            own = [w for w in found if w["group"] == group and w["counted"] == counted]
            lines.append([f"{where}, {how}", *(_ranking(w["ranking"]) for w in own)])
    caption = (
        "Least relative error after so much time, and the runner-up; peers that are biased, or whose errors are "
        "understated, do not win. ~: extrapolated; -: nobody is done, or measured that far."
    )
    return Table("ahead", caption, ["", *(seconds(b) for b in budgets)], lines, "l" * (len(budgets) + 1))


def _ranking(ranking: list[dict[str, Any]]) -> str:
    if not ranking or ranking[0]["how"] == "far":
        return "-"
    return ", then ".join(
        f"{r['name']} {_MARKS[r['how']]}{100 * r['error']:.2g} %" for r in ranking if r["how"] != "far"
    )
