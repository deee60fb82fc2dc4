"""All samples of a fit so far, weighted as if drawn from the mixture of the laws that they came from.

Samples of T laws, n_t of q_t each and N together, get the density `qbar = sum_t (n_t / N) q_t`, the balance heuristic
(Veach and Guibas 1995): `(1 / N) sum g / qbar` is unbiased for `int g domega` whichever law a sample came from, as long
as no law depends on the samples reused. A fit's later laws do depend on its earlier samples; what that biases vanishes
like 1 / N, and judging is left to samples that no fit has seen.

Every law is evaluated at every sample, once: no further call of the integrand.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn

from dsfit.context import Context
from dsfit.fit.proposal_problem import Parameters
from dsfit.fit.stochastic.samples import Draws, sampling_law


class Replay:
    """Samples, and the parameters of the proposals that they were drawn from.

    Args:
        proposal: a float64 module that may be written to.
        context: `[B]`, float64.
        share: defensive share of the sampling laws.
    """

    def __init__(self, proposal: nn.Module, context: Context, share: float) -> None:
        self.proposal, self.context, self.share = proposal, context, share
        self.parameters = Parameters(proposal)
        self.laws: list[Tensor] = []
        self.counts: list[int] = []
        self.log_terms: list[list[Tensor]] = []  # for each batch of samples, log q_t of every law
        self.batches: list[Draws] = []

    def __len__(self) -> int:
        return sum(self.counts)

    def _log_law(self, y: Tensor, omega: Tensor) -> Tensor:
        self.parameters.assign(self.proposal, y)
        with torch.no_grad():
            return sampling_law(self.proposal, self.context, self.share).log_prob(omega)

    def add(self, drawn: Draws, y: Tensor) -> None:
        """Take in samples of the law with parameters `y`."""
        for batch, terms in zip(self.batches, self.log_terms, strict=True):
            terms.append(self._log_law(y, batch.omega))
        self.log_terms.append([*(self._log_law(past, drawn.omega) for past in self.laws), drawn.log_q])
        self.laws.append(y.clone())
        self.counts.append(len(drawn.omega))
        self.batches.append(drawn)

    def draws(self) -> Draws:
        """All samples, with log qbar for `log_q`."""
        shares = torch.log(torch.tensor(self.counts, dtype=torch.float64) / len(self))
        log_q = [
            torch.logsumexp(torch.stack(terms) + shares.to(terms[0]).reshape(-1, *[1] * terms[0].ndim), 0)
            for terms in self.log_terms
        ]
        fields = ("omega", "log_square", "log_length")
        omega, square, length = (torch.cat([getattr(batch, name) for batch in self.batches]) for name in fields)
        return Draws(omega, torch.cat(log_q), square, length, sum(batch.evaluations for batch in self.batches))

    def state(self) -> dict[str, Any]:
        """Everything to go on from, in tensors and lists."""
        names = ("omega", "log_q", "log_square", "log_length", "evaluations")
        batches = [{name: getattr(batch, name) for name in names} for batch in self.batches]
        return {"laws": list(self.laws), "terms": [list(terms) for terms in self.log_terms], "batches": batches}

    def load(self, state: dict[str, Any]) -> None:
        """Go on from there."""
        self.laws = list(state["laws"])
        self.log_terms = [list(terms) for terms in state["terms"]]
        self.batches = [Draws(**batch) for batch in state["batches"]]
        self.counts = [len(batch.omega) for batch in self.batches]


def log_mean_exp(x: Tensor) -> Tensor:
    """log of the mean of exp(x) over the first dimension."""
    return torch.logsumexp(x, 0) - math.log(len(x))
