"""Enclosures of attenuations and azimuthal energies over |theta_diff|.

Proofs, for one internal angle gamma in [0, pi/2] and d = |theta_diff| in [0, pi/2], m = eta^2 - 1, c = cos d cos gamma:
- Fresnel. r_s = (g - c)/(g + c) with g = sqrt(m + c^2) falls with c and rises with eta; r_p = (x - 1)/(x + 1) rises
  with x = eta^2 c / g, which rises with c. So r_s and r_p are enclosed by their values at the ends, and F by the sum of
  squares: no monotony of F itself, which is not monotone for a large index, is used.
- Absorption. With kappa = cos d / sqrt(m + cos^2 d), cos gamma_t = sqrt(1 - kappa^2 sin^2 gamma) and cos theta_t =
  sqrt(m + cos^2 d) / eta: cos gamma_t / cos theta_t rises with d and falls with gamma, so the least depth of a cell is
  at its smallest d and largest gamma.
- Energies. E_p = int N_p dphi = int_0^1 A(p, h) dh lies between the lower and the upper sum over cells of h.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from dsfit.bsdf.dual_scattering import DualScattering
from dsfit.bsdf.fiber import Fiber
from dsfit.frame import HALF_PI
from dsfit.scene.planning.interval import Interval, RangeTable

_ROWS, _OFFSETS = 512, 256
_TINY = 1e-300


@dataclass(frozen=True)
class Optics:
    """Enclosures over |theta_diff|, each over `[..., 3, C]` for R, TT, TRT.

    Attributes:
        direct: int |N_p| dphi; `scattered`: int |N^G_p| dphi.
        direct_peak, scattered_peak: sup over azimuth of |N_p|, |N^G_p| (low ends 0; inf where nothing is proven).
        treatment: int |N_TRT as treated - raw N_TRT| dphi, `[..., C]`.
    """

    direct: RangeTable
    scattered: RangeTable
    direct_peak: RangeTable
    scattered_peak: RangeTable
    treatment: RangeTable


def optics(bsdf: DualScattering, scatters: bool = True) -> Optics:
    """Enclosures of a BSDF of one fibre, whose azimuths carry the lobes' energies.

    Where nothing scattered is asked about, no table of N^G is made for it: `scattered` is then that of the exact N^G.
    """
    fiber = bsdf.fiber.to(torch.float64)
    breaks = torch.linspace(0.0, HALF_PI, _ROWS + 1, dtype=torch.float64)
    d = Interval(breaks[:-1, None], breaks[1:, None])
    gamma_breaks = torch.linspace(0.0, HALF_PI, _OFFSETS + 1, dtype=torch.float64)
    gamma = Interval(gamma_breaks[:-1], gamma_breaks[1:])
    width = (torch.sin(gamma.high) - torch.sin(gamma.low))[:, None]
    absorption = bsdf.convention.absorption
    raw, peaks = [], []
    for p in range(3):
        value = attenuation(p, index_of(fiber, p), d, gamma, fiber.sigma_a, absorption)
        raw.append(value.reshape(lambda x: (x * width).sum(1)))
        peaks.append(value.high.amax(1))
    energies, added = list(raw), torch.zeros_like(raw[2].high)
    if bsdf.model == "marschner" and bsdf.terms.glint:
        energies[2], added = _treated(fiber, raw[2], d, absorption)
    direct = _stack(energies)
    tabulated = scatters and bsdf.precision == "table"
    scattered, scattered_peak = _scattered(bsdf, direct, breaks, tabulated)
    if not fiber.is_round:  # the index of TRT turns with phi: no integral over offsets
        direct = Interval(_with_trt(direct.low, 0.0), _with_trt(direct.high, math.inf))
    zero = torch.zeros_like(direct.high)
    changed = torch.full_like(added, math.inf) if not fiber.is_round else added
    return Optics(
        RangeTable(breaks, direct),
        RangeTable(breaks, scattered),
        RangeTable(breaks, Interval(zero, _direct_peak(bsdf, d, peaks, direct.high))),
        RangeTable(breaks, Interval(zero, scattered_peak)),
        RangeTable(breaks, Interval(torch.zeros_like(changed), changed)),
    )


def index_of(fiber: Fiber, p: int) -> Interval:
    """The index that lobe p sees: of TRT in an eccentric fibre, between those of the two axes."""
    if p < 2 or fiber.is_round:
        return Interval.exactly(fiber.eta)
    ends = [fiber.eta_trt(torch.tensor(angle, dtype=torch.float64)) for angle in (0.0, HALF_PI)]
    return Interval(torch.minimum(*ends), torch.maximum(*ends))


def attenuation(p: int, eta: Interval, d: Interval, gamma: Interval, sigma_a: Tensor, absorption: str) -> Interval:
    """A(p, h) over cells of d and gamma that broadcast; `[..., C]`."""
    cos_d, cos_gamma = d.falling(torch.cos).clamp(0.0), gamma.falling(torch.cos).clamp(0.0)
    reflected = _fresnel(eta, cos_d * cos_gamma).reshape(lambda x: x.unsqueeze(-1))
    if p == 0:
        return reflected.reshape(lambda x: x.expand(*x.shape[:-1], len(sigma_a)))
    depth = _depth(eta, cos_d, gamma.map(torch.sin), absorption)
    through = Interval(*(torch.exp(-p * x.unsqueeze(-1) * sigma_a) for x in (depth.high, depth.low)))
    passed = Interval(1 - reflected.high, 1 - reflected.low).clamp(0.0)
    value = passed.square() * through
    return value * reflected if p == 2 else value


def _fresnel(eta: Interval, c: Interval) -> Interval:
    m = Interval((eta.low - 1) * (eta.low + 1), (eta.high - 1) * (eta.high + 1))
    g = Interval(torch.sqrt(m.low + c.low**2), torch.sqrt(m.high + c.high**2))
    r_s = Interval(m.low / (torch.sqrt(m.low + c.high**2) + c.high) ** 2, m.high / (_root(m.high, c.low) + c.low) ** 2)
    exact = bool((eta.low == eta.high).all())
    slow = Interval(eta.low**2 * c.low, eta.high**2 * c.high)
    x = Interval(slow.low / _root(m.low, c.low), slow.high / _root(m.high, c.high)) if exact else slow / g
    r_p = x.map(lambda value: (value - 1) / (value + 1))
    return ((r_s.square() + r_p.square()) * 0.5).clamp(0.0, 1.0)


def _root(m: Tensor, c: Tensor) -> Tensor:
    return torch.sqrt(m + c * c)


def _kappa(eta: Interval, cos_d: Interval) -> Interval:
    """1 / eta' = cos d / sqrt(eta^2 - 1 + cos^2 d): rises with cos d, falls with eta."""
    low = cos_d.low / _root((eta.high - 1) * (eta.high + 1), cos_d.low)
    return Interval(low, cos_d.high / _root((eta.low - 1) * (eta.low + 1), cos_d.high))


