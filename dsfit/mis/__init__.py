"""Multiple importance sampling: heuristics, estimators, allocation of samples, errors against time."""

from dsfit.mis.allocation import OptimalAllocation, measure_costs, parse_allocation, split_counts
from dsfit.mis.error_curve import Convergence, convergence
from dsfit.mis.estimate import Estimate, estimate
from dsfit.mis.estimators import contribution, multi_sample, one_sample
from dsfit.mis.heuristics import HEURISTICS, Balance, Cutoff, Heuristic, Maximum, Optimal, Power, heuristic
from dsfit.mis.variance import MisVariance, best_fractions, mis_variance

__all__ = [
    "HEURISTICS",
    "Balance",
    "Convergence",
    "Cutoff",
    "Estimate",
    "Heuristic",
    "Maximum",
    "MisVariance",
    "Optimal",
    "OptimalAllocation",
    "Power",
    "best_fractions",
    "contribution",
    "convergence",
    "estimate",
    "heuristic",
    "measure_costs",
    "mis_variance",
    "multi_sample",
    "one_sample",
    "parse_allocation",
    "split_counts",
]
