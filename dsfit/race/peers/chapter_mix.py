"""The best that the chapter's proposals can do together: shares fitted to each context, or once to the stream."""

from __future__ import annotations

from types import SimpleNamespace
from typing import ClassVar

import torch

from dsfit.context import Context
from dsfit.errors import InputError
from dsfit.experiment.heuristic_mix import LEAST, balance_fractions, best_mix
from dsfit.experiment.methods import Setting
from dsfit.race.density import DensitySampler
from dsfit.race.mixed import mis_sampler
from dsfit.race.peer import Peer, Problem, Sampler
from dsfit.race.peers.chapter import proposals_of
from dsfit.race.samplers import EachSampler


def _setting(problem: Problem, context: Context) -> Setting:
    """Quadrature nodes and log densities at one context, as the methods of a comparison get them."""
    return Setting(SimpleNamespace(), problem.model, context.to(torch.float64))  # type: ignore[arg-type]


class BestMix(Peer):
    """Shares, heuristic and model of least variance at each context, on quadrature nodes there."""

    name: ClassVar[str] = "best_mix"
    per_context: ClassVar[bool] = True

    def prepare(self, problem: Problem) -> None:
        """Make the proposals, in the race's dtype and in the fit's."""
        self.problem = problem
        self.exact, self.fast = (proposals_of(problem, dtype) for dtype in (torch.float64, problem.dtype))

    def at(self, contexts: Context) -> Sampler:
        """Fit the shares of every context."""
        return EachSampler([self._one(contexts[k : k + 1]) for k in range(len(contexts))])

    def _one(self, context: Context) -> Sampler:
        best = best_mix(_setting(self.problem, context.reshape(())), list(self.exact.values()))
        kept = [(p, c) for p, c in zip(self.fast.values(), best.fractions, strict=True) if c > 0]
        total = sum(c for _, c in kept)
        shares = [c / total for _, c in kept]
        return mis_sampler(self.problem, [p for p, _ in kept], shares, context, best.heuristic, best.model)


class StreamMix(Peer):
    """One set of shares for the whole stream: those that minimise the mean over `contexts` contexts of the relative
    second moment of the balance heuristic, a convex problem.

    Args:
        contexts: contexts drawn from the stream to fit to.
    """

    name: ClassVar[str] = "stream_mix"

    def __init__(self, contexts: int = 24) -> None:
        if isinstance(contexts, bool) or not isinstance(contexts, int) or contexts < 1:
            raise InputError("stream_mix.contexts", contexts, "an integer >= 1")
        self.contexts = contexts

    def prepare(self, problem: Problem) -> None:
        """Quadrature nodes at every training context, then the shares."""
        generator = torch.Generator().manual_seed(problem.seed)
        exact, fast = (proposals_of(problem, dtype) for dtype in (torch.float64, problem.dtype))
        logs, squares = [], []
        for context in problem.stream.draw(self.contexts, generator).reshape(-1, 1):
            setting = _setting(problem, context.reshape(()))
            nodes = setting.nodes
            squares.append(nodes.weight * nodes.value.square().sum(-1) / (nodes.weight * nodes.norm).sum().square())
            logs.append(setting.log_p(list(exact.values())))
        shares, _ = balance_fractions(torch.cat(logs, dim=-1), torch.cat(squares))
        kept = shares >= LEAST
        self.problem = problem
        self.shares = (shares[kept] / shares[kept].sum()).tolist()
        self.proposals = [p for p, use in zip(fast.values(), kept.tolist(), strict=True) if use]

    def at(self, contexts: Context) -> Sampler:
        """The mixture with the fitted shares."""
        sampler = mis_sampler(self.problem, self.proposals, self.shares, contexts, "balance", "one")
        assert isinstance(sampler, DensitySampler)
        return sampler
