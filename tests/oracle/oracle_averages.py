"""Oracle for the averages of dual scattering: a_f, a_b per lobe by 2-D quadrature, then A_b, Delta_b, sigma_b.

    a^p(theta_in) = int dtheta_o K(theta_o) int N_p(Phi) w(Phi) dPhi
    K = c_M g cos(theta_o) cos(theta_in) / cos^2(theta_diff)
    int N_p w dPhi = (1/2) int_{-1}^{1} A(p, h) w(phi(p, h)) dh

(FORMULAS C): always from the raw geometry, whatever azimuthal model shades. Composite Gauss-Legendre with explicit
break points at every kink; `order` sets the nodes per panel, so that a second call with a higher order measures the
error.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from oracle_azimuth import HALF_PI, Fiber, attenuation, bravais, elliptic_eta, gaussian, roots

SQRT2 = math.sqrt(2.0)


@dataclass(frozen=True)
class Options:
    """The switches that the averages know; defaults are those of the `consistent` convention."""

    c_m: float = 0.5  # energy constant of single scattering; printed: 1
    cosine: str = "incident"  # weight cos(theta_in) (Zinke literal) or "outgoing" cos(theta_o) (albedo)
    split: str = "linear"  # front share |Phi|/pi, or "half": |Phi| > pi/2
    width: str = "variance"  # average beta^2, or "mean": average beta
    delta_sign: float = -1.0  # sign in alpha_b (1 -+ 2 q^2)
    rescale: bool = True  # divide the pair by max(1, a_f + a_b)


@dataclass(frozen=True)
class Averages:
    """All averages at one theta_in; arrays [C]. a_f_lobes and a_b_lobes are [3, C] before any rescaling."""

    a_f: np.ndarray
    a_b: np.ndarray
    alpha_f: np.ndarray
    alpha_b: np.ndarray
    beta_f: np.ndarray
    beta_b: np.ndarray
    A_b: np.ndarray
    delta_b: np.ndarray
    sigma_b: np.ndarray
    a_f_lobes: np.ndarray
    a_b_lobes: np.ndarray

    FIELDS = ("a_f", "a_b", "alpha_f", "alpha_b", "beta_f", "beta_b", "A_b", "delta_b", "sigma_b")


@lru_cache(maxsize=64)
def legendre(order: int) -> tuple[np.ndarray, np.ndarray]:
    return np.polynomial.legendre.leggauss(order)


def composite(breaks: list[float], order: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and weights of Gauss-Legendre of the given order on every panel between sorted breaks."""
    x, w = legendre(order)
    nodes, weights = [], []
    for a, b in zip(breaks[:-1], breaks[1:], strict=True):
        if b - a > 1e-13:
            nodes.append(0.5 * (a + b) + 0.5 * (b - a) * x)
            weights.append(0.5 * (b - a) * w)
    return np.concatenate(nodes), np.concatenate(weights)


def gi_breaks(p: int, theta_diff: float, eta: float, split: str) -> list[float]:
    """Incidence angles in (0, pi/2) where the front share of phi(p, gi) is not smooth.

    Linear split: where wrapped phi(p, gi) changes sign inside. That happens for TRT only, where 2 gt = gi:
    h^2 = eta'^2 (1 - eta'^2/4).
    """
    eta1 = bravais(eta, theta_diff)[0]
    if split == "half":
        return sorted(
            {abs(g) for s in (-HALF_PI, HALF_PI) for g in roots(p, s, eta1) if 1e-12 < abs(g) < HALF_PI - 1e-12}
        )
    square = eta1 * eta1 * (1.0 - eta1 * eta1 / 4.0)
    return [math.asin(math.sqrt(square))] if p == 2 and 0.0 < square < 1.0 and eta1 > SQRT2 else []


def front_share(p: int, gi: np.ndarray, eta1: np.ndarray, split: str) -> np.ndarray:
    """|Phi|/pi with Phi the wrapped exit azimuth, or 1 where |Phi| > pi/2."""
    azimuth = 2.0 * p * np.arcsin(np.sin(gi) / eta1) - 2.0 * gi + p * math.pi
    azimuth = np.abs(azimuth - 2.0 * math.pi * np.round(azimuth / (2.0 * math.pi)))
    return azimuth / math.pi if split == "linear" else (azimuth > HALF_PI).astype(float)


