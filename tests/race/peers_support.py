"""What the tests of single peers share: a scene with its truth, and whether estimates are centred on it."""

from __future__ import annotations

import functools

import torch
from scipy import stats
from torch import Tensor

import dsfit
from dsfit.race.peer import Peer, Problem, Sampler
from dsfit.streams import ContextStream

CONTEXTS = dsfit.Context(
    torch.tensor([0.0, 0.8, 1.4, -1.0]), 0.3, torch.tensor([0.0, 3.0, 0.0, 6.0]), torch.tensor([1.0, 0.0, 1.0, 0.4])
)
"""Four contexts in float32: lit, unlit, lit at 80 degrees, and partly lit."""


@functools.cache
def integrand() -> dsfit.Integrand:
    """Brown hair in a furnace."""
    return dsfit.Integrand(dsfit.DualScattering(dsfit.Fiber.preset("brown"), precision="table"))


@functools.cache
def truth() -> Tensor:
    """Integrals at `CONTEXTS`, `[4, 3]`, to 1e-6."""
    return dsfit.reference(integrand(), CONTEXTS, 1e-6).value


@functools.cache
def problem(uniforms: str = "random", dtype: torch.dtype = torch.float32) -> Problem:
    """What peers are asked to do."""
    return Problem(integrand(), ContextStream(), dtype=dtype, uniforms=uniforms, seed=3)


def ready(peer: Peer, uniforms: str = "random") -> Sampler:
    """The peer at `CONTEXTS`."""
    peer.prepare(problem(uniforms))
    with torch.no_grad():
        return peer.at(CONTEXTS)


def estimates(sampler: Sampler, samples: int = 256, runs: int = 40, seed: int = 21) -> Tensor:
    """Independent estimates `[runs, 4, 3]`, float64."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        found = torch.stack([sampler.estimate(samples, generator) for _ in range(runs)])
    assert found.shape == (runs, 4, 3) and bool(found.isfinite().all())
    return found.double()


def is_centred(found: Tensor, resolution: float = 0.02, level: float = 1e-3) -> bool:
    """Whether the mean of the runs agrees with the truth: least p-value of t-tests over contexts and channels above the
    level after Sidak's correction. Fails outright if a relative standard error is above `resolution`."""
    error = found.std(0) / len(found) ** 0.5
    assert float((error / truth()).max()) < resolution, "too noisy to tell"
    p = 2 * stats.t.sf(((found.mean(0) - truth()) / error).abs().numpy(), len(found) - 1)
    return bool(p.min() > 1 - (1 - level) ** (1 / p.size))


def root_mean_square(found: Tensor) -> Tensor:
    """Relative error over runs and channels, `[4]`."""
    return ((found - truth()) / truth()).square().mean((0, 2)).sqrt()
