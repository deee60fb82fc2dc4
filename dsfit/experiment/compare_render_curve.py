"""What a ladder of sample counts says: slope, time to an error, and ratios of such times."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dsfit.race.curve import Curve

_LAST = 5
_CLEAR = 1.5


@dataclass(frozen=True)
class Time:
    """Seconds to an error. `how`: "measured" (between rungs), "extrapolated" (beyond the last by 1/t: random points),
    "at most" (the first rung is better already), "more" (Sobol points that have not reached it; the seconds are those
    of the last rung), "never" (an error that is not finite)."""

    seconds: float
    how: str


def climb(
    measure: Callable[[int], dict[str, Any]], first: int, most: int, budget: float, floor: float = 0.0
) -> list[dict[str, Any]]:
    """Measure with `first`, twice, four times ... as many samples; at least one rung.

    It ends where the next rung would not fit into the budget of seconds or has more than `most` samples, and where the
    error is below `floor`, the reference's own: further rungs would measure the reference.

    Args:
        measure: takes samples, returns a row with `seconds` and `error`.
    """
    rungs: list[dict[str, Any]] = []
    samples, spent = first, 0.0
    while True:
        row = measure(samples)
        rungs.append(row)
        spent, samples = spent + row["seconds"], 2 * samples
        if samples > most or spent + 2 * row["seconds"] > budget or row["error"] < floor:
            return rungs


def slope(samples: Sequence[float], errors: Sequence[float], floor: float = 0.0) -> float:
    """Exponent a of error ~ samples^a (root mean squares; -1/2 for random points) over the last rungs, by least squares
    in logarithms: that of long run times, without what is spent per hit before the first sample. Rungs whose error is
    not well above `floor`, the reference's own, are left out. nan for fewer than three rungs."""
    good = [(t, e) for t, e in zip(samples, errors, strict=True) if math.isfinite(e) and e > max(_CLEAR * floor, 0.0)]
    good = good[-_LAST:]
    if len(good) < 3:
        return math.nan
    t, e = np.log(np.array(good)).T
    return float(np.polyfit(t, e, 1)[0])


def time_to(
    error: float, seconds: Sequence[float], errors: Sequence[float], uniforms: str, before: float = 0.0
) -> Time:
    """When the root mean square error is reached; see `Time`.

    Args:
        seconds, errors: of the rungs.
        uniforms: "random" or "sobol".
        before: seconds of preparation that count.
    """
    found = Curve(before, seconds, errors).time_to(error)
    if found.how == "extrapolated" and uniforms != "random":
        return Time(before + max(seconds), "more")
    return Time(found.value, found.how)


def ratio(slow: Time, fast: Time) -> Time:
    """How many times as long `slow` takes, with the weaker of the two `how`s: "more" where it is at least that,
    "at most", "extrapolated"; "unknown" where the bounds point in different directions."""
    hows = {slow.how, fast.how}
    if "never" in hows or not fast.seconds > 0 or not math.isfinite(fast.seconds):
        return Time(math.nan, "unknown")
    value = slow.seconds / fast.seconds
    up = slow.how == "more" or fast.how == "at most"
    down = slow.how == "at most" or fast.how == "more"
    if up and down:
        return Time(math.nan, "unknown")
    if up or down:
        return Time(value, "more" if up else "at most")
    return Time(value, "extrapolated" if "extrapolated" in hows else "measured")
