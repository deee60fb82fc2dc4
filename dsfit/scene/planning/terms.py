"""Upper bounds on the integral of every term of F, and lower bounds on what any choice of terms leaves."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from dsfit.bsdf.dual_scattering import DualScattering
from dsfit.bsdf.forward import event_count, log_transmittance
from dsfit.frame import HALF_PI
from dsfit.scene.planning.averages import AverageBounds, average_bounds
from dsfit.scene.planning.boxes import Boxes
from dsfit.scene.planning.interval import ROUNDING, Interval, cosine
from dsfit.scene.planning.optics import Optics, optics
from dsfit.special import normal_mass

NAMES = tuple((half, name) for half in ("direct", "scattered") for name in ("R", "TT", "TRT", "back"))
"""The eight terms of F, in the order of every table here."""
TREATMENTS = (("direct", "glint"), ("scattered", "glint"))
"""What the treatment of TRT's caustic changes in either half."""
SUBSETS = torch.tensor(list(itertools.product((0.0, 1.0), repeat=len(NAMES))), dtype=torch.float64)
"""Every choice of terms to keep, `[256, 8]` of 0 and 1."""
_CELLS, _AT_ONCE = 256, 1_000_000
_ROOT = math.sqrt(2 * math.pi)


@dataclass(frozen=True)
class TermBounds:
    """Of int (term) domega under light of radiance 1, for boxes of contexts.

    Attributes:
        upper: of the eight terms, and of |treated - raw| of TRT in both halves, `[B, 10, C]`.
        peak: sup over directions of the same, per steradian; inf where nothing is proven.
        kept: lower bounds on the integral of every choice of terms, `[256, B, C]`.
    """

    upper: Tensor
    peak: Tensor
    kept: Tensor


def bound_terms(bsdf: DualScattering, boxes: Boxes, spread: Callable[[Boxes], tuple[Interval, Interval]]) -> TermBounds:
    """Bounds by upper and lower sums over cells of theta_h.

    With P = (cos theta_i / cos theta_diff)^2, d theta_i = 2 d theta_h, and lobes' masses exact in every cell:
    direct: v 2 c_M int g(theta_h - alpha_p; beta_p) E_p(theta_diff) P d theta_h, likewise scattered with the widened g,
    E^G_p and (1 - v) d_f a_f^n (or what a Poisson number passes on); back scattering with 4 A_b (2 in the back half
    alone) for E_p. In a cell where the standard deviation lies in [s_0, s_1], (s_0/s_1) g(x; s_0) <= g(x; s) <=
    (s_1/s_0) g(x; s_1).

    Args:
        bsdf: of one fibre.
        boxes: contexts.
        spread: n and v of the light that arrives, `[B, J]`, for boxes `[B]`: at every direction, they are in one of
            the J pairs of intervals.
    """
    n, v = spread(boxes)
    lit, unlit = v, Interval(1 - v.high, 1 - v.low)
    tables = optics(bsdf, scatters=bool((unlit.high > 0).any())), average_bounds(bsdf)
    if n.low.shape[1] > 1:
        parts = _in_chunks(bsdf, tables, boxes.theta_r, n, lit, unlit)
        low = None
        kept = torch.cat([p.kept for p in parts], dim=1)
    else:  # shares are factors: what differs in v alone is bounded once
        ends = torch.stack([boxes.theta_r.low, boxes.theta_r.high, n.low[:, 0], n.high[:, 0]], dim=-1)
        rows, which = torch.unique(ends, dim=0, return_inverse=True)
        theta, few = (Interval(rows[:, k], rows[:, k + 1]) for k in (0, 2))
        few = few.reshape(lambda x: x[:, None])
        whole = Interval.exactly(torch.ones_like(few.low))
        parts = _in_chunks(bsdf, tables, theta, few, whole, whole)
        low = torch.cat([p.low for p in parts])[which]
    upper, peak = (torch.cat([getattr(p, name) for p in parts]) for name in ("upper", "peak"))
    if low is not None:
        least, most = (_shares(lit, unlit, end) for end in ("low", "high"))
        upper, peak = (torch.where(most == 0, 0.0, x[which] * most) for x in (upper, peak))
        kept = torch.einsum("st,btc->sbc", SUBSETS, low * least[:, :8])
    return TermBounds(upper * (1 + ROUNDING), peak * (1 + ROUNDING), kept * (1 - ROUNDING))


def _shares(lit: Interval, unlit: Interval, end: str) -> Tensor:
    """Factors `[B, 10, 1]` of the terms and the two treatments."""
    near, far = getattr(lit, end), getattr(unlit, end)
    return torch.cat([near.expand(-1, 4), far.expand(-1, 4), near, far], dim=1).unsqueeze(-1)


