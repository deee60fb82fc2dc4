"""Error against run time for every peer of a race: the stream, and some of the contexts."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from dsfit.experiment.files import number
from dsfit.experiment.plots.style import look, new_figure, short, spread
from dsfit.experiment.race_summary import Entrant, curve, entrants

MOST_CONTEXTS = 2
MOST_NAMES = 12
HIGHEST = 3.0
_TARGETS = (0.01, 0.001)
_LABEL_SIZE = 6.5
_GREY = "#bbbbbb"
_LINES = ("-", "--", "-.")


@dataclass(frozen=True)
class _Line:
    """A curve; without a name it is one of many."""

    name: str | None
    style: dict[str, Any]
    seconds: np.ndarray
    error: np.ndarray
    low: np.ndarray
    high: np.ndarray


def race(result: dict[str, Any]) -> Figure:
    """Left the stream, right up to two of the contexts; above with everything counted, below when already prepared.

    Points are measured: relative root mean squares with 95 % bands, against CPU seconds (medians). Dotted curves
    understate their error (heavy tails); crosses are peers whose estimates are off the truth. Dotted levels mark 1 %
    and 0.1 %; what lies above 300 % is not drawn. Of more than twelve peers, those that are not among the fastest are
    grey.
    """
    peers = [e for e in entrants(result["cells"]) if e.skipped is None]
    named = _named(peers)
    labels = _context_labels(peers)
    chosen = spread(len(labels), MOST_CONTEXTS)
    columns = 1 + len(chosen)
    figure = new_figure(5.2 * columns, 7.0)
    axes = figure.subplots(2, columns, squeeze=False)
    for row, counted in enumerate((True, False)):
        lines = list(_lines(peers, named, None, counted))
        _panel(axes[row][0], lines, _stream_title(peers), counted)
        for column, index in enumerate(chosen, start=1):
            _panel(axes[row][column], list(_lines(peers, named, index, counted)), labels[index], counted)
        axes[row][0].set_ylabel("relative RMSE")
    grey = f" (grey: {len(peers) - len(named)} others, see the table)" if len(named) < len(peers) else ""
    figure.suptitle(short(result["title"] or result["name"], 100) + grey, fontsize=10)
    return figure


def _named(peers: list[Entrant]) -> list[str]:
    """Names of the peers to tell apart: all, or the first uniform one, the first single proposal, the best of the
    chapter's mixes, and those that are soonest at 1 %, with and without their preparation."""
    if len(peers) <= MOST_NAMES:
        return [e.name for e in peers]

    def soonest(counted: bool, among: list[Entrant]) -> list[str]:
        racing = [e for e in among if e.stream]
        order = sorted(racing, key=lambda e: curve(e, e.stream or {}, counted=counted).time_to(_TARGETS[0]).value)
        return [e.name for e in order]

    first = [next((e.name for e in peers if e.kind == kind), None) for kind in ("uniform", "single")]
    mixes = soonest(True, [e for e in peers if e.kind == "chapter"])[:1]
    best = [x for pair in zip(soonest(True, peers), soonest(False, peers), strict=True) for x in pair]
    wanted = list(dict.fromkeys(x for x in [*first, *mixes, *best] if x))[:MOST_NAMES]
    return [e.name for e in peers if e.name in wanted]


def _stream_title(peers: list[Entrant]) -> str:
    count = next((e.stream["contexts"] for e in peers if e.stream), 0)
    return f"stream of {count:,} contexts"


def _context_labels(peers: list[Entrant]) -> list[str]:
    rows = next((e.contexts for e in peers if e.contexts), [])
    found = []
    for row in rows:
        values = row["context"]
        lit = "" if values["v"] is None else f", v {values['v']:g}"
        found.append(f"one context: θr {values['theta_r_deg']:g}°, n {values['n']:g}{lit}")
    return found


