"""Rows of the atlas: weights of multiple importance sampling, and densities of mixtures."""

from __future__ import annotations

import mpmath as mp
import torch
from torch import Tensor

from dsfit.checks.stability.function import Function, Point
from dsfit.checks.stability.limits import FEW_ULPS, within
from dsfit.mis.heuristics import Balance, Heuristic, Power
from dsfit.proposals.mixture import log_sum_exp

COUNTS = (1.0, 3.0)


def _weight(rule: Heuristic, log_p: Tensor, log_q: Tensor) -> Tensor:
    """The first strategy's weight."""
    return rule.weights(torch.stack([log_p, log_q]), torch.tensor(COUNTS, dtype=log_p.dtype))[0]


def _weight_twin(power: int, log_p: mp.mpf, log_q: mp.mpf) -> mp.mpf:
    return 1 / (1 + (mp.mpf(COUNTS[1]) / mp.mpf(COUNTS[0]) * mp.exp(log_q - log_p)) ** power)


def _naive_weight(power: int, log_p: Tensor, log_q: Tensor) -> Tensor:
    p, q = (COUNTS[0] * torch.exp(log_p)) ** power, (COUNTS[1] * torch.exp(log_q)) ** power
    return p / (p + q)


_PAIRS: dict[str, list[Point]] = {
    "ordinary": [(-1.0, 0.4), (2.0, 1.1), (0.3, 0.1), (-7.0, -4.0)],
    "narrow: log densities in the thousands": [(5000.0, 4999.0), (5000.0, 5003.0), (1e5, 1e5 - 0.5)],
    "tail: logs far below 0": [(-5000.0, -5003.0), (-5000.0, -4999.5), (-1e6, -1e6 + 2.0)],
    "small: one strategy far above the other": [
        (0.0, -30.0),
        (-30.0, 0.0),
        (3.0, -690.0),
        (-300.0, 3.0),
        (-4000.0, 10.0),
    ],
}


def _log_mixture(log_p: Tensor, log_q: Tensor) -> Tensor:
    weights = torch.log(torch.tensor([0.9, 0.1], dtype=torch.float64)).to(log_p.dtype)
    return log_sum_exp(torch.stack([log_p, log_q], dim=-1) + weights)


def _log_mixture_twin(log_p: mp.mpf, log_q: mp.mpf) -> mp.mpf:
    top = max(log_p, log_q)
    return top + mp.log(mp.mpf(0.9) * mp.exp(log_p - top) + mp.mpf(0.1) * mp.exp(log_q - top))


def _vanishing(*_: float) -> float:
    """Derivatives of a weight below this are nothing to a sum of weights that is 1."""
    return 1.0


FUNCTIONS: list[Function] = [
    Function(
        "mis.balance",
        ("log_p", "log_q"),
        lambda log_p, log_q: _weight(Balance(), log_p, log_q),
        lambda log_p, log_q: _weight_twin(1, log_p, log_q),
        _PAIRS,
        naive=lambda log_p, log_q: _naive_weight(1, log_p, log_q),
        gradient_scale=_vanishing,
        density=True,
        limits=FEW_ULPS,
        loose={
            "small": within(2e-14, 1e-14, 3e-6, 1e-5),
        },
    ),
    Function(
        "mis.power",
        ("log_p", "log_q"),
        lambda log_p, log_q: _weight(Power(2.0), log_p, log_q),
        lambda log_p, log_q: _weight_twin(2, log_p, log_q),
        _PAIRS,
        naive=lambda log_p, log_q: _naive_weight(2, log_p, log_q),
        gradient_scale=_vanishing,
        density=True,
        limits=FEW_ULPS,
        loose={
            "small": within(3e-14, 1e-14, 5e-6, 1e-5),
        },
    ),
    Function(
        "mixture.log_density",
        ("log_p", "log_q"),
        _log_mixture,
        _log_mixture_twin,
        _PAIRS,
        naive=lambda log_p, log_q: torch.log(0.9 * torch.exp(log_p) + 0.1 * torch.exp(log_q)),
        logarithm=True,
        limits=FEW_ULPS,
        loose={
            "narrow": within(2e-15, 3e-12, 2e-6, 3e-2),
            "tail": within(2e-15, 9e-11, 2e-6, 3e-2),
        },
    ),
]
