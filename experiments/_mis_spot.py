"""What the experiments on multiple importance sampling share: the integrand at one context with the chapter's
proposals, and the relative variance of their combinations by quadrature."""

from __future__ import annotations

import functools
import math
import statistics
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from dsfit import Context, DualScattering, Fiber, Integrand, quadrature_nodes
from dsfit.mis import mis_variance
from dsfit.race.clock import timed

ROUGH, FINE = (1e-6, 10), (1e-8, 12)
"""Tolerance and Gauss points of the two sets of nodes; the difference of their results is the error that is stated."""


@functools.lru_cache(maxsize=8)
def integrand(preset: str) -> Integrand:
    """The preset's integrand in a furnace."""
    return Integrand(DualScattering(Fiber.preset(preset), precision="table"))


@functools.lru_cache(maxsize=8)
def proposals(preset: str) -> dict[str, Any]:
    """The chapter's proposals of this fibre by name, with nothing to learn."""
    from dsfit.proposals import chapter_proposals

    return dict(chapter_proposals(integrand(preset).bsdf, learnable=False))


class Spot:
    """One context: nodes and log densities are made once.

    Args:
        preset: the fibre.
        theta_r_deg, n: the context; v follows from n (1 where n = 0, else 0) unless given.
    """

    def __init__(self, preset: str, theta_r_deg: float, n: float, v: float | None = None) -> None:
        self.preset, self.integrand = preset, integrand(preset)
        self.context = Context(torch.tensor(math.radians(theta_r_deg), dtype=torch.float64), 0.0, n, v)
        self._log_p: dict[tuple[str, bool], Tensor] = {}
        self._nodes: dict[bool, Any] = {}

    def nodes(self, fine: bool = True) -> Any:
        """Quadrature nodes with phi >= 0 and doubled weights; everything here is even in phi."""
        if fine not in self._nodes:
            rtol, count = FINE if fine else ROUGH
            self._nodes[fine] = quadrature_nodes(self.integrand, self.context, rtol, even=True, count=count)
        return self._nodes[fine]

    @functools.cached_property
    def integral(self) -> Tensor:
        """∫F `[C]`."""
        nodes = self.nodes()
        return (nodes.value * nodes.weight[:, None]).sum(0)

    @functools.cached_property
    def distributions(self) -> dict[str, Any]:
        """The chapter's distributions here."""
        with torch.no_grad():
            return {name: proposal(self.context) for name, proposal in proposals(self.preset).items()}

    def log_p(self, names: Sequence[str], fine: bool = True) -> Tensor:
        """Log densities `[S, Q]` at the nodes."""
        with torch.no_grad():
            for name in names:
                if (name, fine) not in self._log_p:
                    self._log_p[name, fine] = self.distributions[name].log_prob(self.nodes(fine).omega)
        return torch.stack([self._log_p[name, fine] for name in names])

    def value(
        self,
        names: Sequence[str],
        shares: Sequence[float],
        rule: Any = "balance",
        model: str = "multi",
        fine: bool = True,
    ) -> float:
        """N Var / |∫F|^2, summed over channels, by quadrature."""
        nodes, log_p = self.nodes(fine), self.log_p(names, fine)
        found = mis_variance(nodes.value, nodes.weight, log_p, list(shares), rule, model=model)
        return float(found.variance.sum() / found.integral.square().sum())

    def variance(
        self, names: Sequence[str], shares: Sequence[float], rule: Any = "balance", model: str = "multi"
    ) -> tuple[float, float]:
        """The value, and by how much it differs with fewer nodes."""
        fine, rough = (self.value(names, shares, rule, model, which) for which in (True, False))
        return fine, abs(fine - rough)

    def single(self, name: str) -> float:
        """N Var / |∫F|^2 of one proposal alone: inf where it is infinite, nan where the density does not cover F.

        Quadrature cannot tell an integral that diverges logarithmically from a large one, so that is found from the
        density itself.
        """
        if not self.covers(name):
            return math.nan
        return math.inf if self.diverges(name) else self.value([name], [1.0])

    def covers(self, name: str) -> bool:
        """Whether the density is positive wherever F is not 0."""
        return bool(torch.isfinite(self.log_p([name])[0][self.nodes().norm > 0]).all())

    def diverges(self, name: str) -> bool:
        """Whether ∫F^2/p is infinite because p falls to 0 in proportion to the distance from phi = pi while F does not:
        the tail of ∫ d phi / (pi - phi) is a logarithm."""
        theta = -self.context.theta_r * 0.9
        phi = math.pi - torch.tensor([1e-3, 1e-6], dtype=torch.float64)
        omega = torch.stack([theta.expand(2), self.context.phi_r - phi], dim=-1)
        with torch.no_grad():
            log_p = self.distributions[name].log_prob(omega)
            falls = float(log_p[0] - log_p[1]) > 0.9 * math.log(1e3)
            return falls and bool((self.integrand(omega, self.context) > 0).any())


def median_seconds(work: Callable[[], Any], repeats: int) -> float:
    """Median CPU seconds of `work`, which has been done once before."""
    work()
    return statistics.median(timed(work)[1] for _ in range(repeats))


Estimator = Callable[[int, torch.Generator], Tensor]
"""Samples in all and a generator to an estimate `[C]`."""


@torch.no_grad()
def error_and_seconds(
    estimator: Estimator, integral: Tensor, samples: int, repeats: int, seed: int
) -> tuple[float, float, float]:
    """Relative root mean squared error of one estimate, its standard error, and median CPU seconds once warm."""
    for _ in range(2):
        estimator(samples, torch.Generator().manual_seed(seed))
    generator, found = torch.Generator().manual_seed(seed), []
    seconds = median_seconds(lambda: found.append(estimator(samples, generator)), repeats)
    squares = (torch.stack(found) - integral).square().sum(-1) / integral.square().sum()
    root = float(squares.mean().sqrt())
    return root, float(squares.std()) / (2 * root * len(squares) ** 0.5), seconds
