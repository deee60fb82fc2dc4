"""The amortised proposal in compiled kernels: drawn, weighed and evaluated in one pass."""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from torch import Tensor

from dsfit.context import Context
from dsfit.errors import InputError
from dsfit.race.peer import Problem, Sampler
from dsfit.race.peers.amortised import Amortised


class Kernel(Amortised):
    """As `amortised`, with directions, densities and values from `dsfit.kernels.HairKernel`, in float32, all in one
    call: the BSDF by the kernel that the race's compiled integrand has, whatever the race's implementation.

    Code that an earlier kernel of the same layout had compiled is found in the cache, and is not counted again.
    """

    name: ClassVar[str] = "kernel"

    def prepare(self, problem: Problem) -> None:
        """As `amortised`, then compile."""
        from dsfit.kernels import HairKernel

        if problem.dtype != torch.float32:
            raise InputError("race.dtype", problem.dtype, "float32 for the peer 'kernel'")
        super().prepare(problem)
        self.radiance = problem.model.light.radiance.to(torch.float32)
        self.kernel = HairKernel(problem.model.bsdf, self.proposal)

    def at(self, contexts: Context) -> Sampler:
        """What depends on the context alone."""
        return _KernelSampler(self, contexts)


class _KernelSampler(Sampler):
    def __init__(self, peer: Kernel, contexts: Context) -> None:
        self.peer, self.contexts = peer, contexts
        self.ready: Any = peer.kernel.prepare(contexts.theta_r, contexts.n, contexts.v)

    def estimate(self, samples: int, generator: torch.Generator) -> Tensor:
        total: Tensor | float = 0.0
        for u in self.peer.problem.draw(samples, self.contexts, 3, generator):
            _, _, pdf, value = self.peer.kernel.sample_eval(self.ready, u)
            total = total + (value / pdf.unsqueeze(-1)).sum(0, dtype=torch.float64)
        return torch.as_tensor(total) * self.peer.radiance / samples

    def log_prob(self, omega: Tensor) -> Tensor | None:
        return self.peer.kernel.proposal()(self.contexts).log_prob(omega.to(self.contexts.dtype))
