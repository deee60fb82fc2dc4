"""Oracle for Marschner's azimuthal functions: slow, scalar, plain Python; shares no code with dsfit.

Written from FORMULAS B and C. Angles are radians; `phi = 0` is back scattering, `|phi| = pi` forward scattering. Lobes
are numbered by their internal segments: 0 = R, 1 = TT, 2 = TRT. Results carry the absorption channels as a trailing
axis [C].

Where an implementation would use closed forms (TT root, caustic offset) this file brackets all roots of the exit
azimuth between numerically located turning points and bisects; where an implementation would change variables, it
integrates over phi.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.integrate import quad
from scipy.optimize import brentq

HALF_PI = math.pi / 2
TWO_PI = 2 * math.pi
MODELS = ("marschner", "raw", "simplified")


@dataclass(frozen=True)
class Fiber:
    """Fibre parameters, named as the fields of dsfit.Fiber; sigma_a per fibre radius and channel; angles in radians."""

    sigma_a: tuple[float, ...]
    eta: float = 1.55
    alpha: tuple[float, float, float] = (math.radians(-7.5), math.radians(3.75), math.radians(11.25))
    beta: tuple[float, float, float] = (math.radians(7.5), math.radians(3.75), math.radians(15.0))
    eccentricity: float = 1.0
    caustic_width: float = math.radians(15.0)
    glint_scale: float = 0.8
    caustic_fade: float = 0.3
    caustic_max_offset: float = 0.5
    gamma_tt: float = math.radians(30.0)
    absorption: str = "geometric"  # or "printed": the doubled depth of the 2003 paper; a switch of dsfit.Convention


def wrap(x: float) -> float:
    """x modulo 2 pi, in [-pi, pi]."""
    return math.remainder(x, TWO_PI)


def gaussian(x: float, std: float) -> float:
    return math.exp(-0.5 * (x / std) ** 2) / (std * math.sqrt(TWO_PI))


def smoothstep(low: float, high: float, x: float) -> float:
    s = min(max((x - low) / (high - low), 0.0), 1.0)
    return s * s * (3.0 - 2.0 * s)


# --------------------------------------------------------------------------------------------------- optics of one path


def bravais(eta: float, theta_diff: float) -> tuple[float, float]:
    """Effective indices eta', eta'' of a section seen at the difference angle theta_diff."""
    root = math.sqrt(eta * eta - math.sin(theta_diff) ** 2)
    return root / math.cos(theta_diff), eta * eta * math.cos(theta_diff) / root


def fresnel(eta: float, cos_in: np.ndarray | float) -> np.ndarray | float:
    """Unpolarised Fresnel reflectance of a dielectric, from the textbook formula with the 3-D angle of incidence."""
    cos_t = np.sqrt(1.0 - (1.0 - cos_in * cos_in) / (eta * eta))
    r_s = (cos_in - eta * cos_t) / (cos_in + eta * cos_t)
    r_p = (eta * cos_in - cos_t) / (eta * cos_in + cos_t)
    return 0.5 * (r_s * r_s + r_p * r_p)


def transmission(eta: float, cos_in: np.ndarray | float) -> np.ndarray | float:
    """1 - fresnel without cancellation: 1 - ((a - b)/(a + b))^2 = 4ab/(a + b)^2 for each polarisation."""
    cos_t = np.sqrt(1.0 - (1.0 - cos_in * cos_in) / (eta * eta))
    t_s = 4.0 * eta * cos_in * cos_t / (cos_in + eta * cos_t) ** 2
    t_p = 4.0 * eta * cos_in * cos_t / (eta * cos_in + cos_t) ** 2
    return 0.5 * (t_s + t_p)


def attenuation(fiber: Fiber, p: int, theta_diff, gi, eta: float) -> np.ndarray:
    """A(p, h = sin gi): Fresnel factors and absorption of the path with p internal segments, [..., C].

    theta_diff and gi may be numpy arrays that broadcast. fiber.absorption "geometric": T = exp(-2 sigma' cos gt) per
    segment; "printed": exp(-2 sigma' (1 + cos 2 gt)) of the 2003 paper.
    """
    theta_diff, gi = np.asarray(theta_diff, float), np.asarray(gi, float)
    cos_3d = np.cos(theta_diff) * np.cos(gi)
    reflect = fresnel(eta, cos_3d)
    sigma = np.asarray(fiber.sigma_a, float)
    if p == 0:
        return reflect[..., None] * np.ones_like(sigma)
    eta1 = np.sqrt(eta * eta - np.sin(theta_diff) ** 2) / np.cos(theta_diff)
    sin_gt = np.sin(gi) / eta1
    cos_gt = np.sqrt(1.0 - sin_gt * sin_gt)
    cos_theta_t = np.sqrt(1.0 - (np.sin(theta_diff) / eta) ** 2)
    if fiber.absorption == "geometric":
        length = 2.0 * cos_gt
    elif fiber.absorption == "printed":
        length = 4.0 * cos_gt * cos_gt
    else:
        raise ValueError(fiber.absorption)
    depth = (p * length / cos_theta_t)[..., None] * sigma
    return (transmission(eta, cos_3d) ** 2 * reflect ** (p - 1))[..., None] * np.exp(-depth)


