"""The best that the chapter's proposals can do together in a scene: shares fitted to a sample of its hits."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from dsfit.context import Context
from dsfit.errors import InputError
from dsfit.experiment.heuristic_mix import HEURISTICS, balance_fractions
from dsfit.mis.variance import mis_variance
from dsfit.proposals.base import Proposal
from dsfit.race.peer import Peer, Problem, Sampler
from dsfit.race.peers.chapter import proposals_of
from dsfit.render.techniques.mixed import LightAt, MixSampler
from dsfit.scene.lights import ConstantLight

_LEAST = 0.01
"""Strategies with a smaller share are dropped: each costs a density at every sample."""
_DIM = 1e-2
"""Hits count by their relative variance; those darker than this part of the mean, as if they were that bright."""


@dataclass(frozen=True)
class Chosen:
    """What `BestMix` found; `tried` maps "heuristic, model" to the mean relative variance of one sample."""

    shares: dict[str, float]
    heuristic: str
    model: str
    tried: dict[str, float]


class BestMix(Peer):
    """One set of shares, heuristic and model for the whole scene: those of the least mean over hits of the relative
    variance per sample, measured on directions drawn from all strategies in equal parts (as nodes with weights 1 / (Q
    P), P the mean of their densities).

    Strategies are the chapter's proposals (the uniform sphere is one of them) and light sampling. Shares are the convex
    optimum of the balance heuristic's second moment (He and Owen 2014), or equal ones over the same strategies; tried
    with the heuristics balance, power, maximum and cutoff, in both models.

    Args:
        hits: of the scene's sample, at most.
        samples: directions from every strategy at every hit.
        light_sampling: whether light sampling is a strategy; under a constant light it never is (it is uniform).

    Attributes:
        chosen: the outcome, after `prepare`.
    """

    name: ClassVar[str] = "best_mix"

    def __init__(self, hits: int = 256, samples: int = 16, light_sampling: bool = True) -> None:
        for field, value, least in (("hits", hits, 1), ("samples", samples, 2)):
            if isinstance(value, bool) or not isinstance(value, int) or value < least:
                raise InputError(f"best_mix.{field}", value, f"an integer >= {least}")
        self.hits, self.samples, self.light_sampling = hits, samples, bool(light_sampling)

    def prepare(self, problem: Problem) -> None:
        """Directions at the scene's sample of hits, then the shares."""
        self.problem = problem
        found = proposals_of(problem, problem.dtype)
        if self.light_sampling and not isinstance(problem.integrand.light, ConstantLight):
            found["light"] = LightAt(problem.integrand)  # type: ignore[arg-type]
        generator = torch.Generator().manual_seed(problem.seed)
        count = min(self.hits, len(problem.integrand.hits))  # type: ignore[attr-defined]
        contexts = problem.stream.draw(count, generator, dtype=problem.dtype)
        with torch.no_grad():
            nodes = self._nodes(list(found.values()), contexts, generator)
        self.chosen, used = _choose(list(found), *nodes)
        self.proposals: list[Proposal] = [list(found.values())[k] for k in used]

    def _nodes(
        self, proposals: list[Proposal], contexts: Context, generator: torch.Generator
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Values `[Q, B, C]`, weights `[Q, B]` and log densities `[K, Q, B]`, float64."""
        distributions = [proposal(contexts) for proposal in proposals]
        values, logs = [], []
        for distribution in distributions:
            for u in self.problem.draw(self.samples, contexts, distribution.dimension, generator):
                omega = distribution.sample(u)
                values.append(self.problem.integrand(omega, contexts).double())
                each = [d.log_prob(omega).expand(omega.shape[:-1]).double() for d in distributions]
                logs.append(torch.stack(each))
        log_p = torch.cat(logs, dim=1)
        weight = torch.exp(-torch.logsumexp(log_p, dim=0)) / self.samples
        return torch.cat(values), weight, log_p

    def at(self, contexts: Context) -> Sampler:
        """The strategies with a share, at these hits."""
        distributions = [proposal(contexts) for proposal in self.proposals]
        shares = list(self.chosen.shares.values())
        return MixSampler(self.problem, distributions, shares, contexts, self.chosen.heuristic, self.chosen.model)


def _choose(names: list[str], value: Tensor, weight: Tensor, log_p: Tensor) -> tuple[Chosen, list[int]]:
    """The best shares, heuristic and model, and the numbers of the strategies used."""
    size = torch.linalg.vector_norm((value * weight.unsqueeze(-1)).sum(0), dim=-1)
    size = size.square() + (_DIM * size.mean()).square()
    squared = weight * value.square().sum(-1) / size / len(size)
    convex, _ = balance_fractions(log_p.flatten(1), squared.flatten())
    used = torch.nonzero(convex >= min(_LEAST, float(convex.max()))).flatten()
    fitted = convex[used] / convex[used].sum()
    equal = torch.full_like(fitted, 1 / len(fitted))
    best: tuple[float, Tensor, str, str] | None = None
    tried: dict[str, float] = {}
    for rule in HEURISTICS:
        for model in ("multi", "one"):
            for shares in (fitted, equal):
                found = mis_variance(value, weight, log_p[used], shares, rule, model=model).variance.sum(-1)
                mean = float((found / size).mean())
                tried[f"{rule}, {model}"] = min(mean, tried.get(f"{rule}, {model}", mean))
                if best is None or mean < best[0]:
                    best = mean, shares, rule, model
    assert best is not None
    shares = dict(zip([names[k] for k in used.tolist()], best[1].tolist(), strict=True))
    return Chosen(shares, best[2], best[3], tried), used.tolist()
