"""What the solvers of a stochastic fit share: the proposal under work, the light, the contexts, the randomness."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from torch import nn

from dsfit.context import Context
from dsfit.fit.proposal_problem import Parameters
from dsfit.fit.stochastic.samples import Draws, Radiance, draw, sampling_law
from dsfit.streams import ContextStream


class Progress(NamedTuple):
    """What is known of the proposal after `step` steps, from samples that it was not fitted to; the mean over contexts.

    Attributes:
        step: steps taken before these samples were drawn.
        evaluations: of the integrand, these samples included.
        excess, error: `M / N^2 - 1` with standard error, see `estimates`.
        seconds: since the fit began.
    """

    step: int
    evaluations: int
    excess: float
    error: float
    seconds: float


@dataclass
class Setting:
    """One fit.

    Attributes:
        work: the proposal under work, float64.
        radiance: the integrand, or what estimates it.
        contexts: `[B]` in the dtype that the integrand is asked in, or a stream of contexts.
        samples: directions per step and context.
        per_step: contexts per step, if they come from a stream.
        share: defensive share of the law that directions are drawn from.
        draws: of the integrand per direction, see `samples`.
        generator: the only source of randomness but for the integrand's own.
        evaluations: so far.
        lit: whether any answer so far was not zero.
    """

    work: nn.Module
    radiance: Radiance
    contexts: Context | ContextStream
    samples: int
    per_step: int
    share: float
    draws: int
    generator: torch.Generator
    evaluations: int = 0
    lit: bool = False
    parameters: Parameters = field(init=False)

    def __post_init__(self) -> None:
        self.parameters = Parameters(self.work)

    def next_contexts(self) -> Context:
        """The contexts of the next step `[B]`."""
        if isinstance(self.contexts, Context):
            return self.contexts
        return self.contexts.draw(self.per_step, self.generator)

    def draw(self, context: Context, count: int | None = None) -> Draws:
        """Fresh samples of the proposal as it is now, with its defensive share."""
        with torch.no_grad():
            law = sampling_law(self.work, context.to(torch.float64), self.share)
        count = self.samples if count is None else count
        drawn = draw(self.radiance, context, law, count, self.generator, draws=self.draws)
        self.evaluations += drawn.evaluations
        self.lit = self.lit or bool((drawn.log_square > -math.inf).any())
        return drawn

    def state(self) -> dict[str, Any]:
        """Parameters, randomness and counts."""
        return {
            "y": self.parameters.vector(self.work),
            "generator": self.generator.get_state(),
            "evaluations": self.evaluations,
            "lit": self.lit,
        }

    def load(self, state: dict[str, Any]) -> None:
        """Go on from there."""
        self.parameters.assign(self.work, state["y"])
        self.generator.set_state(state["generator"])
        self.evaluations, self.lit = state["evaluations"], state["lit"]
