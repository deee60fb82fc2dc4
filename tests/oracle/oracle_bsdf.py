"""Oracle for the dual scattering BSDF times cos(theta_i): conventions `consistent` and `printed`.

Consistent (FORMULAS 0, C):
    F = v (f_s + d_b f_back(sigma_b^2)) + (1 - v) a_f^n d_f (f_s^G + d_b f_back(sigma_b^2 + sigma_f^2)),
    sigma_f^2 = n beta_f^2,
    f_back = 2 c_M A_b g2(theta_h - Delta_b) / (pi cos^2 theta_diff), averages at theta_in = theta_i.
Printed: equations (4)-(12), (32) of the chapter word for word; see `printed`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from oracle_averages import Averages, Options, averages
from oracle_azimuth import HALF_PI, Fiber, azimuthal, gaussian, wrap
from oracle_scattered import scattered

CONSISTENT = Options()
PRINTED = Options(c_m=1.0, rescale=False)


@dataclass(frozen=True)
class Geometry:
    """One pair of directions. phi = phi_r - phi_i; phi_h = (phi_r + phi_i)/2 matters for elliptic fibres only."""

    theta_i: float
    theta_r: float
    phi: float
    phi_h: float = 0.0

    @property
    def theta_h(self) -> float:
        return 0.5 * (self.theta_i + self.theta_r)

    @property
    def theta_diff(self) -> float:
        return 0.5 * (self.theta_r - self.theta_i)


def gaussian_variance(x: float, variance: float) -> float:
    return gaussian(x, math.sqrt(variance))


def single(fiber: Fiber, g: Geometry, model: str, c_m: float = 0.5) -> np.ndarray:
    """f_s = c_M sum_p g(theta_h - alpha_p; beta_p) N_p / cos^2 theta_diff, [C]."""
    total = np.zeros(len(fiber.sigma_a))
    for p in range(3):
        total += gaussian(g.theta_h - fiber.alpha[p], fiber.beta[p]) * azimuthal(
            fiber, p, g.theta_diff, g.phi, model, g.phi_h
        )
    return c_m * total / math.cos(g.theta_diff) ** 2


def single_scattered(fiber: Fiber, g: Geometry, sigma_f2: np.ndarray, model: str, c_m: float = 0.5) -> np.ndarray:
    """f_s^G: the same with M^G = g2(theta_h - alpha_p; beta_p^2 + sigma_f^2) and N^G, [C]."""
    total = np.zeros(len(fiber.sigma_a))
    for p in range(3):
        m = np.array([gaussian_variance(g.theta_h - fiber.alpha[p], fiber.beta[p] ** 2 + s) for s in sigma_f2])
        total += m * scattered(fiber, p, g.theta_diff, g.phi, model, g.phi_h)
    return c_m * total / math.cos(g.theta_diff) ** 2


def back(g: Geometry, a: Averages, extra: np.ndarray, c_m: float = 0.5, azimuth: str = "all") -> np.ndarray:
    """f_back = 2 c_M A_b g2(theta_h - Delta_b; sigma_b^2 + extra)/(pi cos^2 theta_diff), [C].

    azimuth "back": 0 if |phi| > pi/2.
    """
    if azimuth == "back" and abs(wrap(g.phi)) > HALF_PI:
        return np.zeros_like(a.A_b)
    lobe = np.array(
        [gaussian_variance(g.theta_h - d, s * s + e) for d, s, e in zip(a.delta_b, a.sigma_b, extra, strict=True)]
    )
    return 2.0 * c_m * a.A_b * lobe / (math.pi * math.cos(g.theta_diff) ** 2)


def consistent(
    fiber: Fiber,
    g: Geometry,
    n: float,
    v: float,
    model: str = "marschner",
    d_f: float = 0.7,
    d_b: float = 0.7,
    options: Options = CONSISTENT,
    order: int = 16,
) -> np.ndarray:
    """F cos(theta_i), [C]."""
    a = averages(fiber, g.theta_i, d_b, options, order)
    sigma_f2 = n * a.beta_f**2
    direct = single(fiber, g, model, options.c_m) + d_b * back(g, a, 0.0 * sigma_f2, options.c_m)
    total = v * direct
    if v < 1.0:
        spread = single_scattered(fiber, g, sigma_f2, model, options.c_m) + d_b * back(g, a, sigma_f2, options.c_m)
        total = total + (1.0 - v) * a.a_f**n * d_f * spread
    return total * math.cos(g.theta_i)


def printed(
    fiber: Fiber,
    g: Geometry,
    n: float,
    model: str = "marschner",
    d_f: float = 0.7,
    d_b: float = 0.7,
    order: int = 16,
) -> np.ndarray:
    """The chapter's f of eqs (4)-(12), (32) as printed, [C].

    Averages with c_M = 1 and without rescaling, at theta_diff; f_back without 1/(pi cos^2) and around theta_diff +
    theta_r; N^G the constant of eq (11); d_f twice; direct and scattered light both counted, whatever v. The simplified
    lobes have weight 1 (21), (25).
    """
    a = averages(fiber, g.theta_diff, d_b, PRINTED, order)
    sigma_f2 = n * a.beta_f**2
    unit = model == "simplified"
    f_direct, f_scatter = np.zeros(len(fiber.sigma_a)), np.zeros(len(fiber.sigma_a))
    for p in range(3):
        offset, beta = g.theta_h - fiber.alpha[p], fiber.beta[p]
        f_direct += gaussian(offset, beta) * azimuthal(fiber, p, g.theta_diff, g.phi, model, g.phi_h, unit)
        m_g = np.array([gaussian_variance(offset, beta**2 + s) for s in sigma_f2])
        f_scatter += m_g * scattered(fiber, p, g.theta_diff, 0.0, model, g.phi_h, unit)
    argument = g.theta_diff + g.theta_r
    lobe = [gaussian_variance(argument - d, s * s + e) for d, s, e in zip(a.delta_b, a.sigma_b, sigma_f2, strict=True)]
    f_back = 2.0 * a.A_b * np.array(lobe)
    transmitted = d_f * a.a_f**n
    direct = f_direct + d_b * f_back
    scatter = transmitted * d_f * (f_scatter + math.pi * d_b * f_back)
    return (direct + scatter) * math.cos(g.theta_i)


def peak(
    fiber: Fiber, g: Geometry, n: float, v: float, model: str = "marschner", d_f: float = 0.7, d_b: float = 0.7
) -> np.ndarray:
    """`consistent` with every longitudinal Gaussian at its maximum: the size against which tails are compared, [C]."""
    a = averages(fiber, g.theta_i, d_b)
    sigma_f2 = n * a.beta_f**2
    height = np.zeros(len(fiber.sigma_a))
    for p in range(3):
        near = gaussian(0.0, fiber.beta[p]) * azimuthal(fiber, p, g.theta_diff, g.phi, model, g.phi_h)
        far = 0.0
        if v < 1.0:
            far = scattered(fiber, p, g.theta_diff, g.phi, model, g.phi_h) / np.sqrt(
                2 * math.pi * (fiber.beta[p] ** 2 + sigma_f2)
            )
        height = height + v * near + (1 - v) * a.a_f**n * d_f * far
    lobe_near, lobe_far = a.sigma_b, np.sqrt(a.sigma_b**2 + sigma_f2)
    height = height + 2 * a.A_b * d_b / math.pi / math.sqrt(2 * math.pi) * (
        v / lobe_near + (1 - v) * a.a_f**n * d_f / lobe_far
    )
    return 0.5 * height / math.cos(g.theta_diff) ** 2 * math.cos(g.theta_i)


def with_channels(fiber: Fiber, sigma_a: tuple[float, ...]) -> Fiber:
    return replace(fiber, sigma_a=tuple(sigma_a))
