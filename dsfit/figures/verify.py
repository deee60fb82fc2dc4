"""Compares the data of experiments with stored reference data, by each experiment's rules."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table
from scipy.stats import norm

from dsfit.errors import InputError
from dsfit.experiment import files
from dsfit.figures import agreement, reference, state
from dsfit.figures.agreement import Found
from dsfit.figures.catalogue import Entry
from dsfit.figures.data import SCHEMA_VERSION, Data, read_data
from dsfit.figures.rules import Close, Estimate, Exact, Measured, Rule

AGREES, DEVIATES, NOT_COMPARED = "agrees", "deviates", "not compared"
LEVEL = 0.01
_STANDARD_ERROR = "standard error"
_MOST_TOLD = 20


def verify_all(entries: Sequence[Entry], out: Path, against: Path) -> dict[str, dict[str, Any]]:
    """Compare each experiment, and write `OUT/verify.json`; returns what it holds: by experiment, the verdict
    ("agrees", "deviates", "not compared"), the reason if it was not compared, values by kind of rule, the worst
    deviation in units of what is allowed and where it is, seconds' ratios, and what deviates.

    Raises:
        InputError: there is no directory `OUT`.
    """
    if not out.is_dir():
        raise InputError(str(out), "no such directory", "a directory that `dsfit figures run` has written")
    found = {entry.name: verify(entry, out / entry.name, against / entry.name) for entry in entries}
    files.write_json(out / "verify.json", {"schema_version": SCHEMA_VERSION, "experiments": found})
    return found


def verify(entry: Entry, folder: Path, against: Path) -> dict[str, Any]:
    """Compare one; see `verify_all`."""
    try:
        stored = reference.read(against)
    except InputError as error:
        return _not_compared(f"no reference data: {error}")
    if failed := state.read_state(folder / state.FAILED):
        return {**_not_compared(f"the last attempt failed: {failed['failure']}"), "verdict": DEVIATES}
    if not state.has_data(folder):
        return _not_compared("not computed")
    computed = state.read_state(folder / state.COMPUTED)
    if changes := _changes(computed["settings"], stored.settings):
        return _not_compared("other settings than the reference's: " + "; ".join(changes))
    found = compare(read_data(folder), stored.data, entry.experiment.reproduces)
    return {**found, "data": computed["data"]}


def compare(new: Data, old: Data, rules: Mapping[str, Rule]) -> dict[str, Any]:
    """Compare data with reference data."""
    values, expected = dict(new.values()), dict(old.values())
    kinds = rules_of(expected, rules)
    bound = bound_of(expected, kinds)
    found = {
        name: _compare(name, values, expected, rule, pattern, bound) if name in values else _alone("missing")
        for name, (rule, pattern) in kinds.items()
    }
    found.update({name: _alone("not in the reference") for name in values if name not in expected})
    wrong = {name: one.what for name, one in found.items() if not one.agrees}
    counts: Counter[str] = Counter()
    for name, one in found.items():
        counts[_kind(kinds[name][0]) if name in kinds else "extra"] += one.count
    held = [name for name, one in found.items() if not math.isnan(one.deviation)]
    worst = max(held, key=lambda name: found[name].deviation, default=None)
    ratios = {name: found[name].what for name, (rule, _) in kinds.items() if isinstance(rule, Measured)}
    return {
        "verdict": DEVIATES if wrong else AGREES,
        "reason": "",
        "compared": dict(sorted(counts.items())),
        "z_bound": bound,
        "worst": None if worst is None else _told(worst, found[worst]),
        "measured": {name: what for name, what in ratios.items() if what},
        "deviating": dict(list(wrong.items())[:_MOST_TOLD]),
        "deviating_count": len(wrong),
    }


def rules_of(values: Mapping[str, Any], rules: Mapping[str, Rule]) -> dict[str, tuple[Rule | str, str]]:
    """The rule of each value and its pattern: the first that fits. Values that hold the standard errors of others, and
    fit no pattern, are told as such."""
    found: dict[str, tuple[Rule | str, str]] = {}
    errors = set()
    for name in values:
        pattern = next((pattern for pattern in rules if matches(pattern, name) is not None), None)
        rule = Exact() if pattern is None else rules[pattern]
        found[name] = (rule, pattern or "")
        if isinstance(rule, Estimate):
            errors.add(error_name(rule, pattern or "", name))
    for name in errors & found.keys():
        if not found[name][1]:
            found[name] = (_STANDARD_ERROR, "")
    return found


def bound_of(values: Mapping[str, Any], kinds: Mapping[str, tuple[Rule | str, str]]) -> float:
    """What |z| may be: over N estimates the chance of a larger one is 1 %, 1 - (1 - p)^N = 0.01 (Šidák)."""
    count = 0
    for name, (rule, _) in kinds.items():
        if isinstance(rule, Estimate) and (held := agreement.numbers(values[name])) is not None:
            count += held.size
    return float(norm.isf(-math.expm1(math.log1p(-LEVEL) / max(count, 1)) / 2))


def matches(pattern: str, name: str) -> list[str] | None:
    """What the stars of a glob pattern stand for, None if the name does not fit."""
    parts = {"*": "(.*)", "?": "."}
    found = re.fullmatch("".join(parts.get(sign, re.escape(sign)) for sign in pattern), name, re.DOTALL)
    return None if found is None else list(found.groups())


def error_name(rule: Estimate, pattern: str, name: str) -> str:
    """Where the standard errors of a value are."""
    stars: Iterator[str] = iter(matches(pattern, name) or [])
    return re.sub(r"\*", lambda _: next(stars, "*"), rule.error)


def _compare(
    name: str, new: Mapping[str, Any], old: Mapping[str, Any], rule: Rule | str, pattern: str, bound: float
) -> Found:
    a, b = new[name], old[name]
    if isinstance(rule, Close):
        return agreement.close(a, b, rule)
    if isinstance(rule, Measured):
        return agreement.measured(a, b)
    if isinstance(rule, Estimate):
        where = error_name(rule, pattern, name)
        if where not in new or where not in old:
            return Found(1, math.inf, f"no standard errors {where!r}", False)
        return agreement.estimate(a, b, (new[where], old[where]), rule, bound)
    return agreement.standard_error(a, b) if rule == _STANDARD_ERROR else agreement.exact(a, b)


def _alone(what: str) -> Found:
    return Found(1, math.inf, what, False)


def _kind(rule: Rule | str) -> str:
    return rule if isinstance(rule, str) else type(rule).__name__.lower()


def _told(name: str, found: Found) -> dict[str, Any]:
    return {"value": name, "deviation": found.deviation, "what": found.what}


def _not_compared(reason: str) -> dict[str, Any]:
    return {"verdict": NOT_COMPARED, "reason": reason, "compared": {}, "worst": None, "measured": {}, "deviating": {}}


def _changes(new: Mapping[str, Any], old: Mapping[str, Any]) -> list[str]:
    return [
        f"{key} {old.get(key)!r} -> {new.get(key)!r}" for key in sorted({*new, *old}) if new.get(key) != old.get(key)
    ]


def show(found: Mapping[str, Mapping[str, Any]], console: Console) -> None:
    """Print the verdicts."""
    table = Table("experiment", "compared", "worst, in units of what is allowed", "verdict")
    for name, one in found.items():
        counts = ", ".join(f"{count} {kind}" for kind, count in one["compared"].items())
        table.add_row(name, counts, escape(_words(one)), one["verdict"])
    console.print(table)
    for name, one in found.items():
        for value, what in one["deviating"].items():
            console.print(f"{name}: {value}: {what}", markup=False)
        if (more := one.get("deviating_count", 0) - len(one["deviating"])) > 0:
            console.print(f"{name}: and {more} more")


def _words(one: Mapping[str, Any]) -> str:
    if one["reason"]:
        return one["reason"]
    worst = one["worst"]
    if worst is None or worst["deviation"] == 0:
        return "none"
    return f"{worst['deviation']:.3g}: {worst['value']}: {worst['what']}"
