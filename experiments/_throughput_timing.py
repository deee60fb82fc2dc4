"""Timing of contenders in turn, in one process: what the machine does meanwhile hits all of them alike."""

from __future__ import annotations

import math
import os
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

SLICE = 2e-3
"""Seconds that one measurement lasts at least; shorter calls are repeated within it."""


@dataclass(frozen=True)
class Contender:
    """One call that is timed: `run()` handles `count` directions (or contexts) and returns when they are there.

    Attributes:
        library: who computes, such as "Mitsuba" or "kernel, compiled".
        task: what, such as "eval"; contenders of one task are compared.
        layout: how directions share contexts, such as "all different".
        count: directions per call.
        run: the call.
    """

    library: str
    task: str
    layout: str
    count: int
    run: Callable[[], object]


@dataclass
class _Series:
    contender: Contender
    first: float
    repeats: int
    wall: list[float]
    processor: list[float]


def measure(contenders: Sequence[Contender], seconds: float, least: int = 5) -> list[dict[str, Any]]:
    """Time all contenders in turn for `seconds` in all, or `least` rounds; a row of plain data for each.

    A row holds the seconds of the first call (which compiles or traces), and per call the median, the 10 and 90 %
    quantiles and the least of the wall times ("wall") and of the times on processors, summed over threads
    ("processor"): what others run meanwhile lengthens the first, and hardly the second. The order rotates from round to
    round.
    """
    series = [_prepared(contender) for contender in contenders]
    start, done = time.perf_counter(), 0
    while done < least or time.perf_counter() - start < seconds:
        shift = done % len(series)
        for each in series[shift:] + series[:shift]:
            _one(each)
        done += 1
    return [_row(each) for each in series]


def _prepared(contender: Contender) -> _Series:
    start = time.perf_counter()
    contender.run()
    first = time.perf_counter() - start
    contender.run()
    start = time.perf_counter()
    contender.run()
    one = time.perf_counter() - start
    return _Series(contender, first, max(1, math.ceil(SLICE / max(one, 1e-9))), [], [])


def _one(series: _Series) -> None:
    run, processor, wall = series.contender.run, time.process_time(), time.perf_counter()
    for _ in range(series.repeats):
        run()
    series.wall.append((time.perf_counter() - wall) / series.repeats)
    series.processor.append((time.process_time() - processor) / series.repeats)


def _row(series: _Series) -> dict[str, Any]:
    contender = series.contender
    return {
        "library": contender.library,
        "task": contender.task,
        "layout": contender.layout,
        "count": contender.count,
        "first_seconds": series.first,
        "rounds": len(series.wall),
        "wall": _summary(series.wall),
        "processor": _summary(series.processor),
    }


def _summary(seconds: Sequence[float]) -> dict[str, float]:
    ordered = sorted(seconds)
    return {
        "median": statistics.median(ordered),
        "low": quantile(ordered, 0.1),
        "high": quantile(ordered, 0.9),
        "least": ordered[0],
    }


def quantile(ordered: Sequence[float], share: float) -> float:
    """Quantile of sorted numbers, linear between them."""
    position = share * (len(ordered) - 1)
    low = math.floor(position)
    high = min(low + 1, len(ordered) - 1)
    return ordered[low] + (position - low) * (ordered[high] - ordered[low])


def load() -> float:
    """Load average of the last minute: processes that run or want to, over all cores."""
    return os.getloadavg()[0]
