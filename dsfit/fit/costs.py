"""Measured cost of a sample of a mixture, for the objective `variance_cost`."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from dsfit.context import Context
from dsfit.errors import InputError


@dataclass(frozen=True)
class Costs:
    """Microseconds per sample, one thread of control, whatever torch makes of it.

    Attributes:
        components: cost of drawing from each component `[K]`, the defensive one last where there is one.
        base: what every sample costs: the densities of all components, and the integrand.

    `VarianceCost(costs.components, base=costs.base)` is the objective.
    """

    components: list[float]
    base: float


@torch.no_grad()
def measure_costs(
    mixture: nn.Module,
    context: Context,
    integrand: Callable[[Tensor, Context], Tensor] | None = None,
    *,
    samples: int = 4096,
    repeats: int = 5,
    seed: int = 0,
) -> Costs:
    """Time drawing from each component, evaluating all densities, and evaluating the integrand.

    The least of `repeats` runs of `samples` samples counts, because other load on the machine only ever adds.

    Raises:
        InputError: the proposal is no mixture (its distribution has no `components`), or counts below 1.
    """
    if samples < 1 or repeats < 1:
        raise InputError("samples, repeats", (samples, repeats), "integers >= 1")
    distribution: Any = mixture(context)
    if not hasattr(distribution, "components"):
        raise InputError("mixture", type(mixture).__name__, "a proposal whose distribution has components")
    generator = torch.Generator().manual_seed(seed)
    shape = (samples, *context.batch_shape)
    uniforms = torch.rand(*shape, distribution.dimension, generator=generator, dtype=context.dtype).to(context.device)
    uniforms = uniforms.clamp(1e-6, 1 - 1e-6)

    def least(function: Callable[[], Any]) -> float:
        function()
        best = float("inf")
        for _ in range(repeats):
            began = time.perf_counter()
            function()
            best = min(best, time.perf_counter() - began)
        return 1e6 * best / uniforms[..., 0].numel()

    components = [least(lambda c=c: c.sample(uniforms[..., : c.dimension])) for c in distribution.components]
    omega = distribution.sample(uniforms)
    base = least(lambda: distribution.log_prob(omega))
    if integrand is not None:
        base += least(lambda: integrand(omega, context))
    return Costs(components, base)
