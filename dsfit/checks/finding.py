"""What a check says: one finding per thing that was looked at, and the verdict over a family of them."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

Verdict = Literal["pass", "fail", "unclear"]


@dataclass(frozen=True)
class Finding:
    """One thing that was checked.

    Either statistical, with a `p_value` that `judge` compares with the level that Šidák's correction leaves to each of
    the family; or deterministic, with a `value` that must not exceed `bound`. A negative control is deterministic too:
    its value is the p-value by which it was rejected (or the bound over the deviation), which has to be small.

    Attributes:
        suite: the check, as in `chi_square`.
        subject: what was checked: a proposal, a function, an equation.
        case: where: a context, a regime.
        p_value: probability of data at least as extreme if the subject is right; None for deterministic findings.
        value, bound: deterministic findings pass if `value <= bound`; NaN fails.
        unclear: why the check could not tell; such a finding is neither a pass nor a failure, and is shown.
        detail: one line for the reader.
        data: further plain numbers, for tables and plots.
    """

    suite: str
    subject: str
    case: str
    p_value: float | None = None
    value: float | None = None
    bound: float | None = None
    unclear: str | None = None
    detail: str = ""
    data: dict[str, Any] = field(default_factory=dict)

    def verdict(self, level: float) -> Verdict:
        """The verdict where a p-value has to exceed `level`."""
        if self.unclear is not None:
            return "unclear"
        if self.p_value is not None and not self.p_value > level:
            return "fail"
        if self.value is not None and self.bound is not None and not self.value <= self.bound:
            return "fail"
        return "pass"

    def to_dict(self) -> dict[str, Any]:
        """As plain data."""
        return asdict(self)


def sidak(level: float, count: int) -> float:
    """Level of each of `count` independent tests whose family has `level`: `1 - (1 - level)^(1 / count)`."""
    return -math.expm1(math.log1p(-level) / max(count, 1))


def judge(findings: Iterable[Finding], level: float = 0.01) -> list[tuple[Finding, Verdict]]:
    """Every finding with its verdict; each suite's p-values are one family of level `level`."""
    found = list(findings)
    statistical: dict[str, int] = {}
    for finding in found:
        if finding.p_value is not None and finding.unclear is None:
            statistical[finding.suite] = statistical.get(finding.suite, 0) + 1
    return [(f, f.verdict(sidak(level, statistical.get(f.suite, 1)))) for f in found]