def _lines(peers: list[Entrant], named: list[str], index: int | None, counted: bool) -> Iterator[_Line]:
    """The curves of one panel: the stream, or the context `index`; those in grey first."""
    for entrant in sorted(peers, key=lambda e: e.name in named):
        place = named.index(entrant.name) if entrant.name in named else -1
        row = entrant.stream if index is None else entrant.contexts and entrant.contexts[index]
        if not row:
            continue
        style = {**look(place), "linestyle": ":" if entrant.heavy else _LINES[place // 8 % len(_LINES)]}
        if place < 0:
            style = {"color": _GREY, "linestyle": style["linestyle"], "marker": ".", "zorder": 1}
        if entrant.biased:
            style["marker"] = "x"
        made = curve(entrant, row, counted=counted)
        measured = slice(made.measured)
        error = np.array([number(x) for x in made.error[measured]])
        keep = (error > 0) & (error <= HIGHEST)
        if not keep.any():
            continue
        ends = [
            np.array(curve(entrant, row, which=which).error[measured], dtype=float)[keep] for which in ("low", "high")
        ]
        seconds = np.array(made.seconds[measured], dtype=float) + made.before
        yield _Line(entrant.name if place >= 0 else None, style, seconds[keep], error[keep], *ends)


def _panel(axis: Axes, lines: list[_Line], title: str, counted: bool) -> None:
    axis.set(xscale="log", yscale="log")
    axis.set_title(f"{title}; {'everything counted' if counted else 'already prepared'}")
    axis.set_xlabel("run time / s")
    axis.grid(True, which="major")
    axis.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{100 * y:g} %"))
    if not lines:
        axis.text(0.5, 0.5, "nothing below 300 %", transform=axis.transAxes, ha="center")
        return
    for line in lines:
        colour = line.style["color"]
        width = 1.2 if line.name else 0.7
        axis.plot(line.seconds, line.error, linewidth=width, markersize=3.4 if line.name else 2.0, **line.style)
        if line.name:
            axis.fill_between(line.seconds, line.low, line.high, color=colour, alpha=0.12, linewidth=0)
    for target in _TARGETS:
        axis.axhline(target, color="#555555", linestyle=":", linewidth=0.8)
    bottom = min(float(line.error.min()) for line in lines)
    top = max(float(line.error.max()) for line in lines)
    axis.set_ylim(min(bottom, _TARGETS[1]) / 1.6, top * 1.6)
    left, right = min(line.seconds.min() for line in lines), max(line.seconds.max() for line in lines)
    # the right third is for the names
    axis.set_xlim(left / 1.5, right * 1.5 * max(30.0, (right / left) ** 0.6))
    _names(axis, [line for line in lines if line.name], right)


def _names(axis: Axes, lines: list[_Line], right: float) -> None:
    """Every name beside the end of its curve, moved up or down where names would overlap, with a thin line to it."""
    if not lines:
        return
    low, high = (math.log(y) for y in axis.get_ylim())
    room = (high - low) * 0.96 / max(len(lines), 1)
    step = min((high - low) * 0.047, room)
    ordered = sorted(lines, key=lambda line: line.error[-1])
    places = _spread_out([math.log(line.error[-1]) for line in ordered], step, low + step / 2, high - step / 2)
    for line, place in zip(ordered, places, strict=True):
        axis.annotate(
            short(line.name or "", 34),
            (line.seconds[-1], line.error[-1]),
            (right * 2.2, math.exp(place)),
            color=line.style["color"],
            fontsize=_LABEL_SIZE,
            va="center",
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.85, "pad": 0.6},
            arrowprops={"arrowstyle": "-", "color": line.style["color"], "linewidth": 0.4, "alpha": 0.6},
        )


def _spread_out(wanted: list[float], step: float, low: float, high: float) -> list[float]:
    """Increasing places at least `step` apart, near the wanted ones, within the limits as far as they fit."""
    places: list[float] = []
    for value in wanted:
        places.append(max(value, low, places[-1] + step if places else low))
    over = places[-1] - high
    for k in range(len(places) - 1, -1, -1):
        limit = high if k == len(places) - 1 else places[k + 1] - step
        places[k] = min(places[k], limit) if over > 0 else places[k]
    return places
