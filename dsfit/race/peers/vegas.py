"""VEGAS (Lepage 2021) adapted to each context; the package is GPL and imported here alone."""

from __future__ import annotations

import math
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from dsfit.context import Context
from dsfit.errors import check_choice
from dsfit.frame import HALF_PI, cos_inclination, wrap
from dsfit.proposals.table_2d import check_count
from dsfit.race.density import DensitySampler
from dsfit.race.peer import Peer, Problem, Sampler
from dsfit.race.peers.vegas_map import MapDistribution
from dsfit.race.samplers import EachSampler

_LEAST = 64  # below, vegas rounds the number of evaluations up


class Vegas(Peer):
    """An integrator per context over (theta_i, phi), adapted to |f| cos(theta_i); then estimates without adaptation.

    phi covers half the circle where the integrand is even. Adaptation costs `iterations` x `evaluations` evaluations a
    context, counted as time; what it estimates on the way is thrown away, because weighted averages of adaptive
    iterations are biased.

    Args:
        iterations, evaluations: of the adaptation.
        estimator: "stratified": two points in each of vegas's hypercubes, at most the samples asked for, context by
            context, with vegas's own random numbers (beta = 0: evaluations spread by the variance of a few samples, as
            VEGAS+ does, cost more than they gain here; vegas coarsens its map to samples / 10 increments); "map":
            independent (or Sobol) points through the adapted map, all contexts at once. Sobol races always take the
            map.
    """

    name: ClassVar[str] = "vegas"
    per_context: ClassVar[bool] = True
    needs: ClassVar[tuple[str, ...]] = ("vegas",)

    def __init__(self, iterations: int = 5, evaluations: int = 500, estimator: str = "stratified") -> None:
        self.iterations = check_count("vegas.iterations", iterations)
        self.evaluations = check_count("vegas.evaluations", evaluations, _LEAST)
        self.estimator = check_choice("vegas.estimator", estimator, ("stratified", "map"))

    def prepare(self, problem: Problem) -> None:
        """Nothing is shared by contexts but the random numbers of the adaptation."""
        self.problem = problem
        self.random = np.random.default_rng(problem.seed)

    def at(self, contexts: Context) -> Sampler:
        """Adapt to every context."""
        adapted = [_Adapted(self, contexts[k : k + 1]) for k in range(len(contexts))]
        if self.estimator == "stratified" and self.problem.uniforms == "random":
            return EachSampler([_Stratified(one) for one in adapted])
        theta, phi = (torch.stack([x.ends(axis, contexts.dtype) for x in adapted]) for axis in (0, 1))
        distribution = MapDistribution(contexts, theta, phi, self.problem.integrand.is_even)
        return DensitySampler(self.problem, distribution, contexts)


class _Adapted:
    """A vegas integrator of one context `[1]`, adapted."""

    def __init__(self, peer: Vegas, context: Context) -> None:
        import vegas

        self.problem, self.context, self.random = peer.problem, context, peer.random
        self.even = self.problem.integrand.is_even
        limits = [[-HALF_PI, HALF_PI], [0.0 if self.even else -math.pi, math.pi]]
        self.integrator: Any = vegas.Integrator(limits, ran_array_generator=lambda size: self.random.random(size))
        target = vegas.lbatchintegrand(lambda x: torch.linalg.vector_norm(self.values(x), dim=-1).double().numpy())
        self.integrator(target, nitn=peer.iterations, neval=peer.evaluations)

    def values(self, x: np.ndarray) -> Tensor:
        """f cos(theta_i) `[N, C]` at points (theta_i, phi) `[N, 2]`, both signs of phi if it is even."""
        theta_i, phi = torch.from_numpy(np.array(x)).to(self.problem.dtype).unbind(-1)
        omega = torch.stack([theta_i, wrap(self.context.phi_r - phi)], dim=-1)
        value = self.problem.integrand(omega.unsqueeze(1), self.context)[:, 0]
        return value * cos_inclination(theta_i).unsqueeze(-1) * (2.0 if self.even else 1.0)

    def ends(self, axis: int, dtype: torch.dtype) -> Tensor:
        """Ends of the map's increments on an axis, `[K + 1]`."""
        grid = self.integrator.map
        return torch.tensor(np.asarray(grid.grid)[axis, : grid.ninc[axis] + 1], dtype=dtype)


class _Stratified(Sampler):
    """VEGAS without further adaptation: sum of weight times f over one iteration's points."""

    least = _LEAST

    def __init__(self, adapted: _Adapted) -> None:
        self.adapted = adapted

    def estimate(self, samples: int, generator: torch.Generator) -> Tensor:
        seed = int(torch.randint(2**62, (), generator=generator))
        self.adapted.random = np.random.default_rng(seed)
        integrator = self.adapted.integrator
        integrator.set(neval=samples, adapt=False, beta=0.0)
        total: Tensor | float = 0.0
        for x, weight in integrator.random_batch():
            total = total + torch.from_numpy(np.array(weight)) @ self.adapted.values(x).double()
        return torch.as_tensor(total).unsqueeze(0)
