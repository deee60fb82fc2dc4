"""What n fibres on the way of light do to it: the share that they pass on, and how far they spread it.

Every fibre that light meets passes a_f of it on and widens it by a Gaussian of variance beta_f^2 (eqs 8, 9, 32). Two
laws for how many fibres N a light path meets, where n are met on average:

power: always N = n, also where n is no integer: share a_f^n, variance n beta_f^2.

poisson: N is Poisson distributed, as it is where fibres lie independently of each other. Light that meets none is the
directly lit share, v = exp(-n). Of the rest, per unit of 1 - v,

    tau = E[a_f^N | N >= 1] = (exp(n a_f) - 1) / (exp(n) - 1) = a_f exp(-n (1 - a_f)) phi(n a_f) / phi(n),

phi(x) = (1 - exp(-x)) / x; no difference of near numbers is left, and tau = a_f for n = 0. Light that arrives after k
fibres has weight Poisson(k; n) a_f^k, proportional to Poisson(k; n a_f), k >= 1: a mixture of Gaussians of variances
beta_p^2 + k beta_f^2 whose variance is beta_p^2 + E[k] beta_f^2, with the energy-weighted count

    E[k] = n a_f / (1 - exp(-n a_f)) = 1 / phi(n a_f).

So one Gaussian with sigma_f^2 = E[k] beta_f^2 has the energy, the mean and the variance of the mixture. (The unweighted
count n / (1 - exp(-n)) is too large: what has met many fibres is dark.) Its tails are lighter than the mixture's: of
the sum over N, F_scatter differs by at most 6 % of its largest value (presets, n to 30).
"""

from __future__ import annotations

import torch
from torch import Tensor

_SERIES, _TERMS = 0.5, 15


def mean_exponential(x: Tensor) -> Tensor:
    """phi(x) = int_0^1 exp(-x t) dt = (1 - exp(-x)) / x, 1 at x = 0, for x > -0.5; to rounding, and its derivatives
    too."""
    near, large = x < _SERIES, torch.where(x < _SERIES, 1.0, x)
    return torch.where(near, _series(torch.where(near, x, 0.0)), -torch.expm1(-large) / large)


def _inverse_mean(x: Tensor) -> Tensor:
    """1 / phi(x) = x / (1 - exp(-x)); where phi is tiny, its square would be lost in the derivative of a quotient."""
    near, large = x < _SERIES, torch.where(x < _SERIES, 1.0, x)
    return torch.where(near, 1 / _series(torch.where(near, x, 0.0)), large / -torch.expm1(-large))


def _series(x: Tensor) -> Tensor:
    """1 - x/2 (1 - x/3 (1 - ...))."""
    series = torch.ones_like(x)
    for k in range(_TERMS, 1, -1):
        series = 1 - x * series / k
    return series


def transmittance(a_f: Tensor, n: Tensor, law: str) -> Tensor:
    """Share that is passed on, per unit of light that is scattered: a_f^n ("power") or tau ("poisson").

    Args:
        a_f: average forward attenuation, >= 0.
        n: mean number of fibres, >= 0; broadcasts with a_f.
        law: `Convention.transmittance`.
    """
    if law == "poisson":
        return a_f * torch.exp(-n * (1 - a_f)) * (mean_exponential(n * a_f) * _inverse_mean(n))
    return torch.pow(a_f.clamp_min(torch.finfo(a_f.dtype).tiny), n)  # 0^n has no derivative in n


def log_transmittance(log_a_f: Tensor, n: Tensor, law: str) -> Tensor:
    """log of `transmittance` from log a_f, for shares that are too small for floats."""
    if law == "poisson":
        met = n * torch.exp(log_a_f)
        return log_a_f + n * torch.expm1(log_a_f) + torch.log(mean_exponential(met) * _inverse_mean(n))
    return n * log_a_f


def event_count(a_f: Tensor, n: Tensor, law: str) -> Tensor:
    """How many fibres the light that is passed on has met, weighted by energy: sigma_f^2 = event_count beta_f^2."""
    return _inverse_mean(n * a_f) if law == "poisson" else n
