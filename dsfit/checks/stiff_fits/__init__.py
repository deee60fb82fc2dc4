"""Every solver on badly posed fits: it converges or says why not, and what it returns is a density.

A part is a problem, tried with every solver and objective that can take it. A pass means that nothing the solver said
could be disproved (`examine`): finite parameters and value, the value that the plain formula gives, no worse than the
start, within the limits of steps and time, a reason that is true, a claim of convergence that no single step disproves,
and a proposal of mass 1. Not to reach the optimum is no fault where the solver says so or stands at a point of first
order; whether it was reached is in the data (`solved`), and `compare.compare` makes a table of it.

The part "controls" puts solvers that lie, return NaN, get worse, raise or hang through the same examination.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from dsfit.checks.finding import Finding
from dsfit.checks.stiff_fits.cases import Case, Limits
from dsfit.checks.stiff_fits.compare import compare
from dsfit.checks.stiff_fits.examine import Examination, able, examine
from dsfit.checks.stiff_fits.fits import FITS
from dsfit.checks.stiff_fits.liars import LIARS, LIMITS, SOLVER, caught, honest_case, is_caught
from dsfit.checks.stiff_fits.toys import TOYS
from dsfit.checks.subject import Outcome, Say, silent
from dsfit.checks.suites import chosen
from dsfit.fit.solvers import SOLVERS

__all__ = ["PROBLEMS", "Examination", "Limits", "compare", "examine", "examine_all", "parts", "run"]

PROBLEMS: dict[str, Callable[[], list[Case]]] = {**TOYS, **FITS}
"""Problems by name; each makes its cases, one per objective."""

CONTROLS = "controls"


def parts(
    problems: str | Sequence[str] = "all", solvers: str | Sequence[str] = "all", seconds: float = 20.0
) -> list[str]:
    """Names of the problems to try, and "controls".

    Raises:
        InputError: an unknown problem or solver.
    """
    solver_names(solvers)
    return _one_or_more("problems", problems, (*PROBLEMS, CONTROLS))


def solver_names(solvers: str | Sequence[str]) -> list[str]:
    """The solvers meant; raises `InputError` for an unknown one."""
    return _one_or_more("solvers", solvers, tuple(SOLVERS))


def _one_or_more(field: str, names: str | Sequence[str], known: Sequence[str]) -> list[str]:
    """`chosen`, which a single name may be given to as well."""
    return chosen(field, [names] if isinstance(names, str) and names != "all" else names, known)


def examine_all(cases: Sequence[Case], solvers: Sequence[str], limits: Limits, say: Say = silent) -> list[Examination]:
    """Every case with every solver that can take it. Where no optimum is known, the best that any solver found takes
    its place (`compared`)."""
    found = []
    for case in cases:
        seen = []
        for solver in solvers:
            if able(solver, case):
                say(f"{case.name}, {case.objective or 'residuals'}, {solver}")
                seen.append(examine(case, solver, limits))
        finite = [one.objective for one in seen if math.isfinite(one.objective)]
        for one in seen:
            if one.optimum is None and finite and not one.refused:
                one.optimum, one.compared = min(finite), True
        found += seen
    return found


def run(
    part: str,
    *,
    seed: int,
    say: Say = silent,
    problems: str | Sequence[str] = "all",
    solvers: str | Sequence[str] = "all",
    seconds: float = 20.0,
) -> Outcome:
    """One problem with all solvers. Nothing is random: the seed has no effect.

    Args:
        part: a name of `parts`.
        problems: which parts there are; of no effect on this one.
        solvers: names of the solvers to try, or "all".
        seconds: wall time that a solver is told of; most are stopped by their limit of steps before.
    """
    if part == CONTROLS:
        return Outcome(_controls(say))
    limits = Limits(seconds, 3 * seconds)
    seen = examine_all(PROBLEMS[part](), solver_names(solvers), limits, say)
    arrays = {
        "objective": np.array([one.objective for one in seen]),
        "optimum": np.array([math.nan if one.optimum is None else one.optimum for one in seen]),
        "start": np.array([one.start for one in seen]),
    }
    return Outcome([_finding(one) for one in seen], arrays)


def _finding(seen: Examination) -> Finding:
    detail = "; ".join(seen.faults) or seen.reason
    case = f"{seen.case}, {seen.kind}" if seen.kind else seen.case
    return Finding(
        "stiff_fits", seen.solver, case, value=float(len(seen.faults)), bound=0.0, detail=detail, data=seen.data()
    )


def _controls(say: Say) -> list[Finding]:
    case = honest_case()
    say("controls")
    honest = examine(case, SOLVER, LIMITS)
    found = [
        Finding(
            "stiff_fits", "honest solver", CONTROLS, value=float(len(honest.faults)), bound=0.0,
            detail="; ".join(honest.faults) or "has no fault",
        )
    ]  # fmt: skip
    for liar in LIARS:
        seen = caught(liar, case)
        found.append(
            Finding(
                "stiff_fits", f"solver that {liar.name}", CONTROLS, value=float(not is_caught(liar, seen)), bound=0.0,
                detail="; ".join(seen.faults) or "not caught", data={"faults": list(seen.faults)},
            )
        )  # fmt: skip
    return found
