"""The plain estimator of one density: the mean of F / p."""

from __future__ import annotations

import torch
from torch import Tensor

from dsfit.context import Context
from dsfit.proposals.base import Distribution
from dsfit.race.peer import Problem, Sampler


class DensitySampler(Sampler):
    """`1/S sum F(omega_s) / p(omega_s)` with omega_s from one distribution; F in the problem's dtype, the sum in
    float64.

    Args:
        problem: the integrand and the kind of uniform numbers.
        distribution: where directions come from; its batch shape is that of the contexts.
        contexts: `[B]`.
    """

    def __init__(self, problem: Problem, distribution: Distribution, contexts: Context) -> None:
        self.problem, self.distribution, self.contexts = problem, distribution, contexts

    def estimate(self, samples: int, generator: torch.Generator) -> Tensor:
        total: Tensor | float = 0.0
        for u in self.problem.draw(samples, self.contexts, self.distribution.dimension, generator):
            omega, log_p = self.distribution.sample_with_log_prob(u)
            value = self.problem.integrand(omega, self.contexts)
            total = total + (value * torch.exp(-log_p).unsqueeze(-1)).sum(0, dtype=torch.float64)
        return torch.as_tensor(total) / samples

    def log_prob(self, omega: Tensor) -> Tensor:
        return self.distribution.log_prob(omega)
