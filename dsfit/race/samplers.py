"""Samplers made of samplers."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from dsfit.race.peer import Sampler


class EachSampler(Sampler):
    """One sampler for each context, of batch shape `[1]`, run one after the other."""

    def __init__(self, samplers: Sequence[Sampler]) -> None:
        self.samplers = list(samplers)
        self.least = max(sampler.least for sampler in self.samplers)

    def estimate(self, samples: int, generator: torch.Generator) -> Tensor:
        return torch.cat([sampler.estimate(samples, generator) for sampler in self.samplers])

    def log_prob(self, omega: Tensor) -> Tensor | None:
        found = [sampler.log_prob(omega[..., k : k + 1, :]) for k, sampler in enumerate(self.samplers)]
        return None if any(x is None for x in found) else torch.cat(found, dim=-1)
