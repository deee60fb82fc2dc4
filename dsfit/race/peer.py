"""What a race asks of a peer: prepare once, get ready for contexts, estimate."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from dsfit.context import Context
from dsfit.random import uniform_chunks
from dsfit.scene.integrand import Integrand
from dsfit.streams import ContextStream

CHUNK = 2**15
"""Directions (samples x contexts) that peers hold at once."""


@dataclass(frozen=True)
class Problem:
    """What all peers of a race estimate: `integrand(omega, context) -> [..., C]` over d omega_i, for contexts of a
    stream.

    Attributes:
        integrand: the same implementation for every peer, eager or compiled; `bsdf`, `channels` and `is_even` as in
            `Integrand`. Fits and quadrature that want float64 take `exact`.
        stream: where contexts come from; known to peers, as a renderer's author would know it.
        dtype: of contexts, uniforms and values.
        uniforms: "random" or "sobol" (scrambled, a new scramble for every estimate and context).
        seed: of whatever a peer prepares.
        exact: the integrand in eager float64; left out, `integrand` itself.
    """

    integrand: Integrand
    stream: ContextStream
    dtype: torch.dtype = torch.float32
    uniforms: str = "random"
    seed: int = 1
    exact: Integrand | None = None

    @property
    def model(self) -> Integrand:
        """The integrand to prepare with: float64, with everything an `Integrand` offers."""
        return self.integrand if self.exact is None else self.exact

    def draw(self, samples: int, contexts: Context, dimension: int, generator: torch.Generator) -> Iterator[Tensor]:
        """Uniform numbers `[S, *batch, dimension]` of this race's kind and dtype, in pieces that add up to `samples`
        for every context and hold at most `CHUNK` directions (or one sample of every context)."""
        batch = contexts.batch_shape
        rows = max(1, CHUNK // max(1, batch.numel()))
        return uniform_chunks(
            (samples, *batch), dimension, generator=generator, kind=self.uniforms, rows=rows, dtype=self.dtype
        )


class Sampler(ABC):
    """A peer that is ready for a batch of contexts `[B]`."""

    least: int = 1
    """Fewest samples that `estimate` can do with."""

    @abstractmethod
    def estimate(self, samples: int, generator: torch.Generator) -> Tensor:
        """Unbiased estimates `[B, C]` of the integral in every context, from `samples` evaluations of the integrand
        each; called without gradients."""

    def log_prob(self, omega: Tensor) -> Tensor | None:
        """Log density per steradian `[*points, B]` of every sample at directions `[*points, B, 2]`, where estimates
        are plain means of F / p; None where they are not. With it a race compares what it measures with quadrature."""
        return None


class Peer(ABC):
    """One way of estimating. Everything it does is timed: `prepare` once for a race, `at` once for every batch of
    contexts, `estimate` every time. Options are keyword arguments of the constructor, plain data, checked there
    (`InputError`)."""

    name: ClassVar[str]
    """The name that the registry and configs know it by."""
    per_context: ClassVar[bool] = False
    """Whether `at` works for seconds per context (fits, tables, adaptation), so that a long stream is run on a subset
    and scaled."""
    needs: ClassVar[tuple[str, ...]] = ()
    """Packages beyond dsfit's own that it imports."""
    recorded_seconds: float = 0.0
    """Seconds of preparation spent before (training whose result is loaded from a file); counted as if measured."""

    @abstractmethod
    def prepare(self, problem: Problem) -> None:
        """What is done once for a fibre and its stream of contexts: training, tables shared by all contexts."""

    @abstractmethod
    def at(self, contexts: Context) -> Sampler:
        """What is done for each context `[B]` (in the problem's dtype): tables, adaptation, fits."""
