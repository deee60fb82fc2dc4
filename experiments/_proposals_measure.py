"""Marginals of a distribution over directions: density and distribution function by quadrature, quantiles, counts."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor
from torch.quasirandom import SobolEngine

from dsfit.checks.chi_square import POOL
from dsfit.context import Context
from dsfit.frame import HALF_PI, TWO_PI, cos_inclination, wrap
from dsfit.proposals.base import Distribution
from dsfit.quadrature import panel_points
from dsfit.random import uniforms
from dsfit.scene.integrand import Integrand

AXES = {"theta": (-HALF_PI, HALF_PI), "phi": (-math.pi, math.pi), "forward": (0.0, TWO_PI)}
"""Ends of the coordinates, radians."""
LEVELS = 101
"""Numbers u at which quantiles are kept, evenly from 0 to 1."""
EVERY = 4
"""Every fourth point of a marginal is stored."""
_QUANTILES = 2**15
_AT_ONCE = 400_000


class Density(Protocol):
    """Anything with a log density per steradian, up to a factor."""

    def log_prob(self, omega: Tensor) -> Tensor: ...


@dataclass(frozen=True)
class Size:
    """log |F| of an integrand: what the proposals of all light are meant for."""

    integrand: Integrand
    context: Context

    def log_prob(self, omega: Tensor) -> Tensor:
        """log of the Euclidean norm over channels, `[M]`."""
        return torch.log(torch.linalg.vector_norm(self.integrand(omega, self.context), dim=-1))


@dataclass(frozen=True)
class Marginal:
    """What a law claims about one coordinate.

    Attributes:
        x: points, radians, `[P]`.
        density: per radian at them.
        cdf: integral of the density from the lower end, `[P]`; the last is the mass.
    """

    x: np.ndarray
    density: np.ndarray
    cdf: np.ndarray

    @property
    def mass(self) -> float:
        """Integral over all directions."""
        return float(self.cdf[-1])


def marginal(distribution: Density, context: Context, axis: str, intervals: int = 720) -> Marginal:
    """Density of one coordinate, the other integrated out, by Gauss rules on `intervals` pieces of either."""
    edges = torch.linspace(*AXES[axis], intervals + 1, dtype=torch.float64)
    inner, weight = panel_points(edges, 2)
    parts = (weight * _density(distribution, context, axis, inner)).reshape(intervals, 2).sum(-1)
    cdf = torch.cat([torch.zeros(1, dtype=torch.float64), parts.cumsum(0)])
    return Marginal(edges.numpy(), _density(distribution, context, axis, edges).numpy(), cdf.numpy())


def _density(distribution: Density, context: Context, axis: str, x: Tensor) -> Tensor:
    low, high = AXES["phi" if axis == "theta" else "theta"]
    other, weight = panel_points(torch.linspace(low, high, 25, dtype=torch.float64), 8)
    rows = max(1, _AT_ONCE // len(other))
    # in pieces that stay in memory
    return torch.cat([_row(distribution, context, axis, part, other, weight) for part in x.split(rows)])


def _row(distribution: Density, context: Context, axis: str, x: Tensor, other: Tensor, weight: Tensor) -> Tensor:
    a, b = torch.meshgrid(x, other, indexing="ij")
    theta, phi = (a, b) if axis == "theta" else (b, a)
    omega = torch.stack([theta, wrap(context.phi_r - phi)], dim=-1).reshape(-1, 2)
    with torch.no_grad():
        # the pole of a density per steradian cancels against the cosine of the measure
        log = distribution.log_prob(omega) + torch.log(cos_inclination(omega[:, 0]))
    return (torch.exp(log).reshape(a.shape) * weight).sum(-1)


def coordinate(omega: Tensor, context: Context, axis: str) -> np.ndarray:
    """theta_i or phi of directions, in the interval of the axis."""
    if axis == "theta":
        return omega[..., 0].numpy()
    phi = wrap(context.phi_r - omega[..., 1])
    return (torch.remainder(phi, TWO_PI) if axis == "forward" else phi).numpy()


@functools.cache
def _net(dimension: int) -> Tensor:
    points = SobolEngine(dimension, scramble=False).draw(_QUANTILES, dtype=torch.float64)
    return points + 0.5 / _QUANTILES


def quantiles(distribution: Distribution, context: Context, axis: str) -> np.ndarray:
    """What the sampler returns for u = 0 to 1, in ascending order, `[LEVELS]` radians: the inverse of the distribution
    function that the sampler has, whatever its density claims.

    Order statistics of a net of uniforms, so that samplers of several uniforms have one too; no chance in it.
    """
    with torch.no_grad():
        omega = distribution.sample(_net(distribution.dimension))
    ordered = np.sort(coordinate(omega, context, axis))
    return ordered[np.round(np.linspace(0, 1, LEVELS) * (len(ordered) - 1)).astype(int)]


def point_share(distribution: Distribution, context: Context, axis: str) -> float:
    """Largest share of the sampler's draws in a single value: 0 for a density, up to the resolution of the net."""
    with torch.no_grad():
        x = coordinate(distribution.sample(_net(distribution.dimension)), context, axis)
    most = int(np.unique(np.round(x, 12), return_counts=True)[1].max())
    return most / len(x) if most > _QUANTILES // 1000 else 0.0


def draw(distribution: Distribution, context: Context, axis: str, samples: int, seed: int) -> np.ndarray:
    """Independent samples of a coordinate, `[samples]`."""
    u = uniforms((samples,), distribution.dimension, generator=torch.Generator().manual_seed(seed))
    with torch.no_grad():
        return coordinate(distribution.sample(u), context, axis)


def kept(name: str, law: Marginal, shown: np.ndarray, drawn: np.ndarray, axis: str, bins: int) -> dict[str, np.ndarray]:
    """What is stored of a sampler: every fourth point of its marginal, its quantiles, its histogram."""
    found = counts(drawn, axis, bins)
    return {
        f"{name}.density": law.density[::EVERY].astype(np.float32),
        f"{name}.cdf": law.cdf[::EVERY].astype(np.float32),
        f"{name}.quantiles": shown.astype(np.float32),
        f"{name}.counts": found.astype(np.int32),
        f"{name}.counts_error": count_error(found).astype(np.float16),
    }


def count_error(observed: np.ndarray) -> np.ndarray:
    """Standard errors of counts; of few, that of 5, below which a count is not Gaussian at all."""
    return np.sqrt(np.maximum(observed, POOL))


def counts(x: np.ndarray, axis: str, bins: int) -> np.ndarray:
    """Histogram over the coordinate."""
    return np.histogram(x, np.linspace(*AXES[axis], bins + 1))[0]


def distance(x: np.ndarray, law: Marginal) -> float:
    """Kolmogorov and Smirnov's largest distance between the samples and the law, brought to mass 1.

    Mass is judged apart: a density that is right but for a factor has distance 0 and mass not 1.
    """
    ordered = np.sort(x)
    expected = np.interp(ordered, law.x, law.cdf / law.mass)
    rank = np.arange(len(ordered) + 1) / len(ordered)
    # where samples stick together, the first of them has all lower ranks below it
    first, last = np.searchsorted(ordered, ordered, "left"), np.searchsorted(ordered, ordered, "right")
    return float(max(np.abs(rank[last] - expected).max(), np.abs(expected - rank[first]).max()))


def distance_error(found: np.ndarray, samples: int) -> np.ndarray:
    """Above the standard error of a largest distance between distribution functions: that of a share of a half."""
    return np.full_like(found, 0.5 / math.sqrt(samples))
