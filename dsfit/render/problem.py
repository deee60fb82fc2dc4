"""A rendering as a problem of a race, so that its peers render: uniform numbers that stratify whole pixels."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from dsfit.context import Context
from dsfit.errors import InputError, check_choice
from dsfit.race.peer import CHUNK, Problem
from dsfit.render.hits import HitContext, Hits
from dsfit.render.integrand import HairIntegrand
from dsfit.render.pixel_uniforms import SobolPoints, independent, states, to_unit
from dsfit.scene.scattering import Scattering


@dataclass(frozen=True)
class RenderProblem(Problem):
    """`Problem` over the hits that are bound to it.

    What a peer prepares serves all hits of the scene: `bind` exchanges those that `context.hit` counts. `uniforms` is
    "random" or "sobol". Sobol points: one scrambled sequence for every pixel and draw; the pixel's hits, in order, take
    aligned blocks of 2^k >= `samples` points of it, so that with 2^j hits of 2^k samples the pixel as a whole has a
    digital net. A block's first points are taken where `samples` is no power of two.

    Numbers depend on the generator's state, the pixel's name and the hit's rank in its pixel alone: not on tiles.
    """

    def __post_init__(self) -> None:
        check_choice("uniforms", self.uniforms, ("random", "sobol"))
        if not isinstance(self.integrand, HairIntegrand):
            raise InputError("integrand", type(self.integrand).__name__, "a HairIntegrand")
        self.bind(self.integrand.hits, self.integrand.scattering)

    def bind(self, hits: Hits, scattering: Scattering, pixel: Tensor | None = None) -> None:
        """Other hits, their scattering, and a name for each hit's pixel (int64 `[H]`); left out, `hits.pixel`."""
        for integrand in (self.integrand, self.exact):
            if isinstance(integrand, HairIntegrand):
                integrand.bind(hits, scattering)
        name = hits.pixel if pixel is None else pixel
        names, place, count = torch.unique_consecutive(name, return_inverse=True, return_counts=True)
        first = torch.cumsum(count, 0) - count
        rank = torch.arange(len(name)) - first[place]
        object.__setattr__(self, "_layout", (names, place, rank, int(count.max()) if len(count) else 0))

    def draw(self, samples: int, contexts: Context, dimension: int, generator: torch.Generator) -> Iterator[Tensor]:
        """Uniform numbers `[S, *batch, dimension]` in pieces that add up to `samples` for every context; see there.

        Raises:
            InputError: contexts that do not know their hits.
        """
        if not isinstance(contexts, HitContext):
            raise InputError("contexts", type(contexts).__name__, "a HitContext, which knows its hits")
        key = int(torch.randint(2**62, (), generator=generator))
        names, place, rank, most = self._layout  # type: ignore[attr-defined]
        hit = contexts.hit.reshape(-1)
        if len(hit) != len(rank) or not bool((hit == torch.arange(len(hit))).all()):  # not all hits in their order
            place, rank = place[hit], rank[hit]
        rows = max(1, CHUNK // max(1, len(hit)))
        shape = contexts.batch_shape
        if self.uniforms == "random":
            state = states(key, names[place], rank)
            for first in range(0, samples, rows):
                count = min(rows, samples - first)
                yield independent(state, first, count, dimension, self.dtype).reshape(count, *shape, dimension)
            return
        block = (samples - 1).bit_length()
        level = min(rows.bit_length() - 1, block)
        points = SobolPoints(states(key, names), max(1, most) << block, dimension)
        run = points.run(level)[:, place]
        for piece in range(-(-samples >> level)):
            start = points.start((rank << block) + (piece << level), place)
            u = to_unit(run[: samples - (piece << level)] ^ start, self.dtype)
            yield u.reshape(len(u), *shape, dimension)


__all__ = ["RenderProblem"]
