"""Light sampling beside whatever else directions are drawn from."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from dsfit.context import Context
from dsfit.errors import InputError
from dsfit.mis.allocation import split_counts
from dsfit.mis.estimators import contribution
from dsfit.mis.heuristics import Balance, heuristic
from dsfit.proposals.base import Distribution, Proposal
from dsfit.proposals.mixture import log_sum_exp
from dsfit.race.density import DensitySampler
from dsfit.race.mixed import MultiSample, OneSample, OptimalSampler
from dsfit.race.peer import Problem, Sampler
from dsfit.race.samplers import EachSampler
from dsfit.render.integrand import HairIntegrand


class LightAt(Proposal):
    """The light's own proposal, as the hits of the contexts see the light."""

    def __init__(self, integrand: HairIntegrand) -> None:
        super().__init__()
        self.integrand = [integrand]  # not a submodule

    @functools.cached_property
    def dimension(self) -> int:
        """Uniform numbers per direction."""
        return self.integrand[0].light.proposal()(Context(0.0)).dimension

    def forward(self, context: Context) -> Distribution:
        return self.integrand[0].light_at(context).proposal()(context)


class MixSampler(Sampler):
    """Several distributions with given shares of the samples.

    "multi": counts in proportion to the shares. Where the smallest share is less than one sample, and for "one", every
    sample chooses its strategy by its first uniform number. Balance divides by the mixture's density, which is all that
    it takes; other rules weigh by `dsfit.mis`.

    Args:
        problem: the integrand and the kind of uniform numbers.
        distributions: the strategies.
        shares: of each, > 0, with sum 1; with model "one" and balance also a tensor `[strategies, B]`.
        contexts: `[B]`.
        rule: a heuristic other than "optimal".
        model: "multi" or "one".
    """

    def __init__(
        self, problem: Problem, distributions: Sequence[Distribution], shares: Sequence[float] | Tensor,
        contexts: Context, rule: Any = "balance", model: str = "multi",
    ) -> None:  # fmt: skip
        self.problem, self.distributions, self.contexts = problem, list(distributions), contexts
        self.shares = shares if isinstance(shares, Tensor) else list(shares)
        self.rule, self.model = heuristic(rule), model

    def estimate(self, samples: int, generator: torch.Generator) -> Tensor:
        if self.model == "one" or samples * min(self.shares) < 1:
            return self._one(samples, generator)
        counts = split_counts(samples, self.shares)
        used = torch.tensor([n / samples for n in counts], dtype=self.contexts.dtype)
        total: Tensor | float = 0.0
        for s, (distribution, n) in enumerate(zip(self.distributions, counts, strict=True)):
            for u in self.problem.draw(n, self.contexts, distribution.dimension, generator):
                omega, own = distribution.sample_with_log_prob(u)
                logs = [own if k == s else d.log_prob(omega) for k, d in enumerate(self.distributions)]
                total = total + self._weighed(omega, logs, s, used)
        return torch.as_tensor(total) / samples

    def _one(self, samples: int, generator: torch.Generator) -> Tensor:
        used = torch.as_tensor(self.shares, dtype=self.contexts.dtype)
        edges = used.cumsum(0)[:-1]
        dimension = 1 + max(d.dimension for d in self.distributions)
        total: Tensor | float = 0.0
        for u in self.problem.draw(samples, self.contexts, dimension, generator):
            choice = sum((u[..., 0] >= edge).int() for edge in edges)
            omega: Tensor | None = None
            for s, d in enumerate(self.distributions):
                drawn = d.sample(u[..., 1 : 1 + d.dimension])
                omega = drawn if omega is None else torch.where((choice == s).unsqueeze(-1), drawn, omega)
            assert omega is not None
            total = total + self._weighed(omega, [d.log_prob(omega) for d in self.distributions], choice, used)
        return torch.as_tensor(total) / samples

    def _weighed(self, omega: Tensor, logs: list[Tensor], own: int | Tensor, used: Tensor) -> Tensor:
        """Sum over samples of w F / (c p), float64 `[B, C]`."""
        value = self.problem.integrand(omega, self.contexts)
        if not isinstance(self.rule, Balance):
            z = contribution(value, torch.stack(torch.broadcast_tensors(*logs)), own, used, self.rule)
            return z.sum(0, dtype=torch.float64)
        log_p = log_sum_exp(torch.stack(torch.broadcast_tensors(*logs), dim=-1) + torch.log(used).movedim(0, -1))
        z = torch.where(value == 0, 0.0, value * torch.exp(-log_p).unsqueeze(-1))
        return z.sum(0, dtype=torch.float64)

    def log_prob(self, omega: Tensor) -> Tensor | None:
        if not isinstance(self.rule, Balance) or self.model == "multi":
            return None
        logs = torch.stack(torch.broadcast_tensors(*(d.log_prob(omega) for d in self.distributions)), dim=-1)
        return log_sum_exp(logs + torch.log(torch.as_tensor(self.shares).to(logs)).movedim(0, -1))


def with_light(
    sampler: Sampler, problem: Problem, light: Proposal, share: float, contexts: Context, rule: Any, model: str
) -> Sampler:
    """The sampler with one more strategy, light sampling, that gets `share` of the samples.

    Several strategies keep their rule and model (`rule` and `model` are for samplers of one density), and their shares
    among themselves.

    Raises:
        InputError: a sampler that does not tell what it draws from.
    """
    from dsfit.render.techniques.split import ChosenSampler, SplitSampler

    if isinstance(sampler, ChosenSampler):
        sampler = sampler.many
    if isinstance(sampler, EachSampler):
        each = [contexts[k : k + 1] for k in range(len(contexts))]
        pairs = zip(sampler.samplers, each, strict=True)
        return EachSampler([with_light(one, problem, light, share, c, rule, model) for one, c in pairs])
    if isinstance(sampler, SplitSampler):
        parts = [sampler.lobes, sampler.light(contexts), light(contexts)]
        return MixSampler(problem, parts, _joined(sampler.shares, share), contexts, "balance", "one")
    if isinstance(sampler, OptimalSampler):
        proposals, fractions = [*sampler.proposals, light], _joined(sampler.options["allocation"], share)
        return OptimalSampler(
            problem, proposals, fractions, contexts, sampler.options["heuristic"], sampler.options["model"]
        )
    if isinstance(sampler, DensitySampler):
        distributions, shares = [sampler.distribution], [1.0]
    elif isinstance(sampler, MixSampler):
        distributions, shares, rule, model = sampler.distributions, sampler.shares, sampler.rule, sampler.model
    elif isinstance(sampler, MultiSample):
        distributions, shares, rule, model = sampler.distributions, sampler.fractions, sampler.rule, "multi"
    elif isinstance(sampler, OneSample):
        distributions, shares, rule, model = sampler.distributions, sampler.shares.tolist(), sampler.rule, "one"
    else:
        raise InputError("light", share, f"0 with a {type(sampler).__name__}, which does not tell its densities")
    return MixSampler(problem, [*distributions, light(contexts)], _joined(shares, share), contexts, rule, model)


def _joined(shares: Sequence[float] | Tensor, light: float) -> list[float] | Tensor:
    """The shares with light's as the last."""
    if isinstance(shares, Tensor):
        return torch.cat([shares * (1 - light), torch.full_like(shares[:1], light)])
    return [c * (1 - light) for c in shares] + [light]
