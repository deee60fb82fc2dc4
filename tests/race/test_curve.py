"""Readings off curves of error against time."""

from __future__ import annotations

import math

import pytest

from dsfit.race.curve import Curve, Reading

SECONDS = [0.01, 0.04, 0.16, 0.64]
LAW = Curve(0.0, SECONDS, [0.02 / math.sqrt(t) for t in SECONDS])


@pytest.mark.parametrize("error, how", [(0.1, "measured"), (0.04, "measured"), (0.002, "extrapolated")])
def test_a_power_law_is_read_exactly_inside_and_beyond(error: float, how: str) -> None:
    assert LAW.time_to(error).value == pytest.approx((0.02 / error) ** 2) and LAW.time_to(error).how == how
    back = LAW.error_at((0.02 / error) ** 2)
    far = (0.02 / error) ** 2 > 100 * SECONDS[-1]
    assert back.value == pytest.approx(error) and back.how == ("far" if far else how)


def test_before_the_first_point_there_is_no_error_and_an_upper_bound_of_the_time() -> None:
    assert LAW.time_to(0.5) == Reading(pytest.approx(0.01), "at most")
    assert LAW.error_at(0.005).how == "never" and math.isinf(LAW.error_at(0.005).value)


def test_what_is_spent_before_is_added_and_does_not_grow_with_extrapolation() -> None:
    late = Curve(5.0, SECONDS, LAW.error)
    for error in (0.5, 0.1, 0.002):
        assert late.time_to(error).value == pytest.approx(5 + LAW.time_to(error).value)
    assert late.error_at(4.0).how == "never"
    assert late.error_at(5.04).value == pytest.approx(LAW.error_at(0.04).value)


def test_a_point_that_is_worse_than_its_predecessor_counts_as_that() -> None:
    bumpy = Curve(0.0, [1.0, 2.0, 4.0], [0.1, 0.2, 0.05])
    assert bumpy.error_at(2.0).value == pytest.approx(0.1)
    assert bumpy.time_to(0.1).value == pytest.approx(1.0)


def test_points_of_which_only_the_time_was_measured_say_so() -> None:
    # the third and fourth call cost no more than the second: 16 times the samples at 1.1 times its time
    priced = Curve(0.0, [1.0, 1.1, 1.15, 1.2], [0.4, 0.2, 0.1, 0.05], 2)
    assert priced.time_to(0.2).how == "measured" and priced.error_at(1.05).how == "measured"
    assert priced.time_to(0.05) == Reading(pytest.approx(1.2), "extrapolated")
    assert priced.error_at(1.15).how == "extrapolated" and priced.error_at(1.15).value == pytest.approx(0.1)


def test_infinite_errors_and_no_points() -> None:
    assert Curve(0.0, [1.0], [math.inf]).time_to(0.01).how == "never"
    assert Curve(0.0, [], []).time_to(0.01).how == "never" and Curve(0.0, [], []).error_at(1.0).how == "never"
