"""Error against time as a curve: when an error is reached, and what is reached in a time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

_FAR = 100.0


@dataclass(frozen=True)
class Reading:
    """A number read off a curve. `how`: "measured" (between measured points), "extrapolated" (beyond the last one, by
    t^-1/2), "far" (the same, for more than 100 times as long), "at most" (the first point is better already), or
    "never" (infinite or not there)."""

    value: float
    how: str


@dataclass(frozen=True)
class Curve:
    """Errors that estimates of growing length reach.

    Attributes:
        before: seconds spent before the first sample (preparation that is counted, work per context).
        seconds: of the estimates alone, increasing `[K]`.
        error: relative `[K]`; a later point that is worse counts as its best predecessor.
        measured: how many of the points are; those after them have a measured time, and an error that was extrapolated.
            Left out, all.
    """

    before: float
    seconds: Sequence[float]
    error: Sequence[float]
    measured: int | None = None

    def _how(self, time: np.ndarray, at: float) -> str:
        last = len(time) if self.measured is None else self.measured
        return "measured" if at <= time[last - 1] else "extrapolated"

    def _logs(self) -> tuple[np.ndarray, np.ndarray]:
        seconds = np.maximum.accumulate(np.maximum(np.asarray(self.seconds, dtype=float), 1e-12))
        error = np.minimum.accumulate(np.maximum(np.asarray(self.error, dtype=float), 1e-300))
        return np.log(seconds), np.log(error)

    def time_to(self, error: float) -> Reading:
        """Seconds until the error is reached; log-log between points."""
        if not len(self.seconds) or not np.all(np.isfinite(self.error)):
            return Reading(math.inf, "never")
        time, reached = self._logs()
        goal = math.log(error)
        if reached[0] <= goal:
            return Reading(self.before + math.exp(time[0]), "at most")
        if reached[-1] > goal:
            return Reading(self.before + math.exp(min(time[-1] + 2 * (reached[-1] - goal), 700.0)), "extrapolated")
        at = float(np.interp(-goal, -reached, time))
        return Reading(self.before + math.exp(at), self._how(time, at))

    def error_at(self, seconds: float) -> Reading:
        """The error reached within so many seconds; inf where not even the first point is done by then."""
        left = seconds - self.before
        if not len(self.seconds) or left < self.seconds[0]:
            return Reading(math.inf, "never")
        time, reached = self._logs()
        at = math.log(left)
        if at > time[-1]:
            how = "far" if at - time[-1] > math.log(_FAR) else "extrapolated"
            return Reading(math.exp(reached[-1] - (at - time[-1]) / 2), how)
        return Reading(math.exp(float(np.interp(at, time, reached))), self._how(time, at))
