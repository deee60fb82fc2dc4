"""Training of a conditional density on importance samples of the integrand over a stream of contexts."""

from __future__ import annotations

import time
from dataclasses import dataclass

import torch
from torch import Tensor

from dsfit.context import Context
from dsfit.proposals.ou import OuProposal
from dsfit.race.peer import Problem
from dsfit.race.peers.flow_density import FlowProposal
from dsfit.random import uniforms

_CONTEXTS, _DIRECTIONS = 256, 64
_BATCH, _POOL = 2048, 2**18
_USES = 8  # least number of times that a direction of the pool is used, as long as the pool may grow


@dataclass(frozen=True)
class Pool:
    """Directions `[N, 2]` with their contexts `[N]` and weights |f| / (p int |f|) `[N]`, whose mean is 1."""

    context: Context
    omega: Tensor
    weight: Tensor


def draw_pool(problem: Problem, count: int, generator: torch.Generator) -> Pool:
    """About `count` directions, `_DIRECTIONS` Sobol points of `OuProposal` in each context; int |f| is their own mean
    (a training set need not be unbiased)."""
    proposal = OuProposal(problem.model.bsdf)
    parts = []
    with torch.no_grad():
        for _ in range(max(1, count // (_CONTEXTS * _DIRECTIONS))):
            context = problem.stream.draw(_CONTEXTS, generator, dtype=problem.dtype)
            distribution = proposal(context)
            shape = (_DIRECTIONS, _CONTEXTS)
            u = uniforms(shape, distribution.dimension, generator=generator, kind="sobol", dtype=problem.dtype)
            omega, log_p = distribution.sample_with_log_prob(u)
            weight = torch.linalg.vector_norm(problem.integrand(omega, context), dim=-1) * torch.exp(-log_p)
            mean = weight.mean(0)  # 0 where no light arrives in this dtype: such contexts teach nothing
            weight = torch.where(mean > 0, weight / mean.clamp_min(torch.finfo(mean.dtype).tiny), 0.0)
            parts.append((context.expand(*shape).reshape(-1), omega.reshape(-1, 2), weight.reshape(-1)))
    fields = [torch.cat([getattr(c, name) for c, _, _ in parts]) for name in ("theta_r", "phi_r", "n", "v")]
    return Pool(Context(*fields), torch.cat([x for _, x, _ in parts]), torch.cat([x for _, _, x in parts]))


def train(
    problem: Problem, proposal: FlowProposal, seconds: float, steps: int, rate: float, generator: torch.Generator
) -> list[float]:
    """Minimise the forward Kullback-Leibler divergence, `-mean(weight log q)`, by Adam until the time or the steps are
    spent; the rate falls to 0 along a cosine of whichever share is larger.

    Returns:
        The loss of every step. The pool's time counts as well.
    """
    start = time.perf_counter()
    pool = draw_pool(problem, min(_POOL, steps * _BATCH // _USES), generator)
    optimizer = torch.optim.Adam(proposal.parameters(), lr=rate)
    losses: list[float] = []
    for step in range(steps):
        spent = max((time.perf_counter() - start) / seconds, step / steps)
        if spent >= 1:
            break
        for group in optimizer.param_groups:
            group["lr"] = rate * 0.5 * (1 + float(torch.cos(torch.tensor(torch.pi * spent))))
        losses.append(_step(problem, proposal, pool, optimizer, generator))
    return losses


def _step(
    problem: Problem, proposal: FlowProposal, pool: Pool, optimizer: torch.optim.Optimizer, generator: torch.Generator
) -> float:
    index = torch.randint(len(pool.weight), (_BATCH,), generator=generator)
    context, omega = pool.context[index], pool.omega[index]
    if problem.integrand.is_even:  # phi_r = 0 in the stream, so that phi -> -phi is phi_i -> -phi_i
        sign = torch.where(torch.rand(_BATCH, generator=generator) < 0.5, -1.0, 1.0).to(omega.dtype)
        omega = torch.stack([omega[:, 0], omega[:, 1] * sign], dim=-1)
    loss = -(pool.weight[index] * proposal.bare(context).log_prob(omega)).mean()
    optimizer.zero_grad()
    loss.backward()
    torch.nn.utils.clip_grad_norm_(proposal.parameters(), 1.0)
    optimizer.step()
    return float(loss.detach())
