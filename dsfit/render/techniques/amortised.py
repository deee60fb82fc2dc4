"""The amortised mixture with the grid's hints at every hit."""

from __future__ import annotations

import copy
from typing import Any, ClassVar

import torch

from dsfit.context import Context
from dsfit.errors import InputError
from dsfit.proposals.amortised import AmortisedProposal
from dsfit.proposals.base import Proposal
from dsfit.race.density import DensitySampler
from dsfit.race.peer import Problem, Sampler
from dsfit.race.peers import amortised as race


class Amortised(race.Amortised):
    """One mixture for all hits, shaped by theta_r and the hints (n, v) of each; drawn by the compiled kernel where
    there is one.

    Args:
        proposal: a trained `AmortisedProposal` of the scene's BSDF; left out, see the others.
        file: one saved by `dsfit.save_proposal`.
        file_seconds: how long that was trained; counted as preparation.
        train: whether to train here by `dsfit.amortise`; else the mixture is as its closed forms start it.
        training: keyword arguments of `dsfit.amortise`, or of the `AmortisedProposal` where nothing is trained.
    """

    name: ClassVar[str] = "amortised"

    def __init__(
        self,
        proposal: AmortisedProposal | None = None,
        file: str | None = None,
        file_seconds: float = 0.0,
        train: bool = False,
        training: dict[str, Any] | None = None,
    ) -> None:
        super().__init__(train, file, None if file is None else file_seconds, training)
        if proposal is not None and not isinstance(proposal, AmortisedProposal):
            raise InputError("amortised.proposal", type(proposal).__name__, "a dsfit AmortisedProposal")
        self.given = proposal

    def prepare(self, problem: Problem) -> None:
        """Train, load or take the mixture; then its kernel."""
        self.problem = problem
        self.mixture = self._proposal(problem) if self.given is None else self.given
        self.proposal = self._drawn(problem)

    def _drawn(self, problem: Problem) -> Proposal:
        from dsfit.kernels import HairKernel

        if problem.dtype == torch.float32:
            try:
                return HairKernel(problem.model.bsdf, self.mixture).proposal()
            except InputError:  # a fibre without tables
                pass
        return copy.deepcopy(self.mixture).to(problem.dtype)

    def at(self, contexts: Context) -> Sampler:
        """The mixtures of these hits."""
        return DensitySampler(self.problem, self.proposal(contexts), contexts)
