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


@dataclass(frozen=True)
class Slips:
    """Single switches between the two conventions, named and valued as the fields of dsfit.Convention."""

    lobe_norm: str = "energy"
    inverse_cos2: bool = True
    share: str = "complement"
    density_power: int = 1
    back_factor: str = "derived"
    scattered_azimuth: str = "convolution"
    back_argument: str = "theta_h"
    back_width: str = "scatter"
    back_azimuth: str = "all"
    shift_sign: str = "minus"
    absorption: str = "geometric"
    split: str = "fraction"
    mean_width: str = "variance"
    average_weight: str = "incident"
    average_angle: str = "theta_in"
    limit_energy: bool = True
    simplified_energy: str = "attenuation"

    def options(self) -> Options:
        """What of this concerns the averages."""
        return Options(
            c_m=0.5 if self.lobe_norm == "energy" else 1.0,
            cosine=self.average_weight,
            split="linear" if self.split == "fraction" else "half",
            width="variance" if self.mean_width == "variance" else "mean",
            delta_sign=-1.0 if self.shift_sign == "minus" else 1.0,
            rescale=self.limit_energy,
        )

    def fiber(self, fiber: Fiber) -> Fiber:
        return replace(fiber, absorption="geometric" if self.absorption == "geometric" else "printed")


PRINTED_SLIPS = Slips(
    lobe_norm="printed",
    inverse_cos2=False,
    share="sum",
    density_power=2,
    back_factor="pi",
    scattered_azimuth="constant",
    back_argument="theta_diff+theta_r",
    back_width="always",
    average_angle="theta_diff",
    limit_energy=False,
    simplified_energy="printed",
)


def general(
    fiber: Fiber,
    g: Geometry,
    n: float,
    v: float,
    model: str = "marschner",
    d_f: float = 0.7,
    d_b: float = 0.7,
    slips: Slips | None = None,
    order: int = 16,
) -> tuple[np.ndarray, np.ndarray]:
    """(F cos(theta_i), its size), each [C], for any switches; size: sum of |terms|, Gaussians at their maximum."""
    slips = slips or Slips()
    fiber, options = slips.fiber(fiber), slips.options()
    a = averages(fiber, g.theta_i if slips.average_angle == "theta_in" else g.theta_diff, d_b, options, order)
    sigma_f2 = n * a.beta_f**2
    single_factor = options.c_m / (math.cos(g.theta_diff) ** 2 if slips.inverse_cos2 else 1.0)
    back_factor = 2.0 * single_factor / (math.pi if slips.inverse_cos2 else 1.0)
    unit = model == "simplified" and slips.simplified_energy == "printed"
    argument = g.theta_h if slips.back_argument == "theta_h" else g.theta_diff + g.theta_r
    if slips.back_azimuth == "back" and abs(wrap(g.phi)) > HALF_PI:
        back_factor = 0.0
    lit, shaded = (1.0, 1.0) if slips.share == "sum" else (v, 1.0 - v)
    shaded = shaded * a.a_f**n * d_f**slips.density_power
    phi = g.phi if slips.scattered_azimuth == "convolution" else 0.0
    extra_lit = sigma_f2 if slips.back_width == "always" else 0.0 * sigma_f2
    pi_back = math.pi if slips.back_factor == "pi" else 1.0

    def gauss(x: np.ndarray | float, variance: np.ndarray | float) -> np.ndarray:
        """Value and maximum of a Gaussian, [2, C]."""
        x, variance = np.broadcast_arrays(np.asarray(x) + 0.0 * a.a_f, np.asarray(variance) + 0.0 * a.a_f)
        height = 1.0 / np.sqrt(2.0 * math.pi * variance)
        return np.array([np.exp(-0.5 * x * x / variance) * height, height])

    total = np.zeros((2, len(fiber.sigma_a)))
    for p in range(3):
        offset, variance = g.theta_h - fiber.alpha[p], fiber.beta[p] ** 2
        total += (
            lit
            * single_factor
            * gauss(offset, variance)
            * azimuthal(fiber, p, g.theta_diff, g.phi, model, g.phi_h, unit)
        )
        if np.any(shaded != 0.0):
            spread = scattered(fiber, p, g.theta_diff, phi, model, g.phi_h, unit)
            total += shaded * single_factor * gauss(offset, variance + sigma_f2) * spread
    height = np.array([a.A_b, np.abs(a.A_b)]) * d_b * back_factor
    total += lit * height * gauss(argument - a.delta_b, a.sigma_b**2 + extra_lit)
    total += shaded * pi_back * height * gauss(argument - a.delta_b, a.sigma_b**2 + sigma_f2)
    return total[0] * math.cos(g.theta_i), total[1] * math.cos(g.theta_i)
