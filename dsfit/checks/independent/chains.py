"""Independent samples of p* = |F| / int |F| domega by ensemble MCMC (emcee).

The chains run in (theta_i, phi) with the density |F| cos(theta_i) per dtheta dphi, phi = phi_r - phi_i periodic. In
these coordinates the density falls smoothly to 0 at theta = +-pi/2, as |F| has a factor cos(theta_i) of its own; in
(sin theta_i, phi) it would fall like a square root, and lobes would be squeezed against the ends.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import emcee
import numpy as np
import torch
from torch import Tensor

from dsfit.checks.independent.moves import DifferenceMove, KernelMove, StretchMove, uniform_directions
from dsfit.context import Context
from dsfit.errors import InputError
from dsfit.frame import HALF_PI, wrap
from dsfit.proposals.base import Proposal
from dsfit.random import uniforms
from dsfit.scene.integrand import Integrand

Size = Callable[[Tensor], Tensor]
"""|F|, up to a factor, at directions omega_i `[M, 2]`: `[M]`."""

STARTS = ("proposals", "uniform")
_JITTER = 0.3  # radians by which every second walker of a start from proposals is displaced


@dataclass(frozen=True)
class Chains:
    """Kept steps of several ensembles; nothing is shared between ensembles but the density.

    Attributes:
        place: (theta_i, phi) `[steps, E, W, 2]`, phi the relative azimuth.
        log_size: log |F| there, `[steps, E, W]`.
        acceptance: share of accepted steps of each ensemble, burn-in left out, `[E]`.
        stuck: share of walkers of each ensemble that never moved after the burn-in, `[E]`.
        start: index into `STARTS` of each ensemble, `[E]`.
        burn_in: steps that were thrown away.
    """

    place: np.ndarray
    log_size: np.ndarray
    acceptance: np.ndarray
    stuck: np.ndarray
    start: np.ndarray
    burn_in: int

    @property
    def steps(self) -> int:
        """Kept steps."""
        return self.place.shape[0]

    @property
    def ensembles(self) -> int:
        """Number of ensembles E."""
        return self.place.shape[1]

    def thinned(self, most: int) -> np.ndarray:
        """Places `[E, n, 2]`, evenly spaced steps of every walker, at most `most` over all ensembles (but one step)."""
        steps, ensembles, walkers, _ = self.place.shape
        every = max(1, math.ceil(steps * ensembles * walkers / most))
        return self.place[every - 1 :: every].transpose(1, 0, 2, 3).reshape(ensembles, -1, 2)


def size_of(integrand: Integrand, context: Context) -> Size:
    """|F| of an integrand, the Euclidean norm over channels."""

    def size(omega: Tensor) -> Tensor:
        with torch.no_grad():
            return torch.linalg.vector_norm(integrand(omega, context), dim=-1)

    return size


def to_omega(place: np.ndarray, context: Context) -> Tensor:
    """(theta_i, phi) `[..., 2]` to omega_i = (theta_i, phi_r - phi) `[..., 2]`."""
    both = torch.as_tensor(np.ascontiguousarray(place), dtype=torch.float64)
    return torch.stack([both[..., 0], wrap(context.phi_r - both[..., 1])], dim=-1)


def to_place(omega: Tensor, context: Context) -> np.ndarray:
    """omega_i `[..., 2]` to (theta_i, phi) `[..., 2]`."""
    return torch.stack([omega[..., 0], wrap(context.phi_r - omega[..., 1])], dim=-1).detach().numpy()


def run_ensembles(
    size: Size,
    context: Context,
    proposals: Sequence[Proposal],
    *,
    ensembles: int = 16,
    walkers: int = 32,
    steps: int = 300,
    burn_in: int = 100,
    seed: int = 1,
) -> Chains:
    """Samples of |F| / int |F| domega by several ensembles that start differently.

    The first half of the ensembles starts from the proposals in equal shares, every second walker displaced by 0.3 rad
    (a start that knows the lobes, in wrong proportions); the other half uniformly on the sphere (a start that knows
    nothing). Moves, per step: differential evolution with scales around 1.19 (40 %), with scale 1 to hop between lobes
    (10 %), stretch (10 %), near any other walker or anywhere (40 %).

    Args:
        size: |F|; its evaluation at `ensembles * walkers / 2` directions at a time is all that the chain costs.
        context: a single context.
        proposals: where to start from; none: every ensemble starts uniformly.
        ensembles, walkers: even numbers, at least 4 and 8.
        seed: same seed, same chains.

    Raises:
        InputError: too few or odd numbers of ensembles or walkers, fewer than 8 steps.
    """
    for name, value, least in (("ensembles", ensembles, 4), ("walkers", walkers, 8)):
        if value < least or value % 2:
            raise InputError(name, value, f"an even number >= {least}")
    if steps < 8 or burn_in < 1:
        raise InputError("steps", (steps, burn_in), "at least 8 kept steps and a burn-in of at least 1")
    random = np.random.RandomState(seed % 2**32)
    start = np.arange(ensembles) // (ensembles // 2) if proposals else np.ones(ensembles, dtype=int)
    place = uniform_directions((ensembles, walkers), random)
    if proposals:
        place[start == 0] = _from_proposals(proposals, context, ensembles // 2, walkers, random)

    def log_density(x: np.ndarray) -> np.ndarray:
        inside = np.abs(x[:, 0]) < HALF_PI
        found = np.full(len(x), -np.inf)
        with np.errstate(divide="ignore"):
            value = np.log(size(to_omega(x[inside], context)).numpy())
        found[inside] = value + np.log(np.cos(x[inside, 0]))
        return found

    moves = [
        (DifferenceMove(ensembles, 2.38 / 2, spread=0.5), 0.4),
        (DifferenceMove(ensembles, 1.0), 0.1),
        (StretchMove(ensembles), 0.1),
        (KernelMove(ensembles), 0.4),
    ]
    sampler = emcee.EnsembleSampler(ensembles * walkers, 2, log_density, moves=moves, vectorize=True)
    state = emcee.State(place.reshape(-1, 2), random_state=random.get_state())
    state = sampler.run_mcmc(state, burn_in, skip_initial_state_check=True, store=False)
    sampler.run_mcmc(state, steps, skip_initial_state_check=True)
    chain = sampler.get_chain().reshape(steps, ensembles, walkers, 2)
    log_size = sampler.get_log_prob().reshape(steps, ensembles, walkers) - np.log(np.cos(chain[..., 0]))
    moved = sampler.backend.accepted.reshape(ensembles, walkers)
    return Chains(
        place=chain,
        log_size=log_size,
        acceptance=moved.mean(axis=1) / steps,
        stuck=(moved == 0).mean(axis=1),
        start=start,
        burn_in=burn_in,
    )


def _from_proposals(
    proposals: Sequence[Proposal], context: Context, ensembles: int, walkers: int, random: np.random.RandomState
) -> np.ndarray:
    """Places `[ensembles, walkers, 2]` from the proposals in turn, those of odd walkers displaced."""
    generator = torch.Generator().manual_seed(int(random.randint(2**31)))
    columns = []
    for k in range(walkers):
        # walkers 2k and 2k + 1 share a proposal, so that each has as many displaced as others
        law = proposals[(k // 2) % len(proposals)](context)
        with torch.no_grad():
            omega = law.sample(uniforms((ensembles,), law.dimension, generator=generator))
        columns.append(to_place(omega, context))
    place = np.stack(columns, axis=1)
    place[:, 1::2] += _JITTER * random.randn(ensembles, walkers // 2, 2)
    # over the pole and down the other side, at mirrored inclination
    place[..., 0] = np.arcsin(np.sin(place[..., 0])).clip(-HALF_PI + 1e-9, HALF_PI - 1e-9)
    return place
