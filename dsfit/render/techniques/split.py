"""Two strategies with a share of the samples that differs from hit to hit, in numbers fixed beforehand."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dsfit.kernels.adapters import KernelDistribution
from dsfit.proposals.base import Distribution
from dsfit.proposals.mixture import log_sum_exp
from dsfit.race.peer import CHUNK, Problem, Sampler
from dsfit.render.hits import HitContext
from dsfit.render.techniques.mixed import LightAt

_HELD = 2**18
"""Uniform numbers' directions that are held at once."""


@dataclass(frozen=True)
class _Part:
    """Hits `index` that give `light` of their samples to light, with share `share` of it."""

    index: Tensor
    light: int
    share: float
    contexts: HitContext
    lobes: KernelDistribution | None
    lit: Distribution | None


class SplitSampler(Sampler):
    """`1/S (sum_b F / p + sum_l F / p)`, p = (1 - c) p_lobes + c p_light: of the S samples of a hit m are drawn from
    the light, the last ones, and the others from the lobes. m is c S, rounded at random to a neighbour with mean c S
    where that is no whole number: so the estimate is unbiased, and where it is whole, choosing adds no variance.

    What a strategy with share 0 draws and what its density is are not asked for.

    Args:
        problem: the integrand and the kind of uniform numbers.
        lobes: the mixtures of all hits.
        light: as the hits see it; at hits with c = 1 the only strategy.
        levels: the few different shares that there may be, whatever the hits: numbers must not depend on the tile.
        choice: of every hit, `[H]` int64 into the levels.
        contexts: `[H]`.
    """

    def __init__(
        self, problem: Problem, lobes: KernelDistribution, light: LightAt, levels: Sequence[float], choice: Tensor,
        contexts: HitContext,
    ) -> None:  # fmt: skip
        self.problem, self.lobes, self.light, self.contexts = problem, lobes, light, contexts
        self.levels, self.choice = list(levels), choice
        self._kept: tuple[int, list[_Part]] | None = None

    def estimate(self, samples: int, generator: torch.Generator) -> Tensor:
        parts = self._parts(samples, generator)
        dimension = max(self.lobes.dimension, self.light.dimension)
        total = torch.zeros(len(self.choice), self.problem.integrand.channels, dtype=torch.float64)
        first = 0
        for u in self._drawn(samples, dimension, generator):
            for part in parts:
                rest = min(max(samples - part.light - first, 0), len(u))
                whole = u if len(parts) == 1 else u[:, part.index]
                found = self._summed(part, part.lobes, whole[:rest]) + self._summed(part, part.lit, whole[rest:])
                total[part.index] += found
            first += len(u)
        return total / samples

    def _drawn(self, samples: int, dimension: int, generator: torch.Generator) -> Iterator[Tensor]:
        """The problem's uniform numbers in pieces that are worth sharing out."""
        held: list[Tensor] = []
        for u in self.problem.draw(samples, self.contexts, dimension, generator):
            held.append(u)
            if sum(x[..., 0].numel() for x in held) >= _HELD:
                yield torch.cat(held)
                held = []
        if held:
            yield torch.cat(held)

    def _summed(self, part: _Part, own: Distribution | None, u: Tensor) -> Tensor:
        """Sum of F / p over directions by one of the part's strategies, float64 `[H, C]`."""
        total = torch.zeros((), dtype=torch.float64)
        if not len(u):
            return total
        assert own is not None
        other, share = (part.lit, 1 - part.share) if own is part.lobes else (part.lobes, part.share)
        for some in u.split(max(1, CHUNK // u.shape[1])):
            omega, log_p = own.sample_with_log_prob(some)
            value = self.problem.integrand(omega, part.contexts)
            p = share * torch.exp(log_p)
            if other is not None:
                p = p + (1 - share) * torch.exp(other.log_prob(omega))
            total = total + torch.where(value == 0, 0.0, value / p.unsqueeze(-1)).sum(0, dtype=torch.float64)
        return total

    def _parts(self, samples: int, generator: torch.Generator) -> list[_Part]:
        """Hits with equal numbers of light samples; kept while nothing about them is random."""
        if self._kept is not None and self._kept[0] == samples:
            return self._kept[1]
        counts = torch.tensor(self.levels, dtype=torch.float64) * samples
        whole = bool((counts == counts.floor()).all())
        found: list[_Part] = []
        more = torch.zeros_like(self.choice, dtype=torch.bool)
        if not whole:
            u = next(iter(self.problem.draw(1, self.contexts, 1, generator)))[0, :, 0]
            more = u < (counts - counts.floor())[self.choice]
        for k, share in enumerate(self.levels):
            for extra in (0, 1):
                index = torch.nonzero((self.choice == k) & (more == bool(extra))).squeeze(-1)
                if len(index):
                    found.append(self._part(index, int(counts[k]) + extra, share))
        self._kept = (samples, found) if whole else None
        return found

    def _part(self, index: Tensor, light: int, share: float) -> _Part:
        contexts = self.contexts[index]
        lobes = self.lobes.taken(index) if share < 1 else None
        return _Part(index, light, share, contexts, lobes, self.light(contexts) if share > 0 else None)

    @property
    def shares(self) -> Tensor:
        """Of lobes and light at every hit, `[2, H]`."""
        light = self.contexts.n.new_tensor(self.levels)[self.choice]
        return torch.stack([1 - light, light])

    def log_prob(self, omega: Tensor) -> Tensor:
        """Of the mixture."""
        logs = torch.stack([d.log_prob(omega) for d in (self.lobes, self.light(self.contexts))], dim=-1)
        return log_sum_exp(logs + torch.log(self.shares).movedim(0, -1))


class ChosenSampler(Sampler):
    """One of two samplers, by how many samples are asked for at once.

    Args:
        few: for less than `least` samples.
        many: makes the one for more; called when that is needed first.
        least: may be infinite.
    """

    def __init__(self, few: Sampler, many: Callable[[], SplitSampler], least: float) -> None:
        self.few, self.boundary = few, least
        self._many = many
        self._made: SplitSampler | None = None

    @property
    def many(self) -> SplitSampler:
        """The sampler for many samples."""
        if self._made is None:
            self._made = self._many()
        return self._made

    def estimate(self, samples: int, generator: torch.Generator) -> Tensor:
        return (self.few if samples < self.boundary else self.many).estimate(samples, generator)
