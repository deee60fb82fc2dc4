"""Negative controls: solvers that fail in every way the examination looks for, each of which it must name.

Every liar takes an honest solve of one step of a fit that needs ten and spoils what it says.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import nn

from dsfit.checks.stiff_fits.cases import Case, Guard, Limits, Solved
from dsfit.checks.stiff_fits.examine import Examination, examine
from dsfit.checks.stiff_fits.fits import TARGET_ONE, gaussian_cases, gaussians

SOLVER = "optimistix.lm"
LIMITS = Limits(20.0, 60.0, 1)


class Heavier(nn.Module):
    """A proposal whose density is 2 % too large, and so is its mass."""

    def __init__(self, proposal: nn.Module) -> None:
        super().__init__()
        self.proposal = proposal

    def forward(self, context: Any) -> Any:
        law = copy.copy(self.proposal(context))
        honest = law.log_prob
        law.log_prob = lambda omega: honest(omega) + math.log(1.02)
        return law

    @property
    def components(self) -> Any:
        """Those of the proposal."""
        return self.proposal.components


@dataclass(frozen=True)
class Liar:
    """A way to spoil a solve, and the words that the examination must find for it."""

    name: str
    spoil: Callable[[Case, Solved], Solved]
    fault: str


def _says(**changes: Any) -> Callable[[Case, Solved], Solved]:
    return lambda case, solved: replace(solved, result=replace(solved.result, **changes))


def _worse(case: Case, solved: Solved) -> Solved:
    y = case.start.clone()
    y[-1] = y[-1] + 1.5  # a much wider lobe
    with torch.no_grad():
        return replace(solved, result=replace(solved.result, y=y, value=float(case.value(y))))


def _half_value(case: Case, solved: Solved) -> Solved:
    return replace(solved, result=replace(solved.result, value=0.5 * solved.result.value))


def _not_a_number(case: Case, solved: Solved) -> Solved:
    return replace(solved, result=replace(solved.result, y=torch.full_like(solved.result.y, math.nan)))


def _bad_proposal(case: Case, solved: Solved) -> Solved:
    assert solved.proposal is not None
    spoilt = copy.deepcopy(solved.proposal)
    with torch.no_grad():
        next(spoilt.parameters()).fill_(math.nan)
    return replace(solved, proposal=spoilt)


def _heavier(case: Case, solved: Solved) -> Solved:
    assert solved.proposal is not None
    return replace(solved, proposal=Heavier(solved.proposal))


def _raises(case: Case, solved: Solved) -> Solved:
    raise ZeroDivisionError("inside the solver")


def _hangs(case: Case, solved: Solved) -> Solved:
    guard, y = Guard(0.2), case.start
    while True:
        guard()
        case.value(y)


_CONVERGED = {"converged": True, "reason": "a Gauss-Newton step promises a relative decrease of 1.0e-12"}

LIARS: tuple[Liar, ...] = (
    Liar("claims convergence", _says(**_CONVERGED), "claims to have converged"),
    Liar("says the gradient is zero", _says(reason="the gradient is zero"), "says the gradient is zero"),
    Liar("says the value is zero", _says(reason="the value is zero"), "says the value is zero"),
    Liar("says max_steps too early", _says(reason="max_steps reached (1)", steps=0), "says max_steps"),
    Liar("says max_seconds too early", _says(reason="max_seconds reached (20)"), "says max_seconds"),
    Liar("takes more steps than allowed", _says(steps=1000), "took 1000 steps"),
    Liar("gives no reason", _says(reason=""), "gives no reason"),
    Liar("returns NaN", _not_a_number, "not finite"),
    Liar("returns worse than its start", _worse, "worse than its start"),
    Liar("claims half the value", _half_value, "claims the value"),
    Liar("returns a proposal of NaN", _bad_proposal, "not numbers"),
    Liar("returns a proposal of mass 1.02", _heavier, "mass"),
    Liar("raises", _raises, "raised ZeroDivisionError"),
    Liar("hangs", _hangs, "hangs"),
)
"""Controls, none of which may pass."""


def honest_case() -> Case:
    """A fit that one step does not solve."""
    return gaussian_cases(lambda: gaussians([(1.0, 0.0, 0.5)]), TARGET_ONE, "control", objectives=("excess",))[0]


def caught(liar: Liar, case: Case) -> Examination:
    """What the examination says of a spoilt solve."""
    honest: Callable[[str, Limits], Solved] = case.solve
    spoilt = replace(case, solve=lambda solver, limits: liar.spoil(case, honest(solver, limits)))
    return examine(spoilt, SOLVER, LIMITS)


def is_caught(liar: Liar, seen: Examination) -> bool:
    """Whether the examination names the fault."""
    return any(liar.fault in fault for fault in seen.faults)