def _depth(eta: Interval, cos_d: Interval, h: Interval, absorption: str) -> Interval:
    """Path per internal segment in radii, 2 cos gamma_t / cos theta_t (or 4 cos^2 gamma_t / cos theta_t)."""

    def cos_gamma_t(kappa: Tensor, sine: Tensor) -> Tensor:
        return torch.sqrt((1 - (kappa * sine) ** 2).clamp_min(0.0))

    def cos_theta_t(index: Tensor, cosine: Tensor) -> Tensor:
        return _root((index - 1) * (index + 1), cosine) / index

    kappa = _kappa(eta, cos_d)
    low, high = cos_gamma_t(kappa.high, h.high), cos_gamma_t(kappa.low, h.low)
    if absorption != "geometric":
        low, high = 2 * low**2, 2 * high**2
    return Interval(2 * low / cos_theta_t(eta.high, cos_d.high), 2 * high / cos_theta_t(eta.low, cos_d.low))


def _treated(fiber: Fiber, raw: Interval, d: Interval, absorption: str) -> tuple[Interval, Tensor]:
    """Energy of TRT with its caustic treated, and a bound on int |treated - raw| dphi.

    The removal factor lies in [(1 - t)^2, 1], t the fade, so at most 1 - (1 - t)^2 of the raw energy goes; two
    Gaussians of at most t k_G Delta h A(2, h_c) each come, with Delta h <= Delta h_M and h_c in the interval of its
    kappa.
    """
    eta = index_of(fiber, 2)
    kappa = _kappa(eta, d.falling(torch.cos).clamp(0.0))
    fade = _fade(fiber, kappa)
    carried = attenuation(2, eta, d, kappa.map(_caustic_offset), fiber.sigma_a, absorption).high.squeeze(1)
    added = 2 * fade.high * fiber.glint_scale * fiber.caustic_max_offset * carried
    removed = 1 - (1 - fade.high) ** 2
    return Interval(raw.low * (1 - removed), raw.high + added), removed * raw.high + added


