"""Twins of what multiple scattering does to the lobes: half-circle averages N^G, energies, widened Gaussians.

Integrals over offsets are composite Gauss-Legendre sums in gamma (h = sin gamma) on panels that end where a ray leaves
at an edge of the window, at a turning point, at the flanks of a removed caustic, and that shrink geometrically towards
grazing offsets, where an index near 1 makes a boundary layer. With 16 nodes a panel they are right to 20 digits or
more, and smooth in every parameter, so that differences of them are as good. No use is made of symmetry in h.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable

from mpmath import mp

from dsfit.checks.stability.exact_bsdf import (
    Glint,
    Hair,
    Real,
    Section,
    normal,
    ray_offsets,
    turning_points,
    wrap,
)

NODES = 16
_FLANKS = (-12, -6, -2, 2, 6, 12)


@functools.lru_cache(maxsize=16)
def legendre(count: int, precision: int) -> list[tuple[Real, Real]]:
    """Nodes in (-1, 1) and weights of Gauss and Legendre, by Newton's method on the recurrence."""
    found = []
    for k in range(count):
        x = mp.cos(mp.pi * (k + mp.mpf(3) / 4) / (count + mp.mpf(1) / 2))
        for _ in range(60):
            before, value = mp.mpf(1), x
            for j in range(2, count + 1):
                before, value = value, ((2 * j - 1) * x * value - (j - 1) * before) / j
            slope = count * (x * value - before) / (x * x - 1)
            step = value / slope
            x -= step
            if abs(step) < mp.eps * 4:
                break
        found.append((x, 2 / ((1 - x * x) * slope**2)))
    return found


def panel_sum(function: Callable[[Real], Real], ends: Iterable[Real], nodes: int = NODES) -> Real:
    """Composite Gauss-Legendre over the panels between the sorted ends."""
    rule, ordered = legendre(nodes, mp.prec), sorted(ends)
    total = mp.mpf(0)
    for low, high in zip(ordered[:-1], ordered[1:], strict=True):
        if high - low > mp.mpf(10) ** -30:
            middle, half = (low + high) / 2, (high - low) / 2
            total += half * mp.fsum(weight * function(middle + half * x) for x, weight in rule)
    return total


def grazing_panels(low: Real, high: Real, levels: int = 4) -> list[Real]:
    """Ends within [low, high] that pile up geometrically at gamma = -pi/2 and pi/2."""
    steps = [mp.pi / 2 - mp.mpf(8) / 10 / 2**k for k in range(levels)]
    inner = [s for x in steps for s in (x, -x)] + [mp.mpf(0)]
    return [low, high, *(x for x in inner if low < x < high)]


def energy(p: int, hair: Hair, theta_diff: Real) -> Real:
    """(1/2) int_{-1}^{1} A(p, h) dh = int N_p dphi."""
    return _energy(p, hair.index(p), mp.mpf(hair.sigma_a), mp.mpf(theta_diff), mp.prec)


@functools.lru_cache(maxsize=4096)
def _energy(p: int, eta: Real, sigma_a: Real, theta_diff: Real, precision: int) -> Real:
    section = Section.at(eta, sigma_a, theta_diff)
    return panel_sum(lambda g: section.carried(p, g) * mp.cos(g), grazing_panels(-mp.pi / 2, mp.pi / 2)) / 2


def window(p: int, hair: Hair, theta_diff: Real, phi: Real, glint: Glint | None = None) -> Real:
    """N^G_p = (1/pi) times the mass of N_p on the half circle centred on phi."""
    phi = wrap(mp.mpf(phi))
    section = Section.at(hair.index(p), hair.sigma_a, theta_diff)
    cuts = [g for s in (-1, 1) for g in ray_offsets(p, section.first, phi + s * mp.pi / 2)]
    if glint is not None:
        cuts += _flank_offsets(p, section.first, glint)
    cuts = sorted({-mp.pi / 2, mp.pi / 2, *cuts})
    total = mp.mpf(0)
    for low, high in zip(cuts[:-1], cuts[1:], strict=True):
        if abs(wrap(section.exit(p, (low + high) / 2) - phi)) < mp.pi / 2:
            kept = glint.kept if glint is not None else (lambda x: 1)
            total += panel_sum(
                lambda g, kept=kept: section.carried(p, g) * mp.cos(g) * kept(section.exit(p, g)),
                grazing_panels(low, high),
            )
    total /= 2
    if glint is not None:
        total += glint.height * sum(half_circle_mass(wrap(phi + s * glint.phi), glint.width) for s in (-1, 1))
    return total / mp.pi


