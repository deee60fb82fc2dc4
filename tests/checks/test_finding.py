"""Verdicts: Šidák's level per suite, bounds, NaN, and what is unclear."""

from __future__ import annotations

import math

import pytest

from dsfit.checks.finding import Finding, judge, sidak


def test_sidak_keeps_the_family_at_its_level() -> None:
    for count in (1, 7, 10_000):
        assert 1 - (1 - sidak(0.01, count)) ** count == pytest.approx(0.01, rel=1e-9)


def _verdict(finding: Finding, others: int = 0) -> str:
    family = [Finding("a", str(k), "", p_value=0.5) for k in range(others)]
    return judge([*family, finding], 0.01)[-1][1]


def test_a_p_value_is_held_to_its_suites_family() -> None:
    rare = Finding("a", "x", "", p_value=1e-3)
    assert _verdict(rare) == "fail" and _verdict(rare, others=99) == "pass"
    assert _verdict(Finding("b", "x", "", p_value=1e-3), others=99) == "fail"  # another suite, another family
    assert _verdict(Finding("a", "x", "", p_value=1e-6), others=99) == "fail"


@pytest.mark.parametrize(
    ("value", "bound", "verdict"),
    [(1.0, 1.0, "pass"), (1.1, 1.0, "fail"), (math.nan, 1.0, "fail"), (1.0, math.nan, "fail"), (0.0, 0.0, "pass")],
)
def test_bounds(value: float, bound: float, verdict: str) -> None:
    assert _verdict(Finding("a", "x", "", value=value, bound=bound)) == verdict


def test_nan_p_values_fail_and_unclear_ones_say_so() -> None:
    assert _verdict(Finding("a", "x", "", p_value=math.nan)) == "fail"
    assert _verdict(Finding("a", "x", "", p_value=0.0, unclear="chain too short")) == "unclear"
