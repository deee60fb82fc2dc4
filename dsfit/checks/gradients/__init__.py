"""Suite `gradients`: derivatives of everything that fits and renderers differentiate, against differences that know
their own error; and gradients of the second moment by Monte Carlo against quadrature.

Each part is a function of its own that takes a user's proposal and integrand; `run` turns what they return into
findings. See `compare` (reverse mode, forward mode and differences side by side), `differences`, `functions` (what is
differentiated), `formulas`, `second_order`, `through_fit`, `moment` and `estimators` (gradients of the second moment),
`agreement` and `jumps`.
"""

from __future__ import annotations

from collections.abc import Sequence

from dsfit.checks.gradients.agreement import Agreement, PlantedFault, agreement, planted_faults
from dsfit.checks.gradients.compare import DerivativeCheck, check_derivative
from dsfit.checks.gradients.derivative_findings import derivative_findings, fit_findings, proposal_checks
from dsfit.checks.gradients.differences import ComplexStep, Difference, complex_step, derivative
from dsfit.checks.gradients.estimators import ESTIMATORS, GradientEstimate, Problem
from dsfit.checks.gradients.jumps import Jumps, find_jumps
from dsfit.checks.gradients.moment import ExactMoment, defended, learnable, moment_gradient
from dsfit.checks.gradients.moment_findings import moment_findings
from dsfit.checks.gradients.second_order import SecondOrder, second_derivatives
from dsfit.checks.gradients.through_fit import FitDerivatives, derivatives_through_fit
from dsfit.checks.subject import Outcome, Say, Subject, silent

MOMENTS = ("R", "TT", "mixture", "structured")


def run(
    subject: Subject,
    *,
    say: Say = silent,
    points: int = 24,
    samples: int = 20_000,
    defensive: float = 0.2,
    moments: str | Sequence[str] = MOMENTS,
    through_fit: bool = True,
    averages: bool = False,
) -> Outcome:
    """Check all derivatives at one shading point.

    Args:
        subject: integrand, context and proposals.
        say: told what is being checked.
        points: directions and uniforms that each derivative is taken at.
        samples: of every Monte Carlo gradient; up to four times as many where the standard error asks for it.
        defensive: share of the uniform sphere that a proposal without one is mixed with for Monte Carlo gradients.
        moments: names of the chapter's proposals whose second moment is differentiated, or "all"; others always are.
        through_fit: whether to differentiate through a fit.
        averages: whether to differentiate the averages of dual scattering in the fibre as well, which makes them anew
            some eighty times: many minutes.
    """
    outcome = Outcome()
    outcome.findings += derivative_findings(subject, points, averages, say)
    if through_fit:
        say("derivatives through a fit")
        outcome.findings += fit_findings(subject)
    findings, arrays = moment_findings(subject, samples, defensive, moments, say)
    outcome.findings += findings
    outcome.arrays.update(arrays)
    return outcome


__all__ = [
    "ESTIMATORS",
    "Agreement",
    "ComplexStep",
    "DerivativeCheck",
    "Difference",
    "ExactMoment",
    "FitDerivatives",
    "GradientEstimate",
    "Jumps",
    "PlantedFault",
    "Problem",
    "SecondOrder",
    "agreement",
    "check_derivative",
    "complex_step",
    "defended",
    "derivative",
    "derivatives_through_fit",
    "find_jumps",
    "learnable",
    "moment_gradient",
    "planted_faults",
    "proposal_checks",
    "run",
    "second_derivatives",
]
