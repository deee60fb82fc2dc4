"""Twins of the averages of dual scattering, of back scattering, and of the whole F cos(theta_i) (Zinke et al. 2008).

The averages are integrals over the outgoing inclination of energies of the lobes, which are integrals over offsets. The
energies depend on theta_diff alone, so they are interpolated in it once for a fibre: Chebyshev series on panels that
end where the way of TRT changes (eta' = sqrt 2 and 2). That costs digits: 14 are left of the smaller averages, 17 of
most, some hundred times more than the library keeps. Arithmetic is done with `AVERAGE_DIGITS`, whatever mpmath is set
to, as differences need them; the error of the interpolation is smooth.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

from mpmath import mp

from dsfit.checks.stability.exact_bsdf import (
    Glint,
    Hair,
    Real,
    Section,
    lobe,
    lobe_treated,
    normal,
    wrap,
)
from dsfit.checks.stability.exact_bsdf_scattered import legendre, lobe_simplified, window, window_simplified

AVERAGE_DIGITS = 44
_DEGREE = 22
_OFFSETS = 12
_INCLINATIONS = 16


@dataclass(frozen=True)
class Coat:
    """A fibre with its longitudinal lobes (R, TT, TRT; radians of theta_h) and the density factors; eccentric sections
    are not averaged here.
    """

    hair: Hair
    alpha: tuple[Real, Real, Real]
    beta: tuple[Real, Real, Real]
    d_f: Real = 0.75
    d_b: Real = 0.75
    model: str = "marschner"


def kinks(hair: Hair) -> list[Real]:
    """theta_diff where eta' is sqrt 2 or 2: there the ray of TRT at phi = 0 appears or leaves."""
    found = []
    for index in (mp.sqrt(2), mp.mpf(2)):
        cos2 = (mp.mpf(hair.eta) ** 2 - 1) / (index**2 - 1)
        if cos2 < 1:
            found.append(mp.acos(mp.sqrt(cos2)))
    return found


def split_energy(p: int, hair: Hair, theta_diff: Real) -> tuple[Real, Real]:
    """int N_p |phi|/pi dphi and int N_p (1 - |phi|/pi) dphi, over offsets h >= 0 twice (the lobes are even)."""
    section = Section.at(hair.eta, hair.sigma_a, theta_diff)
    half = mp.pi / 2
    ends = [mp.mpf(0), *(half - mp.mpf(8) / 10 / 3**k for k in range(4)), half]
    if p == 2 and 2 > section.first > mp.sqrt(2):  # leaves at phi = 0 where gamma = 2 gamma_t
        ends.append(2 * mp.acos(section.first / 2))
    front, back = mp.mpf(0), mp.mpf(0)
    rule, ends = legendre(_OFFSETS, mp.prec), sorted(ends)
    for low, high in zip(ends[:-1], ends[1:], strict=True):
        for x, weight in rule:
            gamma = (low + high + (high - low) * x) / 2
            carried = section.carried(p, gamma) * mp.cos(gamma) * weight * (high - low) / 2
            share = abs(wrap(section.exit(p, gamma))) / mp.pi
            front += carried * share
            back += carried * (1 - share)
    return front, back


class Energies:
    """`split_energy` of one lobe of one fibre, interpolated over theta_diff."""

    def __init__(self, p: int, hair: Hair) -> None:
        half = mp.pi / 2
        # p light has a pole at cos = -1/sqrt(eta^2 + 1), just beyond grazing; an index near 1 has a boundary layer
        layer = [half / 2, half * 5 / 6, *([half * 15 / 16] if hair.eta < 1.2 else [])]
        self.ends = sorted({mp.mpf(0), half, *layer, *(kinks(hair) if p == 2 else [])})
        angles = [mp.pi * (2 * k + 1) / (2 * _DEGREE) for k in range(_DEGREE)]
        self.panels = []
        for low, high in zip(self.ends[:-1], self.ends[1:], strict=True):
            values = [split_energy(p, hair, (low + high + (high - low) * mp.cos(a)) / 2) for a in angles]
            waves = [[mp.cos(j * a) * (2 if j else 1) / _DEGREE for a in angles] for j in range(_DEGREE)]
            sides = list(zip(*values, strict=True))
            series = [[mp.fdot(zip(row, side, strict=True)) for row in waves] for side in sides]
            self.panels.append((low, high, series))

    def __call__(self, theta_diff: Real) -> tuple[Real, Real]:
        """Forward and backward energy."""
        x = abs(theta_diff)
        low, high, series = next(panel for panel in self.panels if x <= panel[1] or panel is self.panels[-1])
        t = (2 * x - low - high) / (high - low)
        waves = [mp.mpf(1), t]
        for _ in range(_DEGREE - 2):
            waves.append(2 * t * waves[-1] - waves[-2])
        return mp.fdot(zip(waves, series[0], strict=True)), mp.fdot(zip(waves, series[1], strict=True))