def exit_azimuth(p: int, gi: float, eta1: float) -> float:
    """phi(p, gi) = 2 p gt - 2 gi + p pi, sin gt = sin(gi)/eta', not wrapped."""
    return 2.0 * p * math.asin(math.sin(gi) / eta1) - 2.0 * gi + p * math.pi


def exit_azimuth_slope(p: int, gi: float, eta1: float) -> float:
    """d phi / d gi = 2 p cos gi / (eta' cos gt) - 2."""
    s = math.sin(gi)
    return 2.0 * p * math.cos(gi) / math.sqrt(eta1 * eta1 - s * s) - 2.0


# ---------------------------------------------------------------------------------------------------- roots by scanning


@lru_cache(maxsize=4096)
def turning_points(p: int, eta1: float) -> tuple[float, ...]:
    """Incidence angles in (-pi/2, pi/2) where d phi / d gi changes sign, by scan and brentq."""
    grid = np.linspace(-HALF_PI, HALF_PI, 721).tolist()
    values = [exit_azimuth_slope(p, g, eta1) for g in grid]
    found = []
    for a, b, fa, fb in zip(grid[:-1], grid[1:], values[:-1], values[1:], strict=True):
        if fa == 0.0 and a > -HALF_PI:
            found.append(a)
        elif fa * fb < 0.0:
            found.append(brentq(exit_azimuth_slope_of_gi, a, b, args=(p, eta1), xtol=1e-15, rtol=1e-15))
    return tuple(found)


def exit_azimuth_slope_of_gi(gi: float, p: int, eta1: float) -> float:
    return exit_azimuth_slope(p, gi, eta1)


@lru_cache(maxsize=4096)
def _scan(p: int, eta1: float) -> tuple[np.ndarray, np.ndarray]:
    """Dense grid of gi with every turning point in it, and phi - p pi there: monotone between neighbours."""
    grid = np.union1d(np.linspace(-HALF_PI, HALF_PI, 181), np.asarray(turning_points(p, eta1), float))
    return grid, 2.0 * p * np.arcsin(np.sin(grid) / eta1) - 2.0 * grid


@lru_cache(maxsize=200_000)
def roots(p: int, phi: float, eta1: float) -> tuple[float, ...]:
    """All gi in [-pi/2, pi/2] with phi(p, gi) = phi modulo 2 pi, by dense scan and brentq."""
    grid, values = _scan(p, eta1)
    found: list[float] = []
    for turn in range(-3, 4):
        target = wrap(phi) + TWO_PI * turn - p * math.pi
        residual = values - target
        if residual.min() > 0.0 or residual.max() < 0.0:
            continue

        def equation(gi: float, target: float = target) -> float:
            return 2.0 * p * math.asin(math.sin(gi) / eta1) - 2.0 * gi - target

        sign = np.sign(residual)
        found.extend(grid[sign == 0.0].tolist())
        for k in np.flatnonzero(sign[:-1] * sign[1:] < 0.0):
            found.append(brentq(equation, grid[k], grid[k + 1], xtol=1e-16, rtol=9e-16))
    return tuple(sorted(found))


# ------------------------------------------------------------------------------------------------ N_p, the three models


def elliptic_eta(fiber: Fiber, phi_h: float) -> float:
    """eta*(phi_h) of an elliptic section (Marschner 2003), used for TRT only."""
    a2, eta = fiber.eccentricity**2, fiber.eta
    eta_1 = 2.0 * (eta - 1.0) * a2 - eta + 2.0
    eta_2 = 2.0 * (eta - 1.0) / a2 - eta + 2.0
    return 0.5 * ((eta_1 + eta_2) + math.cos(2.0 * phi_h) * (eta_1 - eta_2))


def lobe_eta(fiber: Fiber, p: int, phi_h: float) -> float:
    return elliptic_eta(fiber, phi_h) if p == 2 else fiber.eta


