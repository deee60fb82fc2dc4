"""The suite `stability`: what the library's functions lose in stiff and extreme cases, against 50-digit arithmetic.

A part is a function of the atlas. Each of its regimes is measured in float64 and float32, value and gradient; a
finding's value is the worst relative error, its bound the limit that the entry states. See `Function` for how errors
are measured and `measure` for a single regime.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

from dsfit.checks.finding import Finding
from dsfit.checks.stability import atlas
from dsfit.checks.stability.function import CLASSES, Function, class_of
from dsfit.checks.stability.measure import DTYPES, Errors, Measurement, measure
from dsfit.checks.subject import Outcome, Say, silent
from dsfit.checks.suites import chosen
from dsfit.errors import check_choice

SUITE = "stability"

__all__ = ["CLASSES", "Errors", "Function", "Measurement", "atlas", "findings", "measure", "parts", "run"]


def parts(*, functions: str | Sequence[str] = "all", digits: int = 50) -> list[str]:
    """Names of the functions that are measured: all, or those asked for.

    Raises:
        InputError: no such function.
    """
    return chosen("functions", functions, atlas.functions())


def run(
    part: str,
    *,
    seed: int = 0,
    say: Say = silent,
    functions: str | Sequence[str] = "all",
    digits: int = 50,
) -> Outcome:
    """Measures one function in all its regimes.

    Args:
        part: its name.
        seed: unused; the points are fixed.
        say: told the regime.
        functions: unused here; see `parts`.
        digits: of the reference arithmetic.

    Raises:
        InputError: no such function.
    """
    known = atlas.functions()
    function = known[check_choice("function", part, tuple(known))]
    outcome = Outcome()
    for regime in function.regimes:
        say(f"{part}: {regime}")
        for dtype in DTYPES:
            outcome.findings += findings(function, measure(function, regime, dtype, digits))
    return outcome


def findings(function: Function, found: Measurement) -> list[Finding]:
    """What a measurement says of values and of gradients; nothing where the dtype has no point in the domain."""
    case = f"{found.regime}, {found.dtype}"
    common = {"regime": found.regime, "class": class_of(found.regime), "dtype": found.dtype, "points": found.points}
    if not found.points:  # as 1e-300 in float32
        return []
    value_limit, gradient_limit = function.limit(found.regime, found.dtype)
    rows = [("value", value_limit, found.value, None, found.naive)]
    if found.gradient is not None:
        rows.append(("gradient", gradient_limit, found.gradient, found.forward, found.naive_gradient))
    made = []
    for quantity, limit, errors, forward, naive in rows:
        worst = max((e for e in (errors, forward) if e is not None), key=lambda e: e.worst)
        data = common | {"quantity": quantity, **_plain(worst)}
        if quantity == "gradient":
            data["forward_mode"] = forward is not None
        if naive is not None:
            data["naive"] = {key: value for key, value in _plain(naive).items() if key not in ("point", "got", "exact")}
        made.append(
            Finding(
                SUITE,
                function.name,
                f"{case}, {quantity}",
                value=worst.worst,
                bound=limit,
                detail=_sentence(function, worst),
                data=data,
            )
        )
    return made


def _plain(errors: Errors) -> dict[str, Any]:
    data = dataclasses.asdict(errors)
    data["point"] = list(errors.point) if errors.point is not None else None
    return data


def _sentence(function: Function, worst: Errors) -> str:
    """The worst error in words."""
    if worst.worst == 0 or worst.point is None:
        return "exact"
    where = ", ".join(f"{name} = {x:.9g}" for name, x in zip(function.arguments, worst.point, strict=True))
    what = f"d/d{worst.argument} " if worst.argument else ""
    counts = {"NaN": worst.nan, "infinite": worst.infinite, "zero": worst.zero, "negative": worst.negative}
    faults = "".join(f"; {count} {name}" for name, count in counts.items() if count)
    ulps = f"{worst.worst_ulps:.3g}" if math.isfinite(worst.worst_ulps) else "no number of"
    return f"{what}{worst.worst:.1e} ({ulps} ulp) at {where}: {worst.got:.9g}, exact {worst.exact:.9g}{faults}"
