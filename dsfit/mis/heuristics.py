"""MIS heuristics: how a direction's contribution is shared among the strategies that could have drawn it.

Multi-sample model (thesis chapter eq 2; Veach 1997, section 9.2): `sum_s 1/n_s sum_i w_s(x_si) F(x_si) / p_s(x_si)` is
unbiased if the weights sum to 1 wherever F is not 0 and w_s = 0 where p_s = 0. In the one-sample model the counts are
the probabilities c_s.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from dsfit.errors import InputError, as_number, as_real, check_choice


def log_effective(log_p: Tensor, counts: Tensor) -> Tensor:
    """log(n_s p_s) `[S, ...]` from log densities `[S, ...]` and counts (or fractions) `[S]`; checks the counts."""
    return log_p + torch.log(_checked(log_p, counts))


def _checked(log_p: Tensor, counts: Tensor) -> Tensor:
    """The counts `[S, 1, ...]` in the dtype of the log densities."""
    counts = as_real("counts", counts, log_p.dtype, log_p.device)
    if counts.shape != log_p.shape[:1] or not len(counts):
        raise InputError("counts", tuple(counts.shape), f"one count for each of {len(log_p)} strategies, at least one")
    if not bool((torch.isfinite(counts) & (counts >= 0)).all()) or not bool((counts > 0).any()):
        raise InputError("counts", counts.tolist(), "finite numbers >= 0, at least one of them positive")
    return counts.reshape(-1, *[1] * (log_p.ndim - 1))


def _relative(log_p: Tensor, counts: Tensor) -> Tensor:
    """log(n_s p_s / top), top the largest density of a strategy with n_s > 0; -inf where q_s = 0.

    The densities are divided first: next to a log in the thousands the digits of log n_s would be lost. Points where
    all are 0 get a top of 1.
    """
    counts = _checked(log_p, counts)
    log_p = torch.where(counts > 0, log_p, -torch.inf)
    top = log_p.detach().amax(dim=0)
    return log_p - torch.where(top > -torch.inf, top, 0.0) + torch.log(torch.where(counts > 0, counts, 1.0))


def _normalise(log_q: Tensor, power: float = 1.0) -> Tensor:
    """log(q_s^power / sum q^power), -inf where q_s = 0 or all are 0; log_q from `_relative`.

    Points where all are 0 are replaced before the sum, so that gradients stay finite.
    """
    alive = log_q.detach().amax(dim=0) > -torch.inf
    scaled = power * torch.where(alive, log_q, 0.0)
    return torch.where(alive, scaled - torch.logsumexp(scaled, dim=0), -torch.inf)


class Heuristic(ABC):
    """A weighting, as an object without state beyond its parameters."""

    @abstractmethod
    def log_weights(self, log_p: Tensor, counts: Tensor) -> Tensor:
        """Log weights `[S, ...]`; arguments as for `weights`."""

    def weights(self, log_p: Tensor, counts: Tensor) -> Tensor:
        """Weights `[S, ...]`, which sum to 1 over strategies where any n_s p_s > 0 and are all 0 elsewhere.

        Args:
            log_p: log densities `[S, ...]` of every strategy at each direction; -inf where a density is 0. Only
                differences enter, so densities may span the whole range of logs.
            counts: samples n_s of each strategy, or the probabilities c_s of the one-sample model, `[S]`, >= 0.

        Raises:
            InputError: counts negative, not finite, all 0 or of the wrong length.
        """
        return torch.exp(self.log_weights(log_p, counts))


@dataclass(frozen=True)
class Balance(Heuristic):
    """w_s = n_s p_s / sum_k n_k p_k (chapter eq 3; Veach 1997, section 9.2.2)."""

    def log_weights(self, log_p: Tensor, counts: Tensor) -> Tensor:
        return _normalise(_relative(log_p, counts))


@dataclass(frozen=True)
class Power(Heuristic):
    """w_s = (n_s p_s)^beta / sum_k (n_k p_k)^beta (Veach 1997, section 9.2.3); beta > 0."""

    beta: float = 2.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "beta", as_number("heuristic.beta", self.beta, 0.0, open_low=True))

    def log_weights(self, log_p: Tensor, counts: Tensor) -> Tensor:
        return _normalise(_relative(log_p, counts), self.beta)


@dataclass(frozen=True)
class Maximum(Heuristic):
    """w_s = 1 for the largest n_s p_s (Veach 1997, section 9.2.3); strategies that tie exactly share the weight."""

    def log_weights(self, log_p: Tensor, counts: Tensor) -> Tensor:
        log_q = _relative(log_p, counts)
        winner = (log_q == log_q.amax(dim=0)) & (log_q > -torch.inf)
        return torch.where(winner, -torch.log(winner.sum(dim=0).clamp_min(1).to(log_q.dtype)), -torch.inf)


@dataclass(frozen=True)
class Cutoff(Heuristic):
    """Balance among the strategies with n_s p_s >= alpha max_k n_k p_k, 0 for the others; 0 <= alpha <= 1.

    Veach 1997, section 9.2.3.
    """

    alpha: float = 0.1

    def __post_init__(self) -> None:
        object.__setattr__(self, "alpha", as_number("heuristic.alpha", self.alpha, 0.0, 1.0))

    def log_weights(self, log_p: Tensor, counts: Tensor) -> Tensor:
        log_q = _relative(log_p, counts)
        threshold = log_q.detach().amax(dim=0) + (math.log(self.alpha) if self.alpha > 0 else -math.inf)
        return _normalise(torch.where(log_q.detach() >= threshold, log_q, -torch.inf))


@dataclass(frozen=True)
class Optimal(Heuristic):
    """The weights of least variance (Kondapaneni et al. 2019, Optimal multiple importance sampling).

    With the mixture P = sum_k c_k p_k, c_k = n_k / N, and per channel of F:
    `w_s = alpha_s p_s / F + c_s p_s / P (1 - sum_k alpha_k p_k / F)`, `A alpha = b`, `A_jk = ∫ p_j p_k / P`, `b_j = ∫ F
    p_j / P`. They can be negative and depend on F. The estimator is `sum_k alpha_k + sum_s c_s mean_s[(F - sum_k
    alpha_k p_k) / P]`: balance with the densities as control variates. `estimate` finds alpha by cross-fitting; see
    `dsfit.mis.optimal`.

    `rcond`: eigenvalues of the scaled matrix sqrt(c_j c_k) A_jk, whose largest is 1, count as 0 below this (duplicate
    strategies); left out, 100 eps of the dtype.
    """

    rcond: float | None = None

    def __post_init__(self) -> None:
        if self.rcond is not None:
            object.__setattr__(self, "rcond", as_number("heuristic.rcond", self.rcond, 0.0, 1.0, open_high=True))

    def log_weights(self, log_p: Tensor, counts: Tensor) -> Tensor:
        raise InputError("heuristic", "optimal", "weights(log_p, counts, value, alpha): signed, per channel of F")

    def weights(
        self, log_p: Tensor, counts: Tensor, value: Tensor | None = None, alpha: Tensor | None = None
    ) -> Tensor:
        """Signed weights `[S, ..., C]` given F `[..., C]` and `alpha [..., S, C]`; balance where F = 0."""
        if value is None or alpha is None:
            raise InputError("heuristic", "optimal without value and alpha", "weights(log_p, counts, value, alpha)")
        balance = Balance().weights(log_p, counts)
        density = torch.exp(log_p)
        control = torch.einsum("s...,...sc->...c", density, alpha)
        zero = value == 0
        safe = torch.where(zero, 1.0, value)
        own = torch.einsum("s...,...sc->s...c", density, alpha)
        weights = own / safe + balance.unsqueeze(-1) * (1 - control / safe)
        return torch.where(zero, balance.unsqueeze(-1), weights)


HEURISTICS: dict[str, type[Heuristic]] = {
    "balance": Balance,
    "power": Power,
    "maximum": Maximum,
    "cutoff": Cutoff,
    "optimal": Optimal,
}
"""Names that `heuristic` knows; add a class here to make it known to configs."""


def heuristic(kind: str | Mapping[str, Any] | Heuristic, **parameters: Any) -> Heuristic:
    """The heuristic of that name: `heuristic("power", beta=2)` or `heuristic({"kind": "power", "beta": 2})`; objects
    pass through.

    Raises:
        InputError: unknown name or parameter, or a parameter out of range.

    Example:
        >>> import torch
        >>> from dsfit.mis import heuristic
        >>> log_p = torch.log(torch.tensor([3.0, 1.0], dtype=torch.float64))
        >>> heuristic("balance").weights(log_p, torch.ones(2)).tolist()
        [0.75, 0.25]
        >>> [round(w, 4) for w in heuristic("power").weights(log_p, torch.ones(2)).tolist()]
        [0.9, 0.1]
    """
    if isinstance(kind, Heuristic):
        if parameters:
            raise InputError("heuristic", parameters, "no parameters beside a heuristic object")
        return kind
    if isinstance(kind, Mapping):
        parameters = {**{k: v for k, v in kind.items() if k != "kind"}, **parameters}
        kind = kind.get("kind", "")
    cls = HEURISTICS[check_choice("heuristic", kind, tuple(HEURISTICS))]
    known = tuple(getattr(cls, "__dataclass_fields__", {}))
    for name in parameters:
        check_choice(f"heuristic {kind!r} parameter", name, known)
    return cls(**parameters)
