"""What a race asks of a peer: prepare once, get ready for contexts, estimate."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from dsfit.context import Context
from dsfit.scene.integrand import Integrand
from dsfit.streams import ContextStream


@dataclass(frozen=True)
class Problem:
    """What all peers of a race estimate: `integrand(omega, context) -> [..., C]` over d omega_i, for contexts of a
    stream.

    Attributes:
        integrand: the same implementation for every peer.
        stream: where contexts come from; known to peers, as a renderer's author would know it.
        dtype: of contexts, uniforms and values.
        uniforms: "random" or "sobol" (scrambled, a new scramble for every estimate and context).
        seed: of whatever a peer prepares.
    """

    integrand: Integrand
    stream: ContextStream
    dtype: torch.dtype = torch.float32
    uniforms: str = "random"
    seed: int = 1


class Sampler(ABC):
    """A peer that is ready for a batch of contexts `[B]`."""

    @abstractmethod
    def estimate(self, samples: int, generator: torch.Generator) -> Tensor:
        """Unbiased estimates `[B, C]` of the integral in every context, from `samples` evaluations of the integrand
        each."""


class Peer(ABC):
    """One way of estimating. Everything it does is timed: `prepare` once for a race, `at` once for every batch of
    contexts, `estimate` every time."""

    name: ClassVar[str]

    @abstractmethod
    def prepare(self, problem: Problem) -> None:
        """What is done once for a fibre and its stream of contexts: training, tables shared by all contexts."""

    @abstractmethod
    def at(self, contexts: Context) -> Sampler:
        """What is done for each context `[B]`: tables, adaptation, fits."""
