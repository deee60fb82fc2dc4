"""The chapter's proposals: one alone, or all in equal shares by a MIS heuristic."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import ClassVar

import torch

from dsfit.context import Context
from dsfit.errors import InputError, as_number, check_choice
from dsfit.mis.heuristics import HEURISTICS
from dsfit.proposals.base import Proposal
from dsfit.proposals.chapter import chapter_proposals
from dsfit.race.mixed import mis_sampler
from dsfit.race.peer import Peer, Problem, Sampler

MODELS = ("multi", "one")


def proposals_of(problem: Problem, dtype: torch.dtype) -> dict[str, Proposal]:
    """The chapter's proposals for this fibre by name, with nothing to learn, in `dtype`."""
    found = chapter_proposals(problem.model.bsdf, learnable=False)
    return {name: copy.deepcopy(proposal).to(dtype) for name, proposal in found.items()}


def named(found: dict[str, Proposal], names: Sequence[str], field: str) -> list[Proposal]:
    """The proposals of these names.

    Raises:
        InputError: a name that is none of them.
    """
    for name in names:
        if name not in found:
            raise InputError(field, name, "one of " + ", ".join(found))
    return [found[name] for name in names]


class Single(Peer):
    """One proposal, and the uniform sphere with the share `defensive`: `M_R` alone is the chapter's figure 2."""

    name: ClassVar[str] = "single"

    def __init__(self, proposal: str = "M_R", defensive: float = 0.0) -> None:
        self.proposal = proposal
        self.defensive = as_number("single.defensive", defensive, 0.0, 1.0, open_high=True)

    def prepare(self, problem: Problem) -> None:
        """Make the proposals."""
        found = proposals_of(problem, problem.dtype)
        names = [self.proposal, "uniform"] if self.defensive else [self.proposal]
        self.problem, self.proposals = problem, named(found, names, "single.proposal")

    def at(self, contexts: Context) -> Sampler:
        """Averages at the viewing inclination, where the law asks for them."""
        shares = [1 - self.defensive, self.defensive] if self.defensive else [1.0]
        return mis_sampler(self.problem, self.proposals, shares, contexts, "balance", "one")


class Chapter(Peer):
    """The proposals of the chapter (or those named) in equal shares.

    Args:
        heuristic: "balance", "power", "maximum", "cutoff" or "optimal".
        model: "multi": every proposal gets its samples, so there are at least as many samples as proposals; "one":
            every sample chooses its proposal.
        proposals: names; left out, all of them.
    """

    name: ClassVar[str] = "chapter"

    def __init__(
        self, heuristic: str = "balance", model: str = "multi", proposals: Sequence[str] | None = None
    ) -> None:
        self.heuristic = check_choice("chapter.heuristic", heuristic, tuple(HEURISTICS))
        self.model = check_choice("chapter.model", model, MODELS)
        if proposals is not None and not list(proposals):
            raise InputError("chapter.proposals", proposals, "at least one name")
        self.names = None if proposals is None else list(proposals)

    def prepare(self, problem: Problem) -> None:
        """Make the proposals."""
        found = proposals_of(problem, problem.dtype)
        self.problem = problem
        self.proposals = named(found, self.names or list(found), "chapter.proposals")

    def at(self, contexts: Context) -> Sampler:
        """Averages at the viewing inclination, where the laws ask for them."""
        shares = [1 / len(self.proposals)] * len(self.proposals)
        return mis_sampler(self.problem, self.proposals, shares, contexts, self.heuristic, self.model)