@functools.lru_cache(maxsize=256)
def energies_of(p: int, hair: Hair) -> Energies:
    """The interpolant, kept; fields of the hair that do not matter to it are to be left at their defaults."""
    return Energies(p, hair)


def share(p: int, coat: Coat, theta_in: Real) -> tuple[Real, Real]:
    """Forward and backward share a^p of one lobe at theta_in: int K E dtheta_o, K = c_M g cos(theta_in) cos(theta_o) /
    cos^2(theta_diff).
    """
    hair = Hair(mp.mpf(coat.hair.eta), mp.mpf(coat.hair.sigma_a))
    energies = energies_of(p, hair)
    alpha, beta = mp.mpf(coat.alpha[p]), mp.mpf(coat.beta[p])
    low, high = theta_in / 2 - mp.pi / 4, theta_in / 2 + mp.pi / 4  # theta_h
    ends = [low, high, *(alpha + k * beta for k in (-5, -2.5, 0, 2.5, 5))]
    if p == 2:
        ends += [theta_in + s * x for x in kinks(hair) for s in (-1, 1)]
    if hair.eta < 1.2:  # layers of the energies
        ends += [theta_in + s * x for x in energies.ends for s in (-1, 1)]
    ends += [theta_in]
    # cos(theta_o)/cos^2(theta_diff) changes over the distance of theta_in from grazing
    distance = mp.pi / 2 - abs(theta_in)
    steps = [distance / 2 * 2**k for k in range(0, 24) if distance / 2 * 2**k < 1]
    ends += [x for s in steps for x in (low + s, high - s)]
    near, far = max(low, alpha - 9 * beta), min(high, alpha + 9 * beta)
    ends = sorted({near, far, *(x for x in ends if near < x < far)}) if near < far else [low, high]
    front, back = mp.mpf(0), mp.mpf(0)
    rule = legendre(_INCLINATIONS, mp.prec)
    for a, b in zip(ends[:-1], ends[1:], strict=True):
        for x, weight in rule:
            theta_h = (a + b + (b - a) * x) / 2
            theta_diff, theta_o = theta_h - theta_in, 2 * theta_h - theta_in
            kernel = weight * (b - a) / 2 * normal(theta_h - alpha, beta) * mp.cos(theta_o) / mp.cos(theta_diff) ** 2
            forward, backward = energies(theta_diff)
            front += kernel * forward
            back += kernel * backward
    return front * mp.cos(theta_in), back * mp.cos(theta_in)


@dataclass(frozen=True)
class Averages:
    """a_f, a_b, and the shifts and widths, named as in the library."""

    a_f: Real
    a_b: Real
    alpha_f: Real
    alpha_b: Real
    beta_f: Real
    beta_b: Real


@functools.lru_cache(maxsize=4096)
def averages(coat: Coat, theta_in: Real) -> Averages:
    """Weighted by the lobes' shares; the variances, not the widths, are averaged; a pair above 1 is scaled down."""
    with mp.workdps(AVERAGE_DIGITS):
        shares = [share(p, coat, mp.mpf(theta_in)) for p in range(3)]
        found = []
        for i in (0, 1):
            whole = mp.fsum(s[i] for s in shares)
            shift = mp.fsum(s[i] * a for s, a in zip(shares, coat.alpha, strict=True)) / whole
            spread = mp.sqrt(mp.fsum(s[i] * mp.mpf(b) ** 2 for s, b in zip(shares, coat.beta, strict=True)) / whole)
            found.append((whole, shift, spread))
        (a_f, alpha_f, beta_f), (a_b, alpha_b, beta_b) = found
        over = max(mp.mpf(1), a_f + a_b)
        return Averages(a_f / over, a_b / over, alpha_f, alpha_b, beta_f, beta_b)


