"""Oracle for N^G, the average of N_p over the half circle from which scattered light arrives (FORMULAS C).

    N^G_p(phi) = (1/pi) int_{-pi/2}^{pi/2} N_p(wrap(phi - phi')) dphi'

Two methods that share no integrand: over phi with the root sum, and over the offset h without it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache

import numpy as np
from oracle_azimuth import (
    HALF_PI,
    TWO_PI,
    Fiber,
    attenuation,
    azimuthal,
    bravais,
    caustic,
    energy,
    exit_azimuth,
    lobe_eta,
    roots,
    trt_weight,
    turning_points,
    wrap,
)
from scipy.integrate import quad
from scipy.special import ndtr


def singular_azimuths(p: int, eta1: float) -> list[float]:
    """Azimuths in [-pi, pi] where N_p is not smooth: support edges (h = +-1), turning points, +-pi."""
    edges = [exit_azimuth(p, g, eta1) for g in (-HALF_PI, HALF_PI, *turning_points(p, eta1))]
    return sorted({wrap(e) for e in edges} | {-math.pi, math.pi})


def windowed(
    function: Callable[[float], np.ndarray], low: float, high: float, kinks: list[float], scale: np.ndarray
) -> np.ndarray:
    """int_low^high function(phi) dphi with panels broken at kinks + 2 pi k; errors are relative to panel or `scale`.

    Each panel is mapped by phi = mid + half sin(s): an inverse square root at either end becomes smooth.
    """
    breaks = sorted({k + TWO_PI * turn for k in kinks for turn in range(-2, 3) if low < k + TWO_PI * turn < high})
    ends = [low, *breaks, high]
    total = np.zeros(len(scale))
    for a, b in zip(ends[:-1], ends[1:], strict=True):
        if b - a < 1e-13:
            continue
        mid, half = 0.5 * (a + b), 0.5 * (b - a)
        cache: dict[float, np.ndarray] = {}

        def integrand(s: float, channel: int, mid: float = mid, half: float = half, cache: dict = cache) -> float:
            if s not in cache:
                cache[s] = function(mid + half * math.sin(s)) * (half * math.cos(s))
            return float(cache[s][channel])

        for c, size in enumerate(scale):
            total[c] += quad(integrand, -HALF_PI, HALF_PI, args=(c,), epsabs=1e-14 * size, epsrel=3e-13, limit=400)[0]
    return total


@lru_cache(maxsize=65536)
def scattered(
    fiber: Fiber,
    p: int,
    theta_diff: float,
    phi: float,
    model: str = "marschner",
    phi_h: float = 0.0,
    unit: bool = False,
) -> np.ndarray:
    """N^G_p, [C]: `scattered_by_azimuth`, but `scattered_by_offset` for the raw model.

    The raw integrand is an inverse square root at caustics, where roots in double precision are too noisy for 1e-11
    (eta' just below 2: 7e-11). The cached array is shared between calls: do not write to it.
    """
    if model == "raw":
        return scattered_by_offset(fiber, p, theta_diff, phi, model, phi_h)
    return scattered_by_azimuth(fiber, p, theta_diff, phi, model, phi_h, unit)


def scattered_by_azimuth(
    fiber: Fiber,
    p: int,
    theta_diff: float,
    phi: float,
    model: str = "marschner",
    phi_h: float = 0.0,
    unit: bool = False,
) -> np.ndarray:
    """N^G_p = (1/pi) int_{-pi/2}^{pi/2} N_p(wrap(phi - phi')) dphi', [C], of the same N_p; phi_h is held fixed."""
    kinks = [-math.pi, math.pi, 0.0]
    if model != "simplified":
        eta = lobe_eta(fiber, p, phi_h)
        kinks += singular_azimuths(p, bravais(eta, theta_diff)[0])
        if p == 2 and model == "marschner":
            phi_c, w = caustic(fiber, theta_diff, eta).phi_c, fiber.caustic_width
            kinks += [wrap(s * phi_c + k * w) for s in (-1.0, 1.0) for k in (-8.0, -3.0, 0.0, 3.0, 8.0)]
    elif p == 1:
        kinks += [wrap(math.pi + k * fiber.gamma_tt) for k in (-8.0, -3.0, 3.0, 8.0)]
    low, high = wrap(phi) - HALF_PI, wrap(phi) + HALF_PI
    scale = np.asarray(energy(fiber, p, theta_diff, lobe_eta(fiber, p, phi_h)))

    def density(x: float) -> np.ndarray:
        return azimuthal(fiber, p, theta_diff, x, model, phi_h, unit)

    return windowed(density, low, high, kinks, scale) / math.pi


def scattered_by_offset(
    fiber: Fiber, p: int, theta_diff: float, phi: float, model: str = "marschner", phi_h: float = 0.0
) -> np.ndarray:
    """N^G_p (raw, marschner) without any sum over roots: (1/2 pi) int A W(phi(h)) [phi(h) in the window] dh.

    dphi' = |dphi/dh| dh cancels the Jacobian of N_p, so there is no caustic. The glint adds
    Gaussian integrals in closed form.
    """
    eta = lobe_eta(fiber, p, phi_h)
    eta1 = bravais(eta, theta_diff)[0]
    treated = p == 2 and model == "marschner"
    c = caustic(fiber, theta_diff, eta) if treated else None
    cuts = sorted(
        {
            -HALF_PI,
            0.0,
            HALF_PI,
            *turning_points(p, eta1),
            *roots(p, phi - HALF_PI, eta1),
            *roots(p, phi + HALF_PI, eta1),
        }
    )
    scale = energy(fiber, p, theta_diff, eta)
    total = np.zeros(len(scale))
    for a, b in zip(cuts[:-1], cuts[1:], strict=True):
        if abs(wrap(exit_azimuth(p, 0.5 * (a + b), eta1) - phi)) > HALF_PI:
            continue

        def integrand(gi: float, channel: int) -> float:
            weight = trt_weight(fiber, c, exit_azimuth(p, gi, eta1)) if treated else 1.0
            return float(attenuation(fiber, p, theta_diff, gi, eta)[channel]) * weight * math.cos(gi)

        for channel, size in enumerate(scale):
            total[channel] += (
                0.5 * quad(integrand, a, b, args=(channel,), epsabs=1e-15 * size, epsrel=1e-13, limit=400)[0]
            )
    if treated:
        for centre in (c.phi_c, -c.phi_c):
            low = wrap(phi - HALF_PI - centre)
            high = low + math.pi
            width = fiber.caustic_width
            inside = ndtr(min(high, math.pi) / width) - ndtr(low / width)
            if high > math.pi:
                inside += ndtr((high - TWO_PI) / width) - ndtr(-math.pi / width)
            total += np.asarray(c.height) * inside
    return total / math.pi