def _flank_offsets(p: int, first: Real, glint: Glint) -> list[Real]:
    """Where panels had better end for the removed caustic to be resolved; where exactly does not matter."""
    with mp.workdps(15):
        steps = (0, *_FLANKS) if glint.width < 0.1 else (0,)
        flanks = [s * glint.phi + k * glint.width for s in (-1, 1) for k in steps]
        return [+g for x in flanks for g in ray_offsets(p, +first, x)] + turning_points(p, +first)


def half_circle_mass(centre: Real, width: Real) -> Real:
    """int g(wrap(x); width) dx over |x - centre| < pi/2: the window may reach over the seam at pi."""
    low, high = centre - mp.pi / 2, centre + mp.pi / 2
    pieces = [(max(low + s, -mp.pi), min(high + s, mp.pi)) for s in (-2 * mp.pi, mp.mpf(0), 2 * mp.pi)]
    return sum(normal_mass(a / width, b / width) for a, b in pieces if b > a)


def normal_mass(a: Real, b: Real) -> Real:
    """Phi(b) - Phi(a), on the side where nothing cancels."""
    root = mp.sqrt(2)
    if a > 0:
        a, b = -b, -a
    return (mp.erfc(-b / root) - mp.erfc(-a / root)) / 2


def wrapped_normal(x: Real, std: Real) -> Real:
    """The normal density of standard deviation std around the circle: all images that count, or waves."""
    if std < 2:
        return sum(normal(x + 2 * mp.pi * k, std) for k in range(-9, 10))
    waves = sum(mp.exp(-((k * std) ** 2) / 2) * mp.cos(k * x) for k in range(1, 12))
    return (1 + 2 * waves) / (2 * mp.pi)


def wrapped_window(centre: Real, std: Real) -> Real:
    """Mass of that density within pi/2 of `centre`."""
    if std < 2:
        images = [centre + 2 * mp.pi * k for k in range(-9, 10)]
        return sum(normal_mass((x - mp.pi / 2) / std, (x + mp.pi / 2) / std) for x in images)
    waves = [2 * mp.exp(-((k * std) ** 2) / 2) * mp.sin(k * mp.pi / 2) * mp.cos(k * centre) / k for k in range(1, 12)]
    return (mp.pi + 2 * sum(waves)) / (2 * mp.pi)


def lobe_simplified(p: int, hair: Hair, theta_diff: Real, phi: Real) -> Real:
    """cos(phi/2)/4 for R and TRT, a wrapped Gaussian about pi for TT, times the energy of the lobe (eqs 21, 25)."""
    if p == 1:
        shape = wrapped_normal(wrap(mp.mpf(phi) - mp.pi), mp.mpf(hair.gamma_tt))
    else:
        shape = mp.cos(wrap(mp.mpf(phi)) / 2) / 4
    return shape * energy(p, hair, theta_diff)


def window_simplified(p: int, hair: Hair, theta_diff: Real, phi: Real) -> Real:
    """N^G of the simplified azimuths: the cosine integrated over the window by its antiderivative, piece by piece."""
    phi = wrap(mp.mpf(phi))
    if p == 1:
        mass = wrapped_window(wrap(phi - mp.pi), mp.mpf(hair.gamma_tt))
    else:
        low, high = phi - mp.pi / 2, phi + mp.pi / 2
        pieces = [(max(low + s, -mp.pi), min(high + s, mp.pi)) for s in (-2 * mp.pi, mp.mpf(0), 2 * mp.pi)]
        mass = sum((mp.sin(b / 2) - mp.sin(a / 2)) / 2 for a, b in pieces if b > a)
    return mass * energy(p, hair, theta_diff) / mp.pi
