"""Local back scattering by the hair around the shading point: A_b, Delta_b, sigma_b (Zinke et al. 2008, eqs 13-17).

With x = a_f^2 and q = a_b/(1 - x) = r/(1 + a_f), r = a_b/(1 - a_f): r is in [0, 1] whenever a_f + a_b <= 1, so
everything stays bounded as a_f goes to 1.
"""

from __future__ import annotations

import torch
from torch import Tensor


def _back_ratio(a_f: Tensor, a_b: Tensor) -> Tensor:
    """q = a_b / (1 - a_f^2), with (1 - a_f)(1 + a_f) and a guard at a_f = 1, where a_b must vanish too."""
    gap = (1 - a_f) * (1 + a_f)
    eps = torch.finfo(a_f.dtype).eps ** 2
    return a_b / torch.where(gap.abs() < eps, eps, gap)


def backscatter_albedo(a_f: Tensor, a_b: Tensor) -> Tensor:
    """A_b = A_1 + A_3 = a_f^2 q + a_f^2 q^3: one and three back scattering events among any number of forward ones.

    At most 1/2 + 1/8 for a_f + a_b <= 1. Even numbers of events leave forwards and are dropped, as published.
    """
    q = _back_ratio(a_f, a_b)
    x = a_f * a_f
    return x * q + x * q**3


def back_shift(a_f: Tensor, a_b: Tensor, alpha_f: Tensor, alpha_b: Tensor, sign: str = "minus") -> Tensor:
    """Delta_b = alpha_b (1 -+ 2 q^2) + alpha_f (2 + 4 a_f^2 q^2)/(1 - a_f^2), radians.

    Published with the minus; averaging over events gives a plus (`sign="plus"`). Grows like 1/(1 - a_f^2), the mean
    number of forward events.
    """
    q2 = _back_ratio(a_f, a_b) ** 2
    gap = ((1 - a_f) * (1 + a_f)).clamp_min(torch.finfo(a_f.dtype).eps)
    signed = gap if bool((a_f.detach() <= 1).all()) else (1 - a_f) * (1 + a_f)
    turn = 1 - 2 * q2 if sign == "minus" else 1 + 2 * q2
    return alpha_b * turn + alpha_f * (2 + 4 * a_f * a_f * q2) / signed


def back_width(a_f: Tensor, a_b: Tensor, beta_f: Tensor, beta_b: Tensor, d_b: Tensor | float) -> Tensor:
    """sigma_b = (1 + d_b a_f^2) [sqrt(2 beta_f^2 + beta_b^2) + a_b^2 sqrt(2 beta_f^2 + 3 beta_b^2)] / [1 + a_b^2 (2
    beta_f + 3 beta_b)].

    A standard deviation, eq 17 divided through by a_b so that a_b = 0 is regular. The denominator mixes a number with
    an angle: it holds in radians only.
    """
    f2, b2, a2 = beta_f**2, beta_b**2, a_b**2
    top = torch.sqrt(2 * f2 + b2) + a2 * torch.sqrt(2 * f2 + 3 * b2)
    return (1 + d_b * a_f**2) * top / (1 + a2 * (2 * beta_f + 3 * beta_b))
