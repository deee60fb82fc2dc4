"""Light sampling, alone or beside another peer."""

from __future__ import annotations

from typing import Any, ClassVar

from dsfit.context import Context
from dsfit.errors import as_number, check_choice
from dsfit.mis.heuristics import HEURISTICS
from dsfit.race.density import DensitySampler
from dsfit.race.peer import Peer, Problem, Sampler
from dsfit.render.techniques.mixed import LightAt, with_light


class LightAlone(Peer):
    """Directions by the light's radiance as the hit sees it; nothing to prepare."""

    name: ClassVar[str] = "light"

    def prepare(self, problem: Problem) -> None:
        """Nothing to do."""
        self.problem, self.proposal = problem, LightAt(problem.integrand)  # type: ignore[arg-type]

    def at(self, contexts: Context) -> Sampler:
        """The light as these hits see it."""
        return DensitySampler(self.problem, self.proposal(contexts), contexts)


class WithLight(Peer):
    """Any peer with a share of its samples for light sampling.

    Args:
        peer: what the other samples are drawn from.
        share: of light sampling, in (0, 1).
        rule: heuristic that combines the two, if the peer has one density; sets of strategies keep theirs, with light
            as one more. Not "optimal" for a single density.
        model: "multi" or "one", likewise.
    """

    name: ClassVar[str] = "with light"

    def __init__(self, peer: Peer, share: float, rule: Any = "balance", model: str = "multi") -> None:
        self.peer, self.per_context = peer, peer.per_context  # type: ignore[misc]
        self.share = as_number("light", share, 0.0, 1.0, open_low=True, open_high=True)
        self.rule = check_choice("light_heuristic", rule, tuple(k for k in HEURISTICS if k != "optimal"))
        self.model = check_choice("light_model", model, ("multi", "one"))

    @property
    def recorded_seconds(self) -> float:  # type: ignore[override]
        return self.peer.recorded_seconds

    def prepare(self, problem: Problem) -> None:
        """What the peer prepares."""
        self.peer.prepare(problem)
        self.problem, self.light = problem, LightAt(problem.integrand)  # type: ignore[arg-type]

    def at(self, contexts: Context) -> Sampler:
        """The peer's sampler with light as one more strategy."""
        sampler = self.peer.at(contexts)
        return with_light(sampler, self.problem, self.light, self.share, contexts, self.rule, self.model)


__all__ = ["LightAlone", "WithLight"]