def azimuthal_moments(
    fiber: Fiber, p: int, theta_diff: np.ndarray, eta: float, options: Options, order: int
) -> tuple[np.ndarray, np.ndarray]:
    """int N_p w dPhi and int N_p (1 - w) dPhi for every theta_diff [T]: two arrays [T, C]."""
    nodes, weights = np.empty((len(theta_diff), 4 * order)), np.empty((len(theta_diff), 4 * order))
    for row, t in enumerate(theta_diff.tolist()):
        inner = gi_breaks(p, t, eta, options.split) or [1.0]
        ends = np.interp(np.linspace(0, 1, 5), np.linspace(0, 1, len(inner) + 2), [0.0, *inner, HALF_PI])
        ends = sorted({*inner, 0.0, HALF_PI, *ends[: 4 - len(inner)]})
        while len(ends) < 5:  # always four panels: halve the widest until there are
            k = int(np.argmax(np.diff(ends)))
            ends.insert(k + 1, 0.5 * (ends[k] + ends[k + 1]))
        nodes[row], weights[row] = _four_panels(ends, order)
    eta1 = np.sqrt(eta * eta - np.sin(theta_diff) ** 2) / np.cos(theta_diff)
    share = front_share(p, nodes, eta1[:, None], options.split)
    a = attenuation(fiber, p, theta_diff[:, None], nodes, eta)
    measure = (weights * np.cos(nodes))[..., None]
    return (a * measure * share[..., None]).sum(1), (a * measure * (1.0 - share)[..., None]).sum(1)


def _four_panels(ends: list[float], order: int) -> tuple[np.ndarray, np.ndarray]:
    x, w = legendre(order)
    ends_ = np.asarray(ends)
    mid, half = 0.5 * (ends_[:-1] + ends_[1:]), 0.5 * np.diff(ends_)
    return (mid[:, None] + half[:, None] * x).ravel(), (half[:, None] * w).ravel()


# eta' at which phi(p, gi) of TT or TRT begins to cross 0 or +-pi/2: sqrt(2), 2, and where 4c - pi = -+pi/2.
KINKS = (SQRT2, 2.0, 1.0 / math.sin(math.pi / 8.0), 1.0 / math.sin(3.0 * math.pi / 8.0))


def theta_breaks(theta_in: float, alpha: float, beta: float, eta: float) -> list[float]:
    """Break points of the theta_o integral: the peak at 2 alpha - theta_in, the ends, and where eta' passes a kink."""
    peak, breaks = 2.0 * alpha - theta_in, {-HALF_PI, 0.0, HALF_PI}
    for k in (0.0, 1.0, 2.0, 3.5, 5.0, 7.0, 9.0, 12.0, 20.0, 40.0):
        breaks |= {peak - 2.0 * beta * k, peak + 2.0 * beta * k}
    distance = HALF_PI - abs(theta_in)  # near grazing the geometry varies on this scale at the far end
    side = -math.copysign(HALF_PI, theta_in)
    doublings = math.ceil(math.log2(math.pi / distance))
    breaks |= {side - math.copysign(distance * 2.0**k, side) for k in range(-2, doublings)}
    for index in KINKS:  # eta'^2 cos^2 = eta^2 - 1 + cos^2
        square = (eta * eta - 1.0) / (index * index - 1.0)
        if square < 1.0:
            t = math.acos(math.sqrt(square))
            breaks |= {theta_in + 2.0 * t, theta_in - 2.0 * t}
    return sorted(b for b in breaks if -HALF_PI <= b <= HALF_PI)


def lobe_average(
    fiber: Fiber, p: int, theta_in: float, eta: float, options: Options, order: int
) -> tuple[np.ndarray, np.ndarray]:
    """(a_f^p, a_b^p) of one lobe, each [C]."""
    alpha, beta = fiber.alpha[p], fiber.beta[p]
    theta_o, weight = composite(theta_breaks(theta_in, alpha, beta, eta), order)
    theta_diff = 0.5 * (theta_o - theta_in)
    lobe = np.array([gaussian(0.5 * (theta_in + t) - alpha, beta) for t in theta_o.tolist()])
    cosine = math.cos(theta_in) if options.cosine == "incident" else np.cos(theta_o)
    kernel = weight * options.c_m * lobe * np.cos(theta_o) * cosine / np.cos(theta_diff) ** 2
    keep = kernel > 1e-25 * kernel.max()
    front, back = azimuthal_moments(fiber, p, theta_diff[keep], eta, options, order)
    return kernel[keep] @ front, kernel[keep] @ back


