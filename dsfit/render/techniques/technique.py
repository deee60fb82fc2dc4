"""A technique: a peer of the race made ready for a scene."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import torch

from dsfit.errors import check_choice
from dsfit.race.peer import Peer, Sampler
from dsfit.render.hits import HitContext, Hits
from dsfit.render.problem import RenderProblem
from dsfit.streams import ContextStream

if TYPE_CHECKING:
    from dsfit.render.scene import RenderScene

PREPARED_WITH = 1024
"""Hits that techniques prepare with."""


class HitStream(ContextStream):
    """The hits of a picture as a stream of contexts: random ones of a sample that is bound to the problem."""

    def __init__(self, contexts: HitContext) -> None:
        super().__init__(n_max=max(1.0, float(contexts.n.max())))
        object.__setattr__(self, "contexts", contexts)

    def draw(self, count: int, generator: torch.Generator, *, dtype: torch.dtype = torch.float64) -> HitContext:
        """`count` of them, without repetition while there are enough."""
        contexts: HitContext = self.contexts  # type: ignore[attr-defined]
        rounds = -(-count // len(contexts))
        order = torch.cat([torch.randperm(len(contexts), generator=generator) for _ in range(rounds)])
        return contexts[order[:count]].to(dtype)


class Technique:
    """A peer, the kind of its uniform numbers, and what it prepared for one scene.

    Args:
        name: for messages.
        peer: how directions are drawn and combined.
        uniforms: "random" or "sobol".
        seed: of what is prepared.

    Attributes:
        prepare_seconds: CPU seconds of the preparation, that spent before on what was loaded included; 0 before.
    """

    def __init__(self, name: str, peer: Peer, *, uniforms: str = "random", seed: int = 1) -> None:
        self.name, self.peer, self.seed = name, peer, seed
        self.uniforms = check_choice("uniforms", uniforms, ("random", "sobol"))
        self.scene: RenderScene | None = None
        self.prepare_seconds = 0.0

    def prepare(self, scene: RenderScene) -> Technique:
        """Make ready for a scene, if it is not; what is prepared serves all of its tiles. Random numbers come from the
        seed alone."""
        if self.scene is scene:
            return self
        start = time.process_time()
        generator = torch.Generator().manual_seed(self.seed)
        hits = scene.sample_hits(PREPARED_WITH, generator)
        self.problem = RenderProblem(
            scene.integrand(hits),
            HitStream(scene.contexts(hits)),
            dtype=scene.dtype,
            uniforms=self.uniforms,
            seed=self.seed,
            exact=scene.integrand(hits, exact=True),
        )
        self.peer.prepare(self.problem)
        self.prepare_seconds = time.process_time() - start + self.peer.recorded_seconds
        self.scene = scene
        return self

    @torch.no_grad()
    def at(self, hits: Hits, contexts: HitContext, pixel: torch.Tensor | None = None) -> Sampler:
        """The sampler of these hits, whose pixels have the names `pixel`; earlier samplers are no longer valid."""
        assert self.scene is not None, "prepare first"
        self.problem.bind(hits, self.scene.scattering(hits), pixel)
        return self.peer.at(contexts)
