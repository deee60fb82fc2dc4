"""The structured family as it starts at each context: the integrand's own lobes from their moments."""

from __future__ import annotations

from typing import ClassVar

import torch

from dsfit.context import Context
from dsfit.errors import as_number
from dsfit.proposals.structured import StructuredProposal, azimuth_tables
from dsfit.race.density import DensitySampler
from dsfit.race.peer import Peer, Problem, Sampler
from dsfit.race.samplers import EachSampler


class Structured(Peer):
    """`StructuredProposal(bsdf, context)`, unfitted; `defensive` is the share of the uniform sphere."""

    name: ClassVar[str] = "structured"
    per_context: ClassVar[bool] = True

    def __init__(self, defensive: float = 0.001) -> None:
        self.defensive = as_number("structured.defensive", defensive, 0.0, 1.0, open_low=True, open_high=True)

    def prepare(self, problem: Problem) -> None:
        """Tables of the fibre's azimuths."""
        self.problem = problem
        for scattered in (False, True):
            azimuth_tables(problem.model.bsdf, scattered)

    def at(self, contexts: Context) -> Sampler:
        """The start of every context."""
        return EachSampler([self._one(contexts[k : k + 1]) for k in range(len(contexts))])

    def proposal_at(self, context: Context) -> StructuredProposal:
        """The proposal of one context, float64."""
        return StructuredProposal(self.problem.model.bsdf, context.to(torch.float64), self.defensive)

    def _one(self, context: Context) -> Sampler:
        proposal = self.proposal_at(context.reshape(())).requires_grad_(False).to(self.problem.dtype)
        return DensitySampler(self.problem, proposal(context), context)
