"""Enclosures of the averages a_f, a_b, beta_f, A_b, Delta_b, sigma_b over theta_in.

The shares a_f^p, a_b^p of the BSDF are Chebyshev series on panels. On a cell with centre t_c and half width s of the
panel's coordinate, |p(t) - p(t_c)| <= s sum_k |c_k| k^2, for |T_k'| <= k^2 (Markov). What is made of them follows by
interval arithmetic; A_b = x q + x q^3, x = a_f^2, q = a_b / (1 - x), rises with both a_f and a_b.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dsfit.bsdf.backscatter import backscatter_albedo
from dsfit.bsdf.dual_scattering import DualScattering
from dsfit.frame import HALF_PI
from dsfit.quadrature import PiecewiseChebyshev
from dsfit.scene.planning.interval import Interval, RangeTable, cosine

_CELLS = 2048
_SERIES_ROUNDING = 1e-13


@dataclass(frozen=True)
class AverageBounds:
    """Enclosures over theta_in, each over `[..., C]`: log a_f, beta_f^2, A_b, Delta_b, sigma_b^2."""

    log_a_f: RangeTable
    beta_f2: RangeTable
    A_b: RangeTable
    delta_b: RangeTable
    sigma_b2: RangeTable


def average_bounds(bsdf: DualScattering) -> AverageBounds:
    """Enclosures for a BSDF of one fibre whose convention limits a_f + a_b to 1."""
    fiber, convention = bsdf.fiber.to(torch.float64), bsdf.convention
    series = bsdf.share_series
    uniform = torch.linspace(-HALF_PI, HALF_PI, _CELLS + 1, dtype=torch.float64)
    breaks = torch.unique(torch.cat([uniform, series.low, series.high]).clamp(-HALF_PI, HALF_PI))
    theta = Interval(breaks[:-1], breaks[1:])
    scaled = enclose(series, theta).reshape(lambda x: x.reshape(len(x), 2, 3, -1))
    projection = cosine(theta).clamp(0.0).reshape(lambda x: x[:, None, None, None])
    shares = (scaled * projection).clamp(0.0)
    front, back = (shares.reshape(lambda x, half=half: x[:, half]) for half in range(2))
    alpha, beta = fiber.alpha[:, None], fiber.beta[:, None]
    a_f, a_b = (half.reshape(lambda x: x.sum(1)) for half in (front, back))
    if convention.mean_width == "variance":
        beta_f2, beta_b2 = _mean(front, beta**2), _mean(back, beta**2)
    else:
        beta_f2, beta_b2 = _mean(front, beta).square(), _mean(back, beta).square()
    alpha_f, alpha_b = _mean(front, alpha), _mean(back, alpha)
    total = Interval((a_f.low + a_b.low).clamp_min(1.0), (a_f.high + a_b.high).clamp_min(1.0))
    a_f, a_b = (a_f / total).clamp(0.0, 1.0), (a_b / total).clamp(0.0, 1.0)
    log_a_f = a_f.map(lambda x: torch.log(x.clamp_min(torch.finfo(torch.float64).tiny)))
    return AverageBounds(
        RangeTable(breaks, log_a_f),
        RangeTable(breaks, beta_f2),
        RangeTable(breaks, _albedo(a_f, a_b)),
        RangeTable(breaks, _shift(a_f, a_b, alpha_f, alpha_b, convention.shift_sign)),
        RangeTable(breaks, _width(a_f, a_b, beta_f2, beta_b2, float(bsdf.d_b)).square()),
    )


def enclose(series: PiecewiseChebyshev, x: Interval) -> Interval:
    """What a piecewise series can be on cells `[G]` that no panel's end divides; `[G, V]`."""
    middle = (x.low + x.high) / 2
    inner = series.low[1:].contiguous()
    panel = torch.searchsorted(inner, middle.contiguous(), right=True)
    width = (series.high - series.low)[panel]
    size = series.coefficients.detach().abs()[:, panel]
    degree = torch.arange(len(size), dtype=size.dtype)
    slope = torch.einsum("k,kgv->gv", degree**2, size)
    reach = ((x.high - x.low) / width)[:, None] * slope + _SERIES_ROUNDING * size.sum(0)
    center = series(middle).detach().reshape(len(middle), -1)
    return Interval(center - reach, center + reach)


def _mean(share: Interval, value: Tensor) -> Interval:
    """sum_p share_p value_p / sum_p share_p, within the extremes of value; the library adds sqrt(tiny) to shares."""
    tiny = torch.finfo(torch.float64).tiny ** 0.5
    weight = share + tiny
    # sum_p w_p (value_p - least) / sum_p w_p: numbers of one sign, whose interval quotient stays narrow
    least = value.amin(0, keepdim=True)
    top = (weight * (value - least)).reshape(lambda x: x.sum(1))
    bottom = weight.reshape(lambda x: x.sum(1))
    low, high = top.low / bottom.high, top.high / bottom.low
    return Interval(low + least[0], torch.minimum(high + least[0], value.amax(0)))


def _albedo(a_f: Interval, a_b: Interval) -> Interval:
    """A_b; with a_f + a_b <= 1 it is at most 1/2 + 1/8."""
    high = backscatter_albedo(a_f.high, a_b.high)
    return Interval(backscatter_albedo(a_f.low, a_b.low), torch.where(a_f.high < 1, high, 0.625).clamp_max(0.625))


def _shift(a_f: Interval, a_b: Interval, alpha_f: Interval, alpha_b: Interval, sign: str) -> Interval:
    """Delta_b = alpha_b (1 -+ 2 q^2) + alpha_f (2 + 4 x q^2) / (1 - x)."""
    x = a_f.square()
    gap = Interval(1 - x.high, 1 - x.low).clamp(torch.finfo(torch.float64).eps)
    q2 = (a_b / gap).square()
    turn = q2 * (-2.0 if sign == "minus" else 2.0) + 1.0
    return alpha_b * turn + alpha_f * ((x * q2 * 4.0 + 2.0) / gap)


def _width(a_f: Interval, a_b: Interval, beta_f2: Interval, beta_b2: Interval, d_b: float) -> Interval:
    """sigma_b of `back_width`, by interval arithmetic."""
    a2 = a_b.square()
    top = (beta_f2 * 2.0 + beta_b2).map(torch.sqrt) + a2 * (beta_f2 * 2.0 + beta_b2 * 3.0).map(torch.sqrt)
    bottom = a2 * (beta_f2.map(torch.sqrt) * 2.0 + beta_b2.map(torch.sqrt) * 3.0) + 1.0
    return (a_f.square() * d_b + 1.0) * top / bottom
