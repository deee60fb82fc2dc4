"""Every move alone leaves a known density alone; moves without their factor do not."""

from __future__ import annotations

import emcee
import numpy as np
import pytest
from scipy import special, stats

from dsfit.checks.independent.moves import (
    DifferenceMove,
    GroupedMove,
    KernelMove,
    StretchMove,
    uniform_directions,
    wrap_phi,
)

ENSEMBLES, WALKERS, KAPPA = 24, 16, 2.0


def log_density(x: np.ndarray) -> np.ndarray:
    """cos^2(theta) times a von Mises law around phi = pi, across the cut."""
    inside = np.abs(x[:, 0]) < np.pi / 2
    with np.errstate(divide="ignore"):
        return np.where(inside, 2 * np.log(np.abs(np.cos(x[:, 0]))) - KAPPA * np.cos(x[:, 1]), -np.inf)


def p_value(move: GroupedMove, steps: int = 350, burn_in: int = 100, seed: int = 3) -> float:
    """Of the exact means, by Student's t over ensembles, Sidak over functions."""
    random = np.random.RandomState(seed)
    start = uniform_directions((ENSEMBLES, WALKERS), random).reshape(-1, 2)
    sampler = emcee.EnsembleSampler(ENSEMBLES * WALKERS, 2, log_density, moves=move, vectorize=True)
    sampler.run_mcmc(emcee.State(start, random_state=random.get_state()), burn_in + steps)
    chain = sampler.get_chain(discard=burn_in).reshape(steps, ENSEMBLES, WALKERS, 2)
    theta, phi = chain[..., 0], chain[..., 1]
    assert np.abs(phi).max() <= np.pi and np.abs(theta).max() < np.pi / 2
    ratio = [special.iv(k, KAPPA) / special.iv(0, KAPPA) for k in (1, 2)]
    exact = [(np.sin(theta), 0), (np.sin(theta) ** 2, 1 / 4), (np.cos(phi), -ratio[0]), (np.sin(phi), 0)]
    exact.append((np.cos(2 * phi), ratio[1]))
    p = [stats.ttest_1samp(value.mean(axis=(0, 2)), mean).pvalue for value, mean in exact]
    assert max(stats.sem(value.mean(axis=(0, 2))) for value, _ in exact) < 0.03
    return float(-np.expm1(len(p) * np.log1p(-min(p))))


MOVES = {
    "difference": DifferenceMove(ENSEMBLES, 1.19, spread=0.5),
    "hop": DifferenceMove(ENSEMBLES, 1.0, noise=0.3),
    "stretch": StretchMove(ENSEMBLES),
    "kernel": KernelMove(ENSEMBLES),
}


@pytest.mark.parametrize("name", MOVES)
def test_a_move_leaves_the_density_alone(name: str) -> None:
    assert p_value(MOVES[name]) > 1e-4


class NoFactor(GroupedMove):
    """Another move that forgets its factor."""

    def __init__(self, move: GroupedMove) -> None:
        super().__init__(move.ensembles)
        self.move = move

    def step(self, own: np.ndarray, others: np.ndarray, random: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
        place, factor = self.move.step(own, others, random)
        return place, np.where(np.isfinite(factor), 0.0, factor)


@pytest.mark.parametrize("name", ["stretch", "kernel"])
def test_a_move_without_its_factor_is_caught(name: str) -> None:
    assert p_value(NoFactor(MOVES[name])) < 1e-6


def test_ensembles_do_not_see_each_other() -> None:
    """What one ensemble starts from changes nothing in the others."""
    random = np.random.RandomState(1)
    start = uniform_directions((4, 8), random)
    other = start.copy()
    other[3] *= 0.5
    ends = []
    for place in (start, other):
        moves = [(move(4), 1.0) for move in (lambda e: DifferenceMove(e, 1.0), StretchMove, KernelMove)]
        sampler = emcee.EnsembleSampler(32, 2, log_density, moves=moves, vectorize=True)
        state = emcee.State(place.reshape(-1, 2), random_state=np.random.RandomState(2).get_state())
        ends.append(sampler.run_mcmc(state, 30).coords.reshape(4, 8, 2))
    np.testing.assert_array_equal(ends[0][:3], ends[1][:3])
    assert not np.array_equal(ends[0][3], ends[1][3])


def test_wrapped_azimuths() -> None:
    x = np.array([[0.3, 4.0], [0.3, -4.0], [0.1, np.pi / 2]])
    np.testing.assert_allclose(wrap_phi(x)[:, 1], [4 - 2 * np.pi, 2 * np.pi - 4, np.pi / 2])