def back_albedo(a_f: Real, a_b: Real) -> Real:
    """A_b = A_1 + A_3, each the closed sum of its geometric series (Zinke et al. 2008, eqs 13, 14)."""
    gap = 1 - a_f**2
    if gap <= 0:  # the series have no sum
        return mp.nan
    return a_b * a_f**2 / gap + a_b**3 * a_f**2 / gap**3


def back_shift(a_f: Real, a_b: Real, alpha_f: Real, alpha_b: Real) -> Real:
    """Delta_b (eq 16)."""
    gap = 1 - a_f**2
    if gap <= 0:
        return mp.nan
    return alpha_b * (1 - 2 * a_b**2 / gap**2) + alpha_f * (2 * gap**2 + 4 * a_f**2 * a_b**2) / gap**3


def back_width(a_f: Real, a_b: Real, beta_f: Real, beta_b: Real, d_b: Real) -> Real:
    """sigma_b (eq 17); its limit where a_b = 0."""
    once, thrice = mp.sqrt(2 * beta_f**2 + beta_b**2), mp.sqrt(2 * beta_f**2 + 3 * beta_b**2)
    if a_b == 0:
        return (1 + d_b * a_f**2) * once
    top = a_b * once + a_b**3 * thrice
    return (1 + d_b * a_f**2) * top / (a_b + a_b**3 * (2 * beta_f + 3 * beta_b))


def azimuths(coat: Coat, theta_diff: Real, phi: Real, scattered: bool) -> list[Real]:
    """N_p or N^G_p of the three lobes."""
    hair = coat.hair
    if coat.model == "simplified":
        function = window_simplified if scattered else lobe_simplified
        return [function(p, hair, theta_diff, phi) for p in range(3)]
    if not scattered:
        return [lobe(0, hair, theta_diff, phi), lobe(1, hair, theta_diff, phi), lobe_treated(hair, theta_diff, phi)]
    glint = Glint.of(hair, theta_diff)
    return [window(p, hair, theta_diff, phi, glint if p == 2 else None) for p in range(3)]


def scattering(coat: Coat, theta_i: Real, theta_r: Real, phi: Real, n: Real, v: Real) -> Real:
    """F cos(theta_i) = [v (f_s + d_b f_back) + (1 - v) d_f a_f^n (f_s^G + d_b f_back^G)] cos(theta_i)."""
    theta_i, theta_r = mp.mpf(theta_i), mp.mpf(theta_r)
    half, diff = (theta_i + theta_r) / 2, (theta_r - theta_i) / 2
    mean = averages(coat, theta_i)
    albedo = back_albedo(mean.a_f, mean.a_b)
    shift = back_shift(mean.a_f, mean.a_b, mean.alpha_f, mean.alpha_b)
    width = back_width(mean.a_f, mean.a_b, mean.beta_f, mean.beta_b, mp.mpf(coat.d_b))
    direct, dimmed = mp.mpf(v), (1 - mp.mpf(v)) * coat.d_f * mean.a_f**n
    total = mp.mpf(0)
    for scattered, part, variance in ((False, direct, mp.mpf(0)), (True, dimmed, n * mean.beta_f**2)):
        if part == 0:
            continue
        widths = [mp.sqrt(mp.mpf(b) ** 2 + variance) for b in coat.beta]
        shapes = [normal(half - a, b) for a, b in zip(coat.alpha, widths, strict=True)]
        lobes = azimuths(coat, diff, phi, scattered)
        back = 2 * albedo * normal(half - shift, mp.sqrt(width**2 + variance)) / mp.pi
        total += part * (sum(m * x for m, x in zip(shapes, lobes, strict=True)) + coat.d_b * back)
    return total / 2 / mp.cos(diff) ** 2 * mp.cos(theta_i)
