"""Moves of emcee on the (theta, phi) strip with periodic phi, for several independent ensembles in one sampler.

emcee advances one ensemble of walkers; here the walkers of a sampler form `ensembles` groups that never see each other,
so that one evaluation of the density serves them all. Differences of azimuths are wrapped: without that a lobe around
|phi| = pi, forward scattering, would be cut in two.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import numpy as np
from emcee import State
from emcee.moves import Move

_TWO_PI = 2 * np.pi


def wrap_phi(x: np.ndarray) -> np.ndarray:
    """x `[..., 2]` with its second column wrapped into [-pi, pi]."""
    return np.stack([x[..., 0], x[..., 1] - _TWO_PI * np.round(x[..., 1] / _TWO_PI)], axis=-1)


class GroupedMove(Move):
    """Red-blue update (Foreman-Mackey et al. 2013, PASP 125) of every ensemble on its own.

    Args:
        ensembles: number of groups E; walker i belongs to group `i // W` of W walkers each.
    """

    def __init__(self, ensembles: int) -> None:
        self.ensembles = ensembles

    @abstractmethod
    def step(self, own: np.ndarray, others: np.ndarray, random: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
        """New places of the walkers `own` `[E, H, 2]` given `others` `[E, K, 2]` of the same ensembles, and the log of
        the factor `[E, H]` of the acceptance ratio beside the ratio of densities.
        """

    def propose(self, model: Any, state: State) -> tuple[State, np.ndarray]:
        """As in emcee: the new state, and which walkers moved `[E W]`."""
        shape = (self.ensembles, -1)
        coords, log_prob = state.coords.reshape(*shape, 2).copy(), state.log_prob.reshape(shape).copy()
        order = np.argsort(model.random.rand(*log_prob.shape), axis=1)
        rows, half = np.arange(self.ensembles)[:, None], order.shape[1] // 2
        accepted = np.zeros(log_prob.shape, dtype=bool)
        for own, others in ((order[:, :half], order[:, half:]), (order[:, half:], order[:, :half])):
            place, factor = self.step(coords[rows, own], coords[rows, others], model.random)
            place = wrap_phi(place)
            value = model.compute_log_prob_fn(place.reshape(-1, 2))[0].reshape(own.shape)
            with np.errstate(invalid="ignore"):  # -inf against -inf: stay
                taken = np.log(model.random.rand(*own.shape)) < factor + value - log_prob[rows, own]
            coords[rows, own] = np.where(taken[..., None], place, coords[rows, own])
            log_prob[rows, own] = np.where(taken, value, log_prob[rows, own])
            accepted[rows, own] = taken
        return State(coords.reshape(-1, 2), log_prob=log_prob.reshape(-1)), accepted.reshape(-1)


class DifferenceMove(GroupedMove):
    """Differential evolution (ter Braak 2006, Stat. Comput. 16): own + gamma (a - b) + noise, a and b two others.

    Args:
        gamma: scale; 2.38 / sqrt(2 d) = 1.19 explores a lobe, 1 hops between lobes.
        spread: standard deviation of log gamma, for lobes of several sizes at once.
        noise: standard deviation in radians of what is added, so that every place can be reached.
    """

    def __init__(self, ensembles: int, gamma: float, spread: float = 0.0, noise: float = 1e-3) -> None:
        super().__init__(ensembles)
        self.gamma, self.spread, self.noise = gamma, spread, noise

    def step(self, own: np.ndarray, others: np.ndarray, random: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
        """A symmetric step: a and b are exchangeable, so the factor is 1."""
        rows, count = np.arange(self.ensembles)[:, None], others.shape[1]
        a = random.randint(count, size=own.shape[:2])
        b = (a + random.randint(1, count, size=own.shape[:2])) % count
        gamma = self.gamma * np.exp(self.spread * random.randn(*own.shape[:2], 1))
        difference = wrap_phi(others[rows, a] - others[rows, b])
        return own + gamma * difference + self.noise * random.randn(*own.shape), np.zeros(own.shape[:2])


class StretchMove(GroupedMove):
    """Goodman and Weare's stretch (2010, CAMCoS 5) towards or away from another walker, along the shorter way round.

    A stretch to more than half a turn has no way back, and is not made.
    """

    def __init__(self, ensembles: int, scale: float = 2.0) -> None:
        super().__init__(ensembles)
        self.scale = scale

    def step(self, own: np.ndarray, others: np.ndarray, random: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
        """The factor is the stretch z to the power d - 1 = 1."""
        rows = np.arange(self.ensembles)[:, None]
        anchor = others[rows, random.randint(others.shape[1], size=own.shape[:2])]
        z = ((self.scale - 1) * random.rand(*own.shape[:2]) + 1) ** 2 / self.scale
        reach = z[..., None] * wrap_phi(own - anchor)
        return anchor + reach, np.where(np.abs(reach[..., 1]) <= np.pi, np.log(z), -np.inf)


class KernelMove(GroupedMove):
    """An independent place, near one of the other walkers or anywhere on the sphere.

    Brings lobes into proportion, and walkers from a lobe of little |F| to where the others are: the uniform share keeps
    the proposal density at such a walker from vanishing, which would forbid it to leave. The uniform share is also the
    only move that needs no other walker to know a lobe.

    Proposal density: `(1 - uniform) mean of Gaussians around the others + uniform cos(theta) / (4 pi)`. The Gaussians'
    width is drawn anew for every step, so that any of them may fit; at most 0.4 rad, where half a turn is eight
    standard deviations and one image of phi is enough.
    """

    widths = (0.4, 0.1, 0.025)
    uniform = 0.4

    def step(self, own: np.ndarray, others: np.ndarray, random: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
        """The factor is the proposal density at the old place over that at the new one."""
        rows, width = np.arange(self.ensembles)[:, None], self.widths[random.randint(len(self.widths))]
        centre = others[rows, random.randint(others.shape[1], size=own.shape[:2])]
        near = wrap_phi(centre + width * random.randn(*own.shape))
        anywhere = uniform_directions(own.shape[:2], random)
        place = np.where(random.rand(*own.shape[:2], 1) < self.uniform, anywhere, near)
        return place, np.log(self._density(own, others, width)) - np.log(self._density(place, others, width))

    def _density(self, x: np.ndarray, others: np.ndarray, width: float) -> np.ndarray:
        away = wrap_phi(x[:, :, None] - others[:, None]) / width
        near = np.exp(-0.5 * (away**2).sum(axis=-1)).mean(axis=-1) / (2 * np.pi * width**2)
        sphere = np.cos(x[..., 0]).clip(min=0) / (4 * np.pi)  # a Gaussian may reach beyond the pole
        return (1 - self.uniform) * near + self.uniform * sphere


def uniform_directions(shape: tuple[int, ...], random: np.random.RandomState) -> np.ndarray:
    """(theta, phi) `[*shape, 2]` uniform on the sphere."""
    u = random.rand(*shape, 2)
    return np.stack([np.arcsin(2 * u[..., 0] - 1), np.pi * (2 * u[..., 1] - 1)], axis=-1)
