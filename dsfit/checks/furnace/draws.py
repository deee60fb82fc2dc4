"""Directions drawn from a proposal, with what it said about them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from dsfit.checks.furnace.nodes import IntegrandLike
from dsfit.context import Context
from dsfit.errors import InputError
from dsfit.frame import HALF_PI
from dsfit.proposals.base import Distribution, Proposal
from dsfit.proposals.uniform import UniformSphere
from dsfit.random import uniforms

_SLACK = 1e-12


@dataclass(frozen=True)
class Draws:
    """Samples of one context from `(1 - beside) p + beside / (4 pi)`.

    Attributes:
        context: where they were drawn.
        omega: directions `[N, 2]`; invalid ones (NaN, infinite, |theta| > pi/2) are left out and counted.
        log_returned: the log density that the sampler returned with the direction; for directions of the uniform
            sphere, and where the sampler returned none, that of `log_prob`. `[N]`
        log_evaluated: `log_prob` of the direction, `[N]`.
        value: the integrand `[N, C]`.
        own: whether the proposal drew it, `[N]`.
        beside: share of the uniform sphere.
        samples: how many were asked for.
        invalid: how many of them were no directions.
    """

    context: Context
    omega: Tensor
    log_returned: Tensor
    log_evaluated: Tensor
    value: Tensor
    own: Tensor
    beside: float
    samples: int
    invalid: int

    def weights(self) -> Tensor:
        """`f / ((1 - beside) p + beside / (4 pi))`, `[N, C]`, with the density that the sampler returned."""
        return self.value / self.mixed(torch.exp(self.log_returned))[:, None]

    def mixed(self, density: Tensor) -> Tensor:
        """`(1 - beside) p + beside / (4 pi)`, what the samples are drawn with where the proposal has density p."""
        return (1 - self.beside) * density + self.beside / (4 * math.pi)


def draw(
    integrand: IntegrandLike,
    proposal: Proposal,
    context: Context,
    samples: int,
    *,
    generator: torch.Generator,
    beside: float = 0.0,
) -> Draws:
    """Independent samples; each is the proposal's with probability `1 - beside`, else a uniform direction.

    With `beside` = 1/2 every weight is at most 8 pi f, whatever the proposal's tails and support, while half of the
    directions, and nearly all of the weight where p is large, are still its own: an error of sampler or density shows.

    Raises:
        InputError: the context is a batch, samples < 1, or beside not in [0, 1].
    """
    if context.batch_shape != ():
        raise InputError("context", tuple(context.batch_shape), "a single context, of batch shape ()")
    if samples < 1:
        raise InputError("samples", samples, "an integer >= 1")
    if not 0 <= beside <= 1:
        raise InputError("beside", beside, "a number in [0, 1]")
    with torch.no_grad():
        distribution = proposal(context)
        chosen = uniforms((samples,), 1, generator=generator, dtype=context.dtype)[:, 0] >= beside
        count = int(chosen.sum())
        parts = [_sampled(distribution, count, context, generator)] if count else []
        if count < samples:
            sphere, _ = _sampled(UniformSphere()(context), samples - count, context, generator)
            parts.append((sphere, distribution.log_prob(sphere)))
        omega, returned = (torch.cat(x) for x in zip(*parts, strict=True))
        own = torch.arange(samples) < count
        good = omega.isfinite().all(-1) & (omega[:, 0].abs() <= HALF_PI + _SLACK)
        omega, returned, own = omega[good], returned[good], own[good]
        evaluated = distribution.log_prob(omega)
        return Draws(
            context=context,
            omega=omega,
            log_returned=returned,
            log_evaluated=evaluated,
            value=integrand(omega, context),
            own=own,
            beside=beside,
            samples=samples,
            invalid=samples - int(good.sum()),
        )


def _sampled(
    distribution: Distribution, count: int, context: Context, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    u = uniforms((count,), distribution.dimension, generator=generator, dtype=context.dtype)
    return distribution.sample_with_log_prob(u)
