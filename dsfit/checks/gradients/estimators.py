"""Monte Carlo gradients of the second moment `M = int |F|^2 / p domega` in a proposal's parameters.

With h = |F|^2 / p^2 (so that M = E_p[h]) and the score s = dlog p / dx at fixed omega, the mean of each is dM/dx:

    score        -h s                       omega ~ p, held fixed: M = int |F|^2 / p, differentiated under the integral
    baseline     -(h - b) s                 the same; E_p[s] = 0, and b = E_p[h s^2] / E_p[s^2] makes the variance least
    defensive    -(|F|^2 / (p q)) s         omega ~ q, a law that stays as it is
    pathwise     dh/domega . dT/dx - 2 h s  omega = T(u, x): M = E_u[h(T(u, x), x)], differentiated through the samples
                                            and through p; needs dF/domega

A mixture `p = sum_k w_k p_k` selects its component by a step function of u, whose derivative in the weights is zero
almost everywhere: the path alone loses what moves from component to component. Here M = sum_k w_k E_u[h(T_k(u, x), x)],
so that the weights are differentiated as they stand,

    dM/dx = sum_k (dw_k/dx) E_k[h] + sum_k w_k E_k[dh/domega . dT_k/dx - 2 h s].

Paths see no jumps: where |F| / p jumps along a direction in which samples move, the derivative of M has a term at the
jump that no sample's derivative contains (`jumps.py` finds those).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.func import functional_call, jacfwd

from dsfit.checks.gradients.moment import Layout, log_prob_and_slopes
from dsfit.context import Context
from dsfit.proposals.base import Distribution, Proposal
from dsfit.proposals.mixture import MixtureDistribution
from dsfit.proposals.uniform import UniformSphereDistribution

Integrand = Callable[[Tensor, Context], Tensor]


@dataclass(frozen=True)
class GradientEstimate:
    """One estimate of dM/dx in units of M*.

    Attributes:
        name: of the estimator.
        mean, error: `[P]`, with the standard error.
        variance: of a single sample `[P]`: `error^2` times the number of samples.
        leverage: `[P]`, share that the largest sample has in the sum of squares that `error` comes from: near 1, the
            standard error is that of a heavy tail and says little.
        samples: number of samples.
        seconds: wall time.
    """

    name: str
    mean: Tensor
    error: Tensor
    variance: Tensor
    leverage: Tensor
    samples: int
    seconds: float

    @property
    def noise(self) -> float:
        """Variance of a single sample, summed over parameters."""
        return float(self.variance.sum())

    @property
    def cost(self) -> float:
        """Variance times time of a sample, in microseconds: what decides the error after a given time."""
        return self.noise * self.seconds / self.samples * 1e6


@dataclass(frozen=True)
class Problem:
    """What is differentiated: |F|^2 of a shading point over `norm^2`, and a proposal with learnable parameters.

    Attributes:
        integrand: `integrand(omega, context) -> [..., C]`.
        proposal: its parameters that require grad are the x.
        context: a single context.
        norm: int |F| domega.
    """

    integrand: Integrand
    proposal: Proposal
    context: Context
    norm: float

    @property
    def layout(self) -> Layout:
        """Of the parameters."""
        return Layout.of(self.proposal)

    def square(self, omega: Tensor) -> Tensor:
        """|F|^2 / norm^2 `[N]`."""
        return (self.integrand(omega, self.context) / self.norm).square().sum(-1)

    def weights(self, omega: Tensor) -> tuple[Tensor, Tensor]:
        """h `[N]` and the score `[N, P]`."""
        log_p, score = log_prob_and_slopes(self.proposal, self.context, omega, self.layout)
        with torch.no_grad():
            return self.square(omega) * torch.exp(-2 * log_p), score


def summary(name: str, strata: list[tuple[float, Tensor]], seconds: float) -> GradientEstimate:
    """`sum_k w_k mean(rows_k)` with its standard error, from weights w_k and samples `[n_k, P]` of every stratum."""
    count = sum(len(rows) for _, rows in strata)
    mean, square = torch.zeros(()), torch.zeros(())
    largest = torch.zeros(())
    for weight, rows in strata:
        center = rows.mean(0)
        deviation = (weight / len(rows) * (rows - center)).square()
        mean, square = mean + weight * center, square + deviation.sum(0) * (len(rows) / max(len(rows) - 1, 1))
        largest = torch.maximum(largest, deviation.amax(0))
    leverage = largest / square.clamp_min(torch.finfo(torch.float64).tiny)
    return GradientEstimate(name, mean, torch.sqrt(square), square * count, leverage, count, seconds)


def _uniforms(distribution: Distribution, count: int, generator: torch.Generator) -> Tensor:
    u = torch.rand((count, distribution.dimension), generator=generator, dtype=torch.float64)
    return u.clamp(1e-12, 1 - 1e-12)


def score_rows(problem: Problem, samples: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """h `[N]` and the score `[N, P]` at samples of p."""
    with torch.no_grad():
        distribution = problem.proposal(problem.context)
        omega = distribution.sample(_uniforms(distribution, samples, generator))
    return problem.weights(omega)


def score_function(problem: Problem, samples: int, generator: torch.Generator) -> GradientEstimate:
    """`-E_p[h s]`: needs no derivative of F."""
    began = time.perf_counter()
    h, score = score_rows(problem, samples, generator)
    return summary("score", [(1.0, -h[:, None] * score)], time.perf_counter() - began)


def score_with_baseline(problem: Problem, samples: int, generator: torch.Generator) -> GradientEstimate:
    """`-E_p[(h - b) s]` with b from the other half of the samples, so that it stays unbiased."""
    began = time.perf_counter()
    h, score = score_rows(problem, samples, generator)
    half = samples // 2
    strata = []
    for mine, other in ((slice(None, half), slice(half, None)), (slice(half, None), slice(None, half))):
        square = score[other].square()
        b = (h[other, None] * square).sum(0) / square.sum(0).clamp_min(torch.finfo(torch.float64).tiny)
        rows = -(h[mine, None] - b) * score[mine]
        strata.append((len(rows) / samples, rows))
    return summary("baseline", strata, time.perf_counter() - began)


def defensive_law(problem: Problem, share: float = 0.5) -> Distribution:
    """The proposal as it is now, mixed with `share` of the uniform sphere."""
    with torch.no_grad():
        parts = [problem.proposal(problem.context), UniformSphereDistribution(problem.context)]
        return MixtureDistribution(parts, torch.log(torch.tensor([1 - share, share], dtype=torch.float64)))


def defensive_sampling(
    problem: Problem, samples: int, generator: torch.Generator, law: Distribution | None = None
) -> GradientEstimate:
    """`-E_q[(|F|^2 / (p q)) s]` with q = `law`, by default half the proposal and half the uniform sphere."""
    began = time.perf_counter()
    law = defensive_law(problem) if law is None else law
    with torch.no_grad():
        omega, log_q = law.sample_with_log_prob(_uniforms(law, samples, generator))
        log_p, score = log_prob_and_slopes(problem.proposal, problem.context, omega, problem.layout)
        rows = -(problem.square(omega) * torch.exp(-log_p - log_q))[:, None] * score
    return summary("defensive", [(1.0, rows)], time.perf_counter() - began)


def components_of(distribution: Distribution) -> tuple[list[Distribution], Tensor]:
    """Components that are sampled without a choice among them, and their log weights `[K]`; mixtures within mixtures
    are taken apart."""
    if not isinstance(distribution, MixtureDistribution):
        return [distribution], torch.zeros(1, dtype=torch.float64)
    parts: list[Distribution] = []
    logs = []
    for component, log_weight in zip(distribution.components, distribution.log_weights.unbind(-1), strict=True):
        inner, inner_logs = components_of(component)
        parts += inner
        logs.append(log_weight + inner_logs)
    return parts, torch.cat(logs)


@dataclass(frozen=True)
class Stratum:
    """Samples of one component.

    Attributes:
        weight: w_k.
        slope: dw_k/dx `[P]`.
        h: `[n]`.
        score: s `[n, P]`.
        moved: dh/domega . dT_k/dx `[n, P]`.
        turned: |d inclination/dx| and |d azimuth/dx|, the largest over the samples, `[2, P]`.
    """

    weight: float
    slope: Tensor
    h: Tensor
    score: Tensor
    moved: Tensor
    turned: Tensor


def path_strata(problem: Problem, samples: int, generator: torch.Generator) -> list[Stratum]:
    """Samples of every component with the derivatives of their paths, about in proportion to the weights."""
    proposal, context, layout = problem.proposal, problem.context, problem.layout
    values = {name: p.detach() for name, p in proposal.named_parameters()}

    def parts(changed: dict[str, Tensor]) -> tuple[list[Distribution], Tensor]:
        return components_of(functional_call(proposal, {**values, **changed}, (context,)))

    learned = {name: values[name] for name in layout.names}
    components, log_weights = parts({})
    count = len(components)
    weights = torch.exp(log_weights.detach())
    slopes = jacfwd(lambda changed: torch.exp(parts(changed)[1]))(learned)
    slope = layout.flat(slopes, count).detach()
    drawn, moves = [], []
    for k, component in enumerate(components):
        share = max(2, samples // (4 * count), round(samples * float(weights[k])))
        u = _uniforms(component, share, generator)

        def path(changed: dict[str, Tensor], k: int = k, u: Tensor = u) -> Tensor:
            return parts(changed)[0][k].sample(u)

        omega, slope_of_path = _path_slopes(path, learned, layout)
        drawn.append(omega)
        moves.append(slope_of_path)
    sizes = [len(omega) for omega in drawn]
    h, score, along = _slope_in_omega(problem, torch.cat(drawn))
    rows = zip(weights, slope, moves, h.split(sizes), score.split(sizes), along.split(sizes), strict=True)
    return [
        Stratum(float(w), dw, hk, sk, torch.einsum("nd,ndp->np", ak, move), move.abs().amax(0))
        for w, dw, move, hk, sk, ak in rows
    ]


def _path_slopes(
    path: Callable[[dict[str, Tensor]], Tensor], learned: dict[str, Tensor], layout: Layout
) -> tuple[Tensor, Tensor]:
    """omega `[n, 2]` and its derivative `[n, 2, P]`; only parameters that reach it are differentiated."""
    leaves = {name: value.clone().requires_grad_() for name, value in learned.items()}
    out = path(leaves)
    reached: list[str] = []
    if out.requires_grad:
        found = torch.autograd.grad(out.sum(), list(leaves.values()), allow_unused=True)
        reached = [name for name, g in zip(leaves, found, strict=True) if g is not None]
    rows = out.numel()
    jacobian = {name: torch.zeros(rows, value.numel(), dtype=out.dtype) for name, value in learned.items()}
    if reached:
        fixed = {name: value for name, value in learned.items() if name not in reached}
        moving = {name: learned[name] for name in reached}
        jacobian |= jacfwd(lambda changed: path({**fixed, **changed}))(moving)
    return out.detach(), layout.flat(jacobian, rows).reshape(*out.shape, -1).detach()


def _slope_in_omega(problem: Problem, omega: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """h `[n]`, the score `[n, P]`, and dh/domega `[n, 2]`."""
    log_p, score = log_prob_and_slopes(problem.proposal, problem.context, omega, problem.layout)
    leaf = omega.clone().requires_grad_()
    density = problem.proposal(problem.context).log_prob(leaf)
    h = problem.square(leaf) * torch.exp(-2 * density)
    (along,) = torch.autograd.grad(h.sum(), leaf)
    return h.detach(), score, along


def pathwise(problem: Problem, samples: int, generator: torch.Generator) -> GradientEstimate:
    """Reparametrised samples, component by component; see the module's text."""
    began = time.perf_counter()
    strata = path_strata(problem, samples, generator)
    return pathwise_of(strata, time.perf_counter() - began)


def pathwise_of(strata: list[Stratum], seconds: float = 0.0) -> GradientEstimate:
    """The pathwise estimate from samples that are there already."""
    rows = [(s.weight, s.h[:, None] * (s.slope / s.weight) + s.moved - 2 * s.h[:, None] * s.score) for s in strata]
    return summary("pathwise", rows, seconds)


ESTIMATORS: dict[str, Callable[[Problem, int, torch.Generator], GradientEstimate]] = {
    "score": score_function,
    "baseline": score_with_baseline,
    "defensive": defensive_sampling,
    "pathwise": pathwise,
}
"""Name to function `(problem, samples, generator)`."""
