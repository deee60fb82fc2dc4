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
HIGHEST = 3.0
_TARGETS = (0.01, 0.001)
_LABEL_SIZE = 6.5
_LINES = ("-", "--", "-.")


@dataclass(frozen=True)
class _Line:
    name: str
    style: dict[str, Any]
    seconds: np.ndarray
    error: np.ndarray
    low: np.ndarray
    high: np.ndarray


def race(result: dict[str, Any]) -> Figure:
    """Left the stream, right up to two of the contexts; above with everything counted, below when already prepared.

    Points are measured: relative root mean squares with 95 % bands, against CPU seconds (medians). Dotted curves
    understate their error (heavy tails); crosses are peers whose estimates are off the truth. Dotted levels mark 1 %
    and 0.1 %; what lies above 300 % is not drawn.
    """
    peers = [e for e in entrants(result["cells"]) if e.skipped is None]
    labels = _context_labels(peers)
    chosen = spread(len(labels), MOST_CONTEXTS)
    columns = 1 + len(chosen)
    rows = len(peers)
    figure = new_figure(5.2 * columns, 2 * max(3.4, 0.6 + 0.15 * rows))
    axes = figure.subplots(2, columns, squeeze=False)
    for row, counted in enumerate((True, False)):
        lines = list(_lines(peers, None, counted))
        _panel(axes[row][0], lines, _stream_title(peers), counted)
        for column, index in enumerate(chosen, start=1):
            _panel(axes[row][column], list(_lines(peers, index, counted)), labels[index], counted)
        axes[row][0].set_ylabel("relative RMSE")
    figure.suptitle(short(result["title"] or result["name"], 100), fontsize=10)
    return figure


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


def _lines(peers: list[Entrant], index: int | None, counted: bool) -> Iterator[_Line]:
    """The curves of one panel: the stream, or the context `index`."""
    for place, entrant in enumerate(peers):
        row = entrant.stream if index is None else entrant.contexts and entrant.contexts[index]
        if not row:
            continue
        style = {**look(place), "linestyle": ":" if entrant.heavy else _LINES[place // 8 % len(_LINES)]}
        if entrant.biased:
            style["marker"] = "x"
        made = curve(entrant, row, counted=counted)
        error = np.array([number(x) for x in made.error])
        keep = (error > 0) & (error <= HIGHEST)
        if not keep.any():
            continue
        ends = [np.array(curve(entrant, row, which=which).error, dtype=float)[keep] for which in ("low", "high")]
        seconds = np.array(made.seconds, dtype=float) + made.before
        yield _Line(entrant.name, style, seconds[keep], error[keep], *ends)


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
        axis.plot(line.seconds, line.error, linewidth=1.1, markersize=3.2, **line.style)
        axis.fill_between(line.seconds, line.low, line.high, color=colour, alpha=0.12, linewidth=0)
    for target in _TARGETS:
        axis.axhline(target, color="#555555", linestyle=":", linewidth=0.8)
    bottom = min(float(line.error.min()) for line in lines)
    top = max(float(line.error.max()) for line in lines)
    axis.set_ylim(min(bottom, _TARGETS[1]) / 1.6, top * 1.6)
    left, right = min(line.seconds.min() for line in lines), max(line.seconds.max() for line in lines)
    # the right third is for the names
    axis.set_xlim(left / 1.5, right * 1.5 * max(30.0, (right / left) ** 0.6))
    _names(axis, lines, right)


def _names(axis: Axes, lines: list[_Line], right: float) -> None:
    """Every name beside the end of its curve, moved up or down where names would overlap, with a thin line to it."""
    low, high = (math.log(y) for y in axis.get_ylim())
    room = (high - low) * 0.96 / max(len(lines), 1)
    step = min((high - low) * 0.047, room)
    ordered = sorted(lines, key=lambda line: line.error[-1])
    places = _spread_out([math.log(line.error[-1]) for line in ordered], step, low + step / 2, high - step / 2)
    for line, place in zip(ordered, places, strict=True):
        axis.annotate(
            short(line.name, 30),
            (line.seconds[-1], line.error[-1]),
            (right * 2.2, math.exp(place)),
            color=line.style["color"],
            fontsize=_LABEL_SIZE,
            va="center",
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
