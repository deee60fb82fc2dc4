"""The structured family fitted to each context."""

from __future__ import annotations

from typing import ClassVar

import torch

from dsfit.context import Context
from dsfit.errors import InputError
from dsfit.proposals.structured import StructuredProposal
from dsfit.race.peer import Problem
from dsfit.race.peers.structured import Structured


class Fitted(Structured):
    """Levenberg-Marquardt on the excess at each context, from the structured start, on its own quadrature nodes.

    Args:
        defensive: share of the uniform sphere.
        max_steps: of the solver; left out, its own.
    """

    name: ClassVar[str] = "fitted"
    needs: ClassVar[tuple[str, ...]] = ("jax", "optimistix")

    def __init__(self, defensive: float = 0.001, max_steps: int | None = None) -> None:
        super().__init__(defensive)
        if max_steps is not None and (isinstance(max_steps, bool) or not isinstance(max_steps, int) or max_steps < 1):
            raise InputError("fitted.max_steps", max_steps, "an integer >= 1")
        self.max_steps = max_steps

    def prepare(self, problem: Problem) -> None:
        """Tables of the fibre's azimuths."""
        from dsfit.fit.optimistix_solvers import least_squares  # noqa: F401  (imported here, not during a fit)

        super().prepare(problem)

    def proposal_at(self, context: Context) -> StructuredProposal:
        """The fitted proposal of one context, float64."""
        from dsfit.fit.fit import fit

        start, context = super().proposal_at(context), context.to(torch.float64)
        options = {} if self.max_steps is None else {"max_steps": self.max_steps}
        found = fit(start, self.problem.model, context, "excess", "optimistix.lm", seed=self.problem.seed, **options)
        return found.proposal
