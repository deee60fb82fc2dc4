"""What `dsfit figures verify` found, from the directory's `verify.json`."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dsfit.errors import InputError
from dsfit.experiment import files
from dsfit.experiment.files import number
from dsfit.figures.data import SCHEMA_VERSION
from dsfit.report.environment import mapping
from dsfit.report.page import Block, State, Table, Verdict

_STATES: dict[str, State] = {"agrees": "pass", "deviates": "fail", "not compared": "unclear"}
_WORDS = {"agrees": "reproduced", "deviates": "deviates", "not compared": "not compared"}


@dataclass(frozen=True)
class Verification:
    """What was compared, by experiment; no verdict where there is no file."""

    verdict: Verdict | None = None
    experiments: Mapping[str, Any] = field(default_factory=dict)

    @property
    def head(self) -> Sequence[str]:
        """Heads of its columns in the overview."""
        return ["against stored data"] if self.experiments else []

    def words(self, name: str) -> list[str]:
        """An experiment's cells in the overview."""
        return [_word(mapping(self.experiments.get(name)))] if self.experiments else []

    def blocks(self, name: str) -> list[Block]:
        """What there is to say of an experiment."""
        one = mapping(self.experiments.get(name))
        if not one:
            return []
        blocks: list[Block] = [Verdict(_state(one), f"stored data: {_word(one)}", _lines(one))]
        deviating = mapping(one.get("deviating"))
        if deviating:
            rows = [[str(value), str(what)] for value, what in deviating.items()]
            count = one.get("deviating_count", len(rows))
            left_out = max(count - len(rows), 0) if isinstance(count, int) else 0
            blocks.append(Table("What deviates", ["value", "how"], rows, "ll", left_out=left_out))
        return blocks


def verification(out: Path, data: Mapping[str, Any]) -> Verification:
    """What the directory's `verify.json` says; a damaged file is told of.

    Args:
        out: the directory.
        data: hashes of the present data, by experiment: what was compared when they were others counts no more.
    """
    if not (out / "verify.json").exists():
        return Verification()
    try:
        stored = mapping(files.read_json(out / "verify.json", SCHEMA_VERSION).get("experiments"))
    except InputError as error:
        return Verification(Verdict("unclear", "not verified", [f"verify.json: {error.value}."]))
    found = {name: _present(mapping(one), data.get(name)) for name, one in stored.items()}
    states = {_state(mapping(one)) for one in found.values()}
    counts = Counter(_word(mapping(one)) for one in found.values())
    told = "Against stored data: " + ", ".join(f"{n} {word}" for word, n in sorted(counts.items())) + "."
    if "fail" in states:
        return Verification(Verdict("fail", "deviates from stored data", [told]), found)
    if "unclear" in states or not found:
        return Verification(Verdict("unclear", "not all compared", [told]), found)
    return Verification(Verdict("pass", "reproduced", [told]), found)


def _present(one: Mapping[str, Any], data: Any) -> Mapping[str, Any]:
    if one.get("verdict") != "agrees" or one.get("data") == data:
        return one
    return {"verdict": "not compared", "reason": "the data have changed since they were compared"}


def _state(one: Mapping[str, Any]) -> State:
    return _STATES.get(str(one.get("verdict")), "unclear")


def _word(one: Mapping[str, Any]) -> str:
    return _WORDS.get(str(one.get("verdict")), "not compared")


def _lines(one: Mapping[str, Any]) -> list[str]:
    lines = []
    if one.get("reason"):
        lines.append(f"{one['reason']}.")
    if compared := mapping(one.get("compared")):
        lines.append("Numbers compared: " + ", ".join(f"{count} {kind}" for kind, count in compared.items()) + ".")
    worst = mapping(one.get("worst"))
    try:
        deviation = number(worst.get("deviation"))
    except (TypeError, ValueError):
        deviation = math.nan
    if deviation > 0:
        lines.append(f"The largest deviation is {deviation:.3g} of what is allowed: {worst.get('value')}.")
    return lines
