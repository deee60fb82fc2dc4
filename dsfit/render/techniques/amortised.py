"""The amortised mixture with the grid's hints at every hit."""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING, Any, ClassVar

import torch

from dsfit.context import Context
from dsfit.errors import InputError
from dsfit.proposals.amortised import AmortisedProposal
from dsfit.proposals.base import Proposal
from dsfit.race.density import DensitySampler
from dsfit.race.peer import Problem, Sampler
from dsfit.race.peers import amortised as race

if TYPE_CHECKING:
    from dsfit.kernels import HairKernel


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
        """Train, load or take the mixture; then its kernel, if the fibre has tables."""
        self.problem = problem
        self.kernel = self._kernel(problem)
        self.proposal = self._mixture(problem) if self.kernel is None else self.kernel.proposal()

    def _kernel(self, problem: Problem) -> HairKernel | None:
        from dsfit.kernels import HairKernel
        from dsfit.render.scene import kernel_of

        if problem.dtype != torch.float32:
            return None
        shared = kernel_of(problem.model.bsdf)
        if isinstance(shared, str) or not (self.train or self.file or self.training or self.given):
            return None if isinstance(shared, str) else shared
        return HairKernel(problem.model.bsdf, self._trained(problem))

    def _mixture(self, problem: Problem) -> Proposal:
        return copy.deepcopy(self._trained(problem)).to(problem.dtype)

    def _trained(self, problem: Problem) -> Proposal:
        return self._proposal(problem) if self.given is None else self.given

    def at(self, contexts: Context) -> Sampler:
        """The mixtures of these hits."""
        return DensitySampler(self.problem, self.proposal(contexts), contexts)
