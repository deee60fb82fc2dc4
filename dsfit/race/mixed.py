"""Multiple importance sampling as lean as the race's other estimators: no error bars, no tests."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from dsfit.context import Context
from dsfit.mis.allocation import split_counts
from dsfit.mis.estimate import estimate
from dsfit.mis.estimators import contribution, draw, draw_mixture
from dsfit.mis.heuristics import Optimal, heuristic
from dsfit.proposals.base import Distribution, Proposal
from dsfit.proposals.mixture import MixtureDistribution
from dsfit.race.density import DensitySampler
from dsfit.race.peer import Problem, Sampler


def mis_sampler(
    problem: Problem,
    proposals: Sequence[Proposal],
    fractions: Sequence[float],
    contexts: Context,
    rule: Any = "balance",
    model: str = "multi",
) -> Sampler:
    """The sampler of several proposals with given shares: a plain mixture where balance chooses one proposal per
    sample, else the multi- or one-sample estimator; `optimal` by `dsfit.estimate`, which finds its control variates
    from the samples."""
    if isinstance(heuristic(rule), Optimal):
        return OptimalSampler(problem, proposals, fractions, contexts, rule, model)
    distributions = [proposal(contexts) for proposal in proposals]
    if model == "one" and rule == "balance":
        log_shares = torch.log(torch.tensor(fractions, dtype=contexts.dtype))
        return DensitySampler(problem, MixtureDistribution(distributions, log_shares), contexts)
    kind = OneSample if model == "one" else MultiSample
    return kind(problem, distributions, fractions, contexts, rule)


class MultiSample(Sampler):
    """`sum_s 1/n_s sum_i w_s F / p_s` with counts in proportion to the shares, each at least 1."""

    def __init__(
        self, problem: Problem, distributions: list[Distribution], fractions: Sequence[float], contexts: Context,
        rule: Any,
    ) -> None:  # fmt: skip
        self.problem, self.distributions, self.contexts = problem, distributions, contexts
        self.fractions, self.rule = list(fractions), heuristic(rule)
        self.least = len(self.fractions)

    def estimate(self, samples: int, generator: torch.Generator) -> Tensor:
        counts = split_counts(samples, self.fractions)
        used = torch.tensor([n / samples for n in counts], dtype=self.contexts.dtype)
        total: Tensor | float = 0.0
        for s, (distribution, n) in enumerate(zip(self.distributions, counts, strict=True)):
            for u in self.problem.draw(n, self.contexts, distribution.dimension, generator):
                omega, log_p = draw(self.distributions, s, u)
                value = self.problem.integrand(omega, self.contexts)
                total = total + contribution(value, log_p, s, used, self.rule).sum(0, dtype=torch.float64)
        return torch.as_tensor(total) / samples


class OneSample(Sampler):
    """`mean of w_s F / (c_s p_s)`, each sample's strategy chosen by the shares."""

    def __init__(
        self, problem: Problem, distributions: list[Distribution], fractions: Sequence[float], contexts: Context,
        rule: Any,
    ) -> None:  # fmt: skip
        self.problem, self.distributions, self.contexts = problem, distributions, contexts
        self.shares, self.rule = torch.tensor(fractions, dtype=contexts.dtype), heuristic(rule)
        self.dimension = 1 + max(d.dimension for d in distributions)

    def estimate(self, samples: int, generator: torch.Generator) -> Tensor:
        total: Tensor | float = 0.0
        for u in self.problem.draw(samples, self.contexts, self.dimension, generator):
            omega, log_p, choice = draw_mixture(self.distributions, self.shares, u)
            value = self.problem.integrand(omega, self.contexts)
            total = total + contribution(value, log_p, choice, self.shares, self.rule).sum(0, dtype=torch.float64)
        return torch.as_tensor(total) / samples


class OptimalSampler(Sampler):
    """Optimal MIS weights, cross-fitted on the samples themselves."""

    def __init__(
        self, problem: Problem, proposals: Sequence[Proposal], fractions: Sequence[float], contexts: Context, rule: Any,
        model: str,
    ) -> None:  # fmt: skip
        self.problem, self.proposals, self.contexts = problem, list(proposals), contexts
        self.options = {"heuristic": rule, "model": model, "allocation": list(fractions), "test": False}
        quasi = problem.uniforms != "random"
        share = 1.0 if model == "one" else min(fractions)
        self.least = math.ceil((16 if quasi else 2) / share)

    def estimate(self, samples: int, generator: torch.Generator) -> Tensor:
        integrand, uniforms = self.problem.integrand, self.problem.uniforms
        options = {**self.options, "generator": generator, "uniforms": uniforms}
        return estimate(integrand, self.proposals, self.contexts, samples, **options).value
