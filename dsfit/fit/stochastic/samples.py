"""Directions drawn for a fit, and what a (noisy) integrand answered there: all that is ever known of it.

`|F|^2` enters the second moment `M(p) = int |F|^2 / p domega`, and a noisy answer `f` with `E f = F` has more of it
than F: `E|f|^2 = |F|^2 + tr Cov f`. So the number of draws decides which integral is meant:

    draws = 1:  h = |f|^2      E h = |F|^2 + tr Cov f: the second moment of a renderer that takes one noisy answer per
                               direction, as a path tracer does; its best density is sqrt(E|f|^2), which sends more
                               samples where the light is noisier
    draws = 2:  h = f_1 . f_2  E h = |F|^2: the second moment of a renderer that knows the light; two independent
                               answers per direction, and more noise

Without noise the two are the same. Logarithms throughout, so that no magnitude of F over- or underflows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from dsfit.context import Context
from dsfit.errors import InputError, check_finite
from dsfit.frame import HALF_PI
from dsfit.proposals.base import Distribution
from dsfit.proposals.mixture import MixtureDistribution
from dsfit.proposals.uniform import UniformSphereDistribution
from dsfit.random import uniforms

Radiance = Callable[[Tensor, Context], Tensor]
"""`radiance(omega [*samples, *batch, 2], context) -> [*samples, *batch, C]`, with independent noise at each call."""


@dataclass(frozen=True)
class Draws:
    """Samples of one law, float64.

    Attributes:
        omega: directions `[N, *batch, 2]`.
        log_q: log density of the law that they were drawn from, per steradian, `[N, *batch]`.
        log_square: log h `[N, *batch]`, see the module's text; -inf where h = 0.
        log_length: log |f| `[N, *batch]`, of the mean length of two draws.
        evaluations: calls of the integrand times directions.
    """

    omega: Tensor
    log_q: Tensor
    log_square: Tensor
    log_length: Tensor
    evaluations: int


def sampling_law(proposal: nn.Module, context: Context, share: float) -> Distribution:
    """`q = (1 - share) p + share / (4 pi)`: finds light where p has none, and keeps `p / q` below `1 / (1 - share)`."""
    distribution: Distribution = proposal(context)
    if share == 0:
        return distribution
    weights = torch.log(torch.tensor([1 - share, share], dtype=context.dtype, device=context.device))
    return MixtureDistribution([distribution, UniformSphereDistribution(context)], weights)


@torch.no_grad()
def draw(
    radiance: Radiance,
    context: Context,
    law: Distribution,
    count: int,
    generator: torch.Generator,
    *,
    draws: int = 1,
    points: str = "sobol",
) -> Draws:
    """`count` directions of `law` for each context of the batch, and the integrand there.

    Args:
        radiance: asked in the context's dtype; see `Radiance`.
        context: `[*batch]`; the law belongs to the same context in float64.
        points: kind of uniform numbers, see `dsfit.random.uniforms`.
        draws: 1 or 2, see the module's text.

    Raises:
        InputError: answers that are not finite, of the wrong shape, or, with two draws, of negative product.
    """
    shape = (count, *context.batch_shape)
    u = uniforms(shape, law.dimension, generator=generator, kind=points, device=context.device)
    omega = law.sample(u).to(context.dtype)  # rounded first: the density must be that of the direction asked for
    exact = omega.to(torch.float64)
    exact = torch.stack([exact[..., 0].clamp(-HALF_PI, HALF_PI), exact[..., 1]], dim=-1)
    log_square, log_length = observe(radiance, omega, context, draws)
    return Draws(exact, law.log_prob(exact), log_square, log_length, draws * log_square.numel())


@torch.no_grad()
def observe(radiance: Radiance, omega: Tensor, context: Context, draws: int = 1) -> tuple[Tensor, Tensor]:
    """log h and log |f| `[...]` at directions `[..., 2]`; see `draw`."""
    values = [_ask(radiance, omega, context) for _ in range(draws)]
    scale = torch.stack([value.abs().amax() for value in values]).amax()
    scale = torch.where(scale > 0, scale, 1.0)
    values = [value / scale for value in values]
    square = (values[0] * values[-1]).sum(-1)
    if bool((square < 0).any()):
        raise InputError("integrand", float(square.min() * scale**2), "radiance whose draws have no negative product")
    length = torch.stack([torch.linalg.vector_norm(value, dim=-1) for value in values]).mean(0)
    return torch.log(square) + 2 * torch.log(scale), torch.log(length) + torch.log(scale)


def _ask(radiance: Radiance, omega: Tensor, context: Context) -> Tensor:
    value = radiance(omega, context)
    if not isinstance(value, Tensor) or value.shape[:-1] != omega.shape[:-1]:
        shape = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
        raise InputError("integrand", shape, f"a tensor [..., C] for directions {tuple(omega.shape)}")
    return check_finite("integrand", value.detach().to(torch.float64))
