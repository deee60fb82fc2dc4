"""Uniform directions on the sphere."""

from __future__ import annotations

from typing import ClassVar

from dsfit.context import Context
from dsfit.proposals.uniform import UniformSphere
from dsfit.race.density import DensitySampler
from dsfit.race.peer import Peer, Problem, Sampler


class Uniform(Peer):
    """p = 1 / (4 pi); nothing to prepare."""

    name: ClassVar[str] = "uniform"

    def prepare(self, problem: Problem) -> None:
        """Nothing to do."""
        self.problem, self.proposal = problem, UniformSphere()

    def at(self, contexts: Context) -> Sampler:
        """Nothing that depends on the context."""
        return DensitySampler(self.problem, self.proposal(contexts), contexts)