def elliptic_average(fiber: Fiber, theta_in: float, options: Options, order: int) -> tuple[np.ndarray, np.ndarray]:
    """TRT of an elliptic fibre: uniform mean over phi_h; eta* has period pi and is even, so [0, pi/2] suffices.

    The mean over theta_o is only algebraically smooth in eta* where a kink appears (at theta_diff = 0) or leaves
    through theta_o = +-pi/2: panels break there and are mapped by phi_h = mid + half sin(s).
    """
    breaks = [0.0, HALF_PI]
    low, high = elliptic_eta(fiber, 0.0), elliptic_eta(fiber, HALF_PI)
    for index in KINKS:
        for theta_diff in (0.0, 0.5 * (HALF_PI - theta_in), 0.5 * (-HALF_PI - theta_in)):
            eta = math.sqrt(1.0 + (index * index - 1.0) * math.cos(theta_diff) ** 2)  # eta' = index at theta_diff
            share = (eta - low) / (high - low)
            if 0.0 < share < 1.0:
                breaks.append(math.asin(math.sqrt(share)))
    breaks.sort()
    ends, (s, ds) = np.asarray(breaks), composite([-HALF_PI, 0.0, HALF_PI], order)
    mid, half = 0.5 * (ends[:-1, None] + ends[1:, None]), 0.5 * np.diff(ends)[:, None]
    nodes, weights = (mid + half * np.sin(s)).ravel(), (half * np.cos(s) * ds).ravel()
    pairs = [lobe_average(fiber, 2, theta_in, elliptic_eta(fiber, phi_h), options, order) for phi_h in nodes.tolist()]
    return tuple(sum(w * pair[k] for w, pair in zip(weights, pairs, strict=True)) / HALF_PI for k in (0, 1))


@lru_cache(maxsize=4096)
def _lobes(fiber: Fiber, theta_in: float, options: Options, order: int) -> tuple[np.ndarray, np.ndarray]:
    parts = [lobe_average(fiber, p, theta_in, fiber.eta, options, order) for p in (0, 1)]
    if fiber.eccentricity == 1.0:
        parts.append(lobe_average(fiber, 2, theta_in, fiber.eta, options, order))
    else:
        parts.append(elliptic_average(fiber, theta_in, options, order))
    return np.array([f for f, _ in parts]), np.array([b for _, b in parts])


def averages(
    fiber: Fiber, theta_in: float, d_b: float = 0.7, options: Options | None = None, order: int = 16
) -> Averages:
    """All averages at the inclination theta_in of the incident light, per channel."""
    options = options or Options()
    f_lobes, b_lobes = _lobes(fiber, theta_in, options, order)
    alpha, beta = np.array(fiber.alpha)[:, None], np.array(fiber.beta)[:, None]
    a_f, a_b = f_lobes.sum(0), b_lobes.sum(0)
    alpha_f, alpha_b = (f_lobes * alpha).sum(0) / a_f, (b_lobes * alpha).sum(0) / a_b
    if options.width == "variance":
        beta_f = np.sqrt((f_lobes * beta**2).sum(0) / a_f)
        beta_b = np.sqrt((b_lobes * beta**2).sum(0) / a_b)
    else:
        beta_f, beta_b = (f_lobes * beta).sum(0) / a_f, (b_lobes * beta).sum(0) / a_b
    if options.rescale:
        total = np.maximum(1.0, a_f + a_b)
        a_f, a_b = a_f / total, a_b / total
    back, shift, width = backscatter(a_f, a_b, alpha_f, alpha_b, beta_f, beta_b, d_b, options.delta_sign)
    return Averages(a_f, a_b, alpha_f, alpha_b, beta_f, beta_b, back, shift, width, f_lobes, b_lobes)


def backscatter(a_f, a_b, alpha_f, alpha_b, beta_f, beta_b, d_b, delta_sign=-1.0):
    """A_b, Delta_b, sigma_b of Zinke et al. 2008 in the stable forms of FORMULAS C; floats or arrays."""
    q = a_b / ((1 - a_f) * (1 + a_f))
    amount = a_f**2 * q + a_f**2 * q**3
    shift = alpha_b * (1 + delta_sign * 2 * q**2) + alpha_f * (2 + 4 * a_f**2 * q**2) / ((1 - a_f) * (1 + a_f))
    once, thrice = (2 * beta_f**2 + beta_b**2) ** 0.5, (2 * beta_f**2 + 3 * beta_b**2) ** 0.5
    width = (1 + d_b * a_f**2) * (once + a_b**2 * thrice) / (1 + a_b**2 * (2 * beta_f + 3 * beta_b))
    return amount, shift, width