def _fade(fiber: Fiber, kappa: Interval) -> Interval:
    """t = 1 - smoothstep of eta' between 2 and 2 + Delta eta': rises with kappa."""

    def fade(x: Tensor) -> Tensor:
        over = ((1 / x.clamp_min(_TINY) - 2) / fiber.caustic_fade).clamp(0.0, 1.0)
        return 1 - over * over * (3 - 2 * over)

    return kappa.map(fade)


def _caustic_offset(kappa: Tensor) -> Tensor:
    """gamma_c, tan^2 gamma_c = (4 kappa^2 - 1)/(1 - kappa^2); 0 for kappa <= 1/2. Rises with kappa."""
    opposite = ((2 * kappa - 1) * (2 * kappa + 1)).clamp_min(0.0)
    return torch.atan2(torch.sqrt(opposite), torch.sqrt(((1 - kappa) * (1 + kappa)).clamp_min(0.0)))


def _scattered(bsdf: DualScattering, energy: Interval, breaks: Tensor, tabulated: bool) -> tuple[Interval, Tensor]:
    """int |N^G| dphi and sup |N^G|.

    N^G is 1/pi times the mass of N in a half circle: its integral is that of N, its largest value at most E / pi. Of an
    eccentric fibre, whose index is held during the average, only the last is known, so its integral is at most 2 E. The
    quadrature of the exact N^G is good to 1e-8. A table is bounded by itself: by its coefficients around each cell.
    """
    if not tabulated:
        slack = 1e-6
        low, high, peak = energy.low * (1 - slack), energy.high * (1 + slack), energy.high * (1 + slack) / math.pi
        if not bsdf.fiber.is_round:
            low, high = _with_trt(low, 0.0), torch.cat([high[:, :2], 2 * high[:, 2:]], dim=1)
        return Interval(low, high), peak
    table = bsdf.scattered_table.coefficients
    rows, columns = table.shape[0] - 3, table.shape[1] - 3
    mass = torch.full((columns + 3,), 1.0, dtype=table.dtype)  # of the B-splines inside [0, pi], in steps
    edge = torch.tensor([1 / 24, 1 / 2, 23 / 24], dtype=table.dtype)
    mass[:3], mass[-3:] = edge, edge.flip(0)
    step = 2 * math.pi / columns
    signed = torch.einsum("ijpc,j->ipc", table, mass) * step
    size = torch.einsum("ijpc,j->ipc", table.abs(), mass) * step
    first = (breaks[:-1] * (rows / HALF_PI) + 1e-9).to(torch.int64).clamp_max(rows - 1)
    last = (breaks[1:] * (rows / HALF_PI) - 1e-9).to(torch.int64).clamp_max(rows - 1)
    around = torch.stack([first + k for k in range(4)] + [last + k for k in range(4)])
    low = signed[around].amin(0).clamp_min(0.0)
    return Interval(low, size[around].amax(0)), table.abs().amax(1)[around].amax(0)


def _direct_peak(bsdf: DualScattering, d: Interval, peaks: list[Tensor], energy: Tensor) -> Tensor:
    """sup over azimuth of N_p, `[rows, 3, C]`.

    R: A cos(gamma)/4 <= A/4. TT: |dh/dphi| = cos gamma cos gamma_t (kappa cos gamma + cos gamma_t)/(2 (1 - kappa^2)) <=
    1/(2 (1 - kappa)). TRT: nothing is proven (its caustic).
    """
    if bsdf.model == "simplified":
        fiber = bsdf.fiber.to(torch.float64)
        gaussian = 1 / (fiber.gamma_tt * math.sqrt(2 * math.pi)) + 1 / math.pi  # all images together
        cosine = torch.full_like(gaussian, 0.25)
        return energy * torch.stack([cosine, gaussian, cosine])[:, None]
    eta = Interval.exactly(bsdf.fiber.eta.to(torch.float64))
    kappa = _kappa(eta, d.falling(torch.cos).clamp(0.0)).high
    return torch.stack([peaks[0] / 4, peaks[1] / (4 * (1 - kappa)), torch.full_like(peaks[2], math.inf)], dim=1)


def _stack(parts: list[Interval]) -> Interval:
    return Interval(torch.stack([x.low for x in parts], dim=1), torch.stack([x.high for x in parts], dim=1))


def _with_trt(values: Tensor, trt: float) -> Tensor:
    return torch.cat([values[:, :2], torch.full_like(values[:, 2:], trt)], dim=1)
