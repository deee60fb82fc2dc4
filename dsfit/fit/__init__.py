"""Fitting proposals: objectives, solvers, and the torch-to-JAX bridge (JAX is imported only when a solver needs it).

The package itself can be called: `dsfit.fit(proposal, integrand, context, ...)` is `dsfit.fit.fit(...)`, so that the
module `dsfit.fit` and the function of the same name do not hide each other.
"""

from __future__ import annotations

import sys
import types
from typing import Any

from dsfit.fit.costs import Costs, measure_costs
from dsfit.fit.fit import Fit, fit
from dsfit.fit.objectives import OBJECTIVES, Excess, ForwardKL, LogExcess, Objective, Target, VarianceCost
from dsfit.fit.problem import FunctionProblem, Problem, compress
from dsfit.fit.proposal_problem import ProposalProblem
from dsfit.fit.solvers import SOLVERS, minimise
from dsfit.fit.stochastic import StochasticFit, fit_stochastic
from dsfit.fit.tracking import HistoryEntry, SolverResult
from dsfit.fit.transmittance import TransmittanceFit, fit_transmittance

__all__ = [
    "OBJECTIVES",
    "SOLVERS",
    "Costs",
    "Excess",
    "Fit",
    "ForwardKL",
    "FunctionProblem",
    "HistoryEntry",
    "LogExcess",
    "Objective",
    "Problem",
    "ProposalProblem",
    "SolverResult",
    "StochasticFit",
    "Target",
    "TransmittanceFit",
    "VarianceCost",
    "compress",
    "fit",
    "fit_stochastic",
    "fit_transmittance",
    "measure_costs",
    "minimise",
]


class _CallableModule(types.ModuleType):
    def __call__(self, *args: Any, **kwargs: Any) -> Fit:
        return fit(*args, **kwargs)


sys.modules[__name__].__class__ = _CallableModule
