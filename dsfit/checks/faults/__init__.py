"""Faults planted into the library, one after the other: each has to be caught by the check that is meant for it, which
has to be content with the library as it is.

A check that has never been seen to fail proves nothing. `FAULTS` (dsfit/checks/faults/library.py) has at least one slip
in every module of the mathematics; `run` plants it in this process, where the check looks, and takes it out again. A
few entries are slips that no check sees, since they change what is chosen and not whether it is consistent; for those
the suite shows that nothing is reported.
"""

from __future__ import annotations

from typing import Any

from dsfit.checks.faults.library import FAULTS
from dsfit.checks.faults.planting import Fault, Patch, planted
from dsfit.checks.finding import Finding, judge
from dsfit.checks.subject import Outcome, Say, silent
from dsfit.checks.suites import chosen

SUITE = "faults"
_LEVEL = 1e-6  # of the checks: a catch has to be beyond doubt, and nothing may be caught by chance


def parts(faults: Any = "all") -> list[str]:
    """Names of the faults, all or those asked for.

    Raises:
        InputError: an unknown name.
    """
    return chosen("faults", faults, FAULTS)


def run(part: str, *, seed: int, say: Say = silent, faults: Any = "all") -> Outcome:
    """One fault: the check without it, which has to pass, and with it, which has to fail."""
    fault = FAULTS[part]
    say("without the fault")
    clean = judge(fault.look(seed), _LEVEL)
    say("with it")
    with planted(fault.patches):
        spoiled = _guarded(fault, seed)
    wrong = [f for f, verdict in clean if verdict == "fail"]
    caught = [f for f, verdict in spoiled if verdict == "fail"]
    detail = f"{fault.module}: {fault.slip}"
    strongest = _describe(caught)
    data = {"module": fault.module, "slip": fault.slip, "suite": fault.suite, "expected": fault.caught}
    data |= {"findings": len(spoiled), "failed": len(caught), "strongest": strongest}
    value = float(not caught) if fault.caught else float(len(caught))
    return Outcome(
        [
            Finding(SUITE, f"not {part}", fault.suite, value=float(len(wrong)), bound=0.0, detail=_describe(wrong)),
            Finding(SUITE, part, fault.suite, value=value, bound=0.0, detail=f"{detail} ({strongest})", data=data),
        ]
    )


def _guarded(fault: Fault, seed: int) -> list[tuple[Finding, str]]:
    """An exception is a catch as well: the library has refused to go on."""
    try:
        return list(judge(fault.look(seed), _LEVEL))
    except Exception as error:
        message = f"{type(error).__name__}: {error}"[:200]
        return [(Finding(fault.suite, "refused", "", value=1.0, bound=0.0, detail=message), "fail")]


def _describe(findings: list[Finding]) -> str:
    """The most convincing of the findings, in a few words."""
    if not findings:
        return "nothing reported"

    def strength(finding: Finding) -> float:
        if finding.p_value is not None:
            return -max(finding.p_value, 1e-300)
        return (finding.value or 0.0) / max(finding.bound or 0.0, 1e-300)

    best = max(findings, key=strength)
    if best.subject == "refused":
        return f"refused: {best.detail}"
    if best.p_value is not None:
        return f"{best.subject}: p = {best.p_value:.1g}"
    return f"{best.subject}{', ' + best.case if best.case else ''}: {best.value:.2g} > {best.bound:.1g}"


__all__ = ["FAULTS", "Fault", "Patch", "parts", "planted", "run"]