def lobe_raw(fiber: Fiber, p: int, theta_diff: float, phi: float, eta: float) -> np.ndarray:
    """N_p = (1/2) sum over roots of A |dh/dphi|, [C]; 0 outside the support."""
    eta1 = bravais(eta, theta_diff)[0]
    total = np.zeros(len(fiber.sigma_a))
    for gi in roots(p, phi, eta1):
        cos_gi = max(math.cos(gi), 0.0)
        total += 0.5 * attenuation(fiber, p, theta_diff, gi, eta) * cos_gi / abs(exit_azimuth_slope(p, gi, eta1))
    return total


@dataclass(frozen=True)
class Caustic:
    """The TRT treatment at one (theta_diff, eta): glint centre, removal strength t, glint height per channel."""

    phi_c: float
    strength: float
    height: tuple[float, ...]


@lru_cache(maxsize=4096)
def caustic(fiber: Fiber, theta_diff: float, eta: float) -> Caustic:
    """FORMULAS B, 'TRT caustic treatment', with the exact Snell caustic h_c = sqrt((4 - eta'^2)/3)."""
    eta1 = bravais(eta, theta_diff)[0]
    if eta1 < 2.0:
        h_c = math.sqrt((4.0 - eta1 * eta1) / 3.0)
        if h_c < 1.0:
            phi_c = wrap(exit_azimuth(2, math.asin(h_c), eta1))
            curvature = 4.0 * h_c / (eta1 * eta1 - h_c * h_c) ** 1.5 - 2.0 * h_c / (1.0 - h_c * h_c) ** 1.5
            width = 2.0 * math.sqrt(2.0 * fiber.caustic_width / abs(curvature)) if curvature else math.inf
        else:
            raise ValueError("eta' must exceed 1")
        strength, offset = 1.0, min(fiber.caustic_max_offset, width)
    else:
        h_c, phi_c, offset = 0.0, 0.0, fiber.caustic_max_offset
        strength = 1.0 - smoothstep(2.0, 2.0 + fiber.caustic_fade, eta1)
    height = strength * fiber.glint_scale * offset * attenuation(fiber, 2, theta_diff, math.asin(h_c), eta)
    return Caustic(phi_c, strength, tuple(height.tolist()))


def _kept(strength: float, distance: float, width: float) -> float:
    """1 - t exp(-x^2 / (2 w^2)) without cancellation."""
    return (1.0 - strength) - strength * math.expm1(-0.5 * (distance / width) ** 2)


def trt_weight(fiber: Fiber, c: Caustic, phi: float) -> float:
    """Factor of both caustic removals on raw N_TRT."""
    w = fiber.caustic_width
    return _kept(c.strength, wrap(phi - c.phi_c), w) * _kept(c.strength, wrap(phi + c.phi_c), w)


def trt_glint(fiber: Fiber, c: Caustic, phi: float) -> np.ndarray:
    w = fiber.caustic_width
    return np.asarray(c.height) * (gaussian(wrap(phi - c.phi_c), w) + gaussian(wrap(phi + c.phi_c), w))


@lru_cache(maxsize=4096)
def energy(fiber: Fiber, p: int, theta_diff: float, eta: float) -> tuple[float, ...]:
    """E_p = (1/2) int_{-1}^{1} A(p, h) dh = int N_p dphi, by adaptive quadrature in gi, per channel."""

    def integrand(gi: float, channel: int) -> float:
        return float(attenuation(fiber, p, theta_diff, gi, eta)[channel]) * math.cos(gi)

    return tuple(
        quad(integrand, 0.0, HALF_PI, args=(c,), epsabs=0.0, epsrel=1e-13, limit=200)[0]
        for c in range(len(fiber.sigma_a))
    )


def wrapped_gaussian(x: float, std: float) -> float:
    return math.fsum(gaussian(x + TWO_PI * k, std) for k in range(-12, 13))


def azimuthal(
    fiber: Fiber,
    p: int,
    theta_diff: float,
    phi: float,
    model: str = "marschner",
    phi_h: float = 0.0,
    unit: bool = False,
) -> np.ndarray:
    """N_p(theta_diff, phi), [C]. `unit` gives the simplified lobes weight 1 as printed: cos(phi/2) and a Gaussian."""
    eta = lobe_eta(fiber, p, phi_h)
    if model == "simplified":
        shape = wrapped_gaussian(phi - math.pi, fiber.gamma_tt) if p == 1 else math.cos(wrap(phi) / 2.0)
        if unit:
            return shape * np.ones(len(fiber.sigma_a))
        return shape * (1.0 if p == 1 else 0.25) * np.asarray(energy(fiber, p, theta_diff, eta))
    raw = lobe_raw(fiber, p, theta_diff, phi, eta)
    if model == "raw" or p != 2:
        return raw
    c = caustic(fiber, theta_diff, eta)
    return trt_weight(fiber, c, phi) * raw + trt_glint(fiber, c, phi)
