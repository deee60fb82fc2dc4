"""Ladders of sample counts: where they end, slopes, times to an error, ratios."""

from __future__ import annotations

import math
from typing import Any

import pytest

from dsfit.experiment.compare_render_curve import Time, climb, ratio, slope, time_to


def _measure(seconds: float, error: float) -> Any:
    seen: list[int] = []

    def measure(samples: int) -> dict[str, Any]:
        seen.append(samples)
        return {"samples": samples, "seconds": seconds * samples, "error": error / math.sqrt(samples)}

    measure.seen = seen  # type: ignore[attr-defined]
    return measure


def test_a_ladder_doubles_until_its_seconds_are_used_up() -> None:
    measure = _measure(1.0, 1.0)
    rungs = climb(measure, 3, 10**6, 30.0)
    assert measure.seen == [3, 6, 12]  # 21 seconds; 24 more would be too many
    assert [r["samples"] for r in rungs] == [3, 6, 12]
    assert len(climb(_measure(100.0, 1.0), 1, 10**6, 1.0)) == 1


def test_a_ladder_ends_at_the_most_samples_and_at_the_references_error() -> None:
    assert climb(_measure(1e-9, 1.0), 1, 100, 1e9)[-1]["samples"] == 64
    assert climb(_measure(1e-9, 1.0), 1, 10**9, 1e9, floor=0.3)[-1]["samples"] == 16


def test_slopes_of_power_laws_and_what_they_leave_out() -> None:
    seconds = [2.0**k for k in range(8)]
    assert slope(seconds, [t**-0.75 for t in seconds]) == pytest.approx(-0.75)
    # the first rungs are not on the law; rungs at the reference's own error do not count
    errors = [9.0, 9.0, 9.0, *(t**-0.5 for t in seconds[3:])]
    assert slope(seconds, errors) == pytest.approx(-0.5)
    flat = [max(t**-0.5, 0.15) for t in seconds]
    assert slope(seconds, flat, floor=0.12) == pytest.approx(-0.5)
    assert math.isnan(slope(seconds[:2], [1.0, 0.5]))


def test_times_between_rungs_beyond_the_last_and_before_the_first() -> None:
    seconds, errors = [1.0, 4.0], [0.2, 0.1]
    assert time_to(0.1 * 2**0.5, seconds, errors, "random") == Time(pytest.approx(2.0), "measured")
    assert time_to(0.05, seconds, errors, "random") == Time(pytest.approx(16.0), "extrapolated")
    assert time_to(0.05, seconds, errors, "sobol") == Time(4.0, "more")
    assert time_to(0.5, seconds, errors, "sobol") == Time(pytest.approx(1.0), "at most")
    assert time_to(0.05, seconds, errors, "random", before=3.0).seconds == pytest.approx(19.0)
    assert time_to(0.05, seconds, [math.inf, math.nan], "random").how == "never"


def test_ratios_keep_the_weaker_statement() -> None:
    measured, beyond = Time(2.0, "measured"), Time(8.0, "extrapolated")
    assert ratio(measured, measured) == Time(1.0, "measured")
    assert ratio(beyond, measured) == Time(4.0, "extrapolated")
    assert ratio(Time(6.0, "more"), measured) == Time(3.0, "more")
    assert ratio(measured, Time(1.0, "at most")) == Time(2.0, "more")
    assert ratio(measured, Time(4.0, "more")) == Time(0.5, "at most")
    assert ratio(Time(1.0, "at most"), measured) == Time(0.5, "at most")
    assert ratio(Time(1.0, "more"), Time(1.0, "more")).how == "unknown"
    assert ratio(Time(math.inf, "never"), measured).how == "unknown"