@dataclass(frozen=True)
class _Sums:
    """Upper sums `[B, 10, C]`, largest values likewise; lower sums `[B, 8, C]`, or, where n varies with direction, of
    every choice of terms `[256, B, C]`, the least over n in every cell."""

    upper: Tensor
    peak: Tensor
    low: Tensor | None = None
    kept: Tensor | None = None


def _in_chunks(
    bsdf: DualScattering,
    tables: tuple[Optics, AverageBounds],
    theta_r: Interval,
    n: Interval,
    lit: Interval,
    unlit: Interval,
) -> list[_Sums]:
    size = n.low.shape[1] * _CELLS * 3 * bsdf.channels
    step = max(1, _AT_ONCE // (size if n.low.shape[1] == 1 else 16 * size))
    parts = []
    for start in range(0, len(theta_r.low), step):
        chosen = slice(start, start + step)
        rows = (Interval(x.low[chosen], x.high[chosen]) for x in (theta_r, n, lit, unlit))
        parts.append(_chunk(bsdf, *tables, *rows))
    return parts


def _chunk(
    bsdf: DualScattering,
    lobes: Optics,
    averages: AverageBounds,
    theta_r: Interval,
    n: Interval,
    lit: Interval,
    unlit: Interval,
) -> _Sums:
    cells = _Cells.of(theta_r)
    convention, fiber = bsdf.convention, bsdf.fiber.to(torch.float64)
    constant = 2 * convention.lobe_constant
    d_b, d_f = float(bsdf.d_b), float(bsdf.d_f)
    around = 4.0 if convention.back_azimuth == "all" else 2.0
    aside = math.pi if convention.back_factor == "pi" else 1.0

    def wide(x: Interval, dims: int) -> Interval:
        return x.reshape(lambda y: y.reshape(*y.shape, *(1,) * dims))

    def lobe(scale: Interval, energy: Interval, peak: Tensor) -> _Lobe:
        low = energy.low * cells.weight.low
        high, top = (
            torch.where(b == 0, 0.0, a * b) for a, b in ((energy.high, cells.weight.high), (peak, cells.height))
        )
        return _Lobe(Interval(low * constant, high * constant), top * (constant / 2), scale)

    # [B, J, K, lobes, C] from here on
    direct, scattered = lobes.direct.over(cells.diff), lobes.scattered.over(cells.diff)
    high = lobes.direct_peak.over(cells.diff).high.unsqueeze(1)
    high_scattered = lobes.scattered_peak.over(cells.diff).high.unsqueeze(1)
    treatment = lobes.treatment.over(cells.diff).reshape(lambda x: x[:, None, :, None])
    log_a, beta_f2, a_back, delta, sigma2 = (
        getattr(averages, name).over(cells.theta_i).reshape(lambda x: x.unsqueeze(1))
        for name in ("log_a_f", "beta_f2", "A_b", "delta_b", "sigma_b2")
    )
    count = wide(n, 2)
    # both laws pass on more for a larger a_f and for fewer fibres, and count more events for more of either
    law = convention.transmittance
    passed = Interval(
        torch.exp(log_transmittance(log_a.low, count.high, law).clamp_min(-1e4)),
        torch.exp(log_transmittance(log_a.high, count.low, law).clamp_min(-1e4)),
    ) * d_f**convention.density_power
    events = (event_count(torch.exp(a), n, law) for a, n in ((log_a.low, count.low), (log_a.high, count.high)))
    widened = beta_f2 * Interval(*events)
    share = wide(lit, 3)
    far = wide(unlit, 3) * passed.reshape(lambda x: x.unsqueeze(-2))
    alpha, beta = Interval.exactly(fiber.alpha[:, None]), fiber.beta[:, None]
    near = cells.gauss(alpha, Interval.exactly(beta))
    spread_out = cells.gauss(alpha, (widened.reshape(lambda x: x.unsqueeze(-2)) + beta**2).map(torch.sqrt))
    back, center = _one_lobe(a_back) * (around * d_b), _one_lobe(delta)
    back_near = cells.gauss(center, _one_lobe(sigma2).map(torch.sqrt))
    back_far = cells.gauss(center, _one_lobe(sigma2 + widened).map(torch.sqrt))
    flat = back.high / (around / 2 * math.pi)  # constant in azimuth
    rows = [
        lobe(share, direct.reshape(lambda x: x.unsqueeze(1)), high).times(near),
        lobe(share, back, flat).times(back_near),
        lobe(far, scattered.reshape(lambda x: x.unsqueeze(1)), high_scattered).times(spread_out),
        lobe(far * aside, back, flat).times(back_far),
        lobe(share, treatment, torch.full_like(treatment.high, math.inf)).times(near.last),
        lobe(far, treatment, torch.full_like(treatment.high, math.inf)).times(spread_out.last),
    ]
    shape = torch.broadcast_shapes(*(row[0].low.shape[:3] for row in rows))
    low, up, peak = (
        torch.cat([x.expand(*shape, *x.shape[3:]) for x in values], dim=3)
        for values in zip(*((mass.low, mass.high, top) for mass, top in rows), strict=True)
    )
    upper, top = up.amax(1).sum(1), peak.amax(1).amax(1)
    if shape[1] == 1:
        return _Sums(upper, top, low=low[:, 0, :, :8].sum(1))
    return _Sums(upper, top, kept=torch.einsum("st,bjktc->sbjkc", SUBSETS, low[..., :8, :]).amin(2).sum(2))


def _one_lobe(x: Interval) -> Interval:
    """`[..., C]` as the one lobe that back scattering is, `[..., 1, C]`."""
    return x.reshape(lambda y: y.unsqueeze(-2))


@dataclass(frozen=True)
class _Gauss:
    """Of g(theta_h - centre; s) in every cell: its mass, and its largest value."""

    mass: Interval
    top: Tensor

    @property
    def last(self) -> _Gauss:
        """Of the last lobe, TRT."""
        return _Gauss(self.mass.reshape(lambda x: x[..., 2:, :]), self.top[..., 2:, :])


@dataclass(frozen=True)
class _Lobe:
    energy: Interval
    peak: Tensor
    scale: Interval

    def times(self, gauss: _Gauss) -> tuple[Interval, Tensor]:
        """Contribution of every cell, and its largest value; what is multiplied by 0 is 0, bounded or not."""
        low = self.energy.low * gauss.mass.low * self.scale.low  # all are >= 0
        high, peak = (
            torch.where((a == 0) | (b == 0) | (self.scale.high == 0), 0.0, a * b * self.scale.high)
            for a, b in ((self.energy.high, gauss.mass.high), (self.peak, gauss.top))
        )
        return Interval(low, high), peak


@dataclass(frozen=True)
class _Cells:
    """Cells of theta_h `[B, K]` and what they can hold, given theta_r in its interval."""

    theta_h: Interval
    theta_i: Interval
    diff: Interval
    weight: Interval
    height: Tensor

    @staticmethod
    def of(theta_r: Interval) -> _Cells:
        r = theta_r.reshape(lambda x: x[:, None])
        low, high = r.low / 2 - math.pi / 4, r.high / 2 + math.pi / 4
        edges = low + (high - low) * torch.linspace(0.0, 1.0, _CELLS + 1, dtype=torch.float64)
        h = Interval(edges[:, :-1], edges[:, 1:])
        turned = h * 2.0 - r
        diff = (r - h).abs().clamp(0.0, HALF_PI)
        inside = cosine(turned).clamp(0.0)
        across = cosine(diff).clamp(1e-150)
        # cos theta_i / cos theta_diff = cos theta_h + sin theta_h tan theta_diff <= 2 cos theta_h
        ratio = (inside / across).clamp(0.0)
        ratio = Interval(ratio.low, torch.minimum(ratio.high, 2 * cosine(h).high.clamp_min(0.0)))
        wide = [x.reshape(lambda y: y[:, None, :, None, None]) for x in (ratio.square(), ratio / across)]
        return _Cells(h, turned.clamp(-HALF_PI, HALF_PI), diff, wide[0], wide[1].high)

    def gauss(self, center: Interval, s: Interval) -> _Gauss:
        """Enclosures of int g(theta_h - c; s) over each cell, c and s in intervals `[..., lobes, C]`."""
        x = self.theta_h.reshape(lambda y: y[:, None, :, None, None])
        near, far = s.low, s.high
        middle = (center.low + center.high) / 2
        # at most: the distance to the interval of centres, with the larger deviation
        inside = (torch.minimum(x.high, center.high) - torch.maximum(x.low, center.low)).clamp_min(0.0)
        most = _mass(x.low, torch.minimum(x.high, center.low), center.low, far)
        most = most + _mass(torch.maximum(x.low, center.high), x.high, center.high, far) + inside / (far * _ROOT)
        # at least: the distance to the farther end, with the smaller deviation
        least = _mass(x.low, torch.minimum(x.high, middle), center.high, near)
        least = least + _mass(torch.maximum(x.low, middle), x.high, center.low, near)
        distance = torch.maximum(center.low - x.high, x.low - center.high).clamp_min(0.0)
        width = torch.minimum(torch.maximum(distance, near), far)  # where g(distance; .) is largest
        top = torch.exp(-0.5 * (distance / width) ** 2) / (width * _ROOT)
        return _Gauss(Interval(least * (near / far), most * (far / near)), top)


def _mass(low: Tensor, high: Tensor, center: Tensor, s: Tensor) -> Tensor:
    """int_low^high g(x - center; s) dx, 0 for low >= high."""
    high = torch.maximum(low, high)
    return normal_mass((low - center) / s, (high - center) / s)
