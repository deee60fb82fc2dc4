"""Limits of the model, each with the rate at which it is approached and a bound.

A limit that is merely small at the end of the list may be wrong by a constant that the last parameter hides. So every
case is a sequence of parameters, the distance from the limit at each, the order of its decay (distance ~
parameter^order, read off the last three steps), and a bound that every distance has to keep.
"""

from __future__ import annotations

import copy
import math

import numpy as np
import torch
from torch import Tensor

from dsfit.bsdf.attenuation import lobe_energies
from dsfit.bsdf.azimuthal import refractions, simplified_shapes
from dsfit.bsdf.dual_scattering import DualScattering
from dsfit.bsdf.fiber import Fiber
from dsfit.checks.furnace.approach import STEPS, Approach, approach, linear_approach, slope_at_zero
from dsfit.checks.furnace.energy import independent_energies, single_furnace
from dsfit.checks.furnace.symmetry import directions
from dsfit.frame import HALF_PI, theta_diff
from dsfit.quadrature import panel_points


def scattering_limits(bsdf: DualScattering, generator: torch.Generator) -> list[Approach]:
    """n -> 0, v -> 1, d_b -> 0 and n -> inf.

    n -> 0: F_scatter tends to `d_f (f_s^G + d_b f_back(sigma_b^2))` with unwidened lobes, linearly in n. That is not
    F_direct: scattered light comes from a half circle of directions whatever n, so its azimuths are N^G, and it carries
    d_f. v = 1 leaves F_direct whatever n, and F is linear in v (where a convention knows a share at all). d_b = 0 is
    the same as leaving back scattering out. T_f = d_f a_f^n vanishes exponentially as a_f < 1.
    """
    theta_i, theta_r, phi, phi_h = directions(200, generator, 1.3)
    convention = bsdf.convention
    angle = theta_i if convention.average_angle == "theta_in" else theta_diff(theta_i, theta_r)
    with torch.no_grad():
        zero = torch.zeros_like(bsdf.averages(angle).a_f)
        factor = math.pi if convention.back_factor == "pi" else 1.0
        lobes = bsdf.single_scattered(theta_i, theta_r, phi, zero, phi_h=phi_h)
        undamped = lobes + factor * bsdf.d_b * bsdf.back_scattering(theta_i, theta_r, phi)
        single = bsdf.single(theta_i, theta_r, phi, phi_h=phi_h)
        direct = bsdf.direct(theta_i, theta_r, phi, 2.0, phi_h=phi_h) * torch.cos(theta_i)[:, None]
        a_f = float(bsdf.averages(angle).a_f.max())
    found = [
        linear_approach(
            "n to 0: F_scatter",
            lambda n: bsdf.scatter(theta_i, theta_r, phi, n, phi_h=phi_h),
            bsdf.d_f**convention.density_power * undamped,
            "linear in n, at most twice its slope",
        ),
        linear_approach(
            "d_b to 0: back scattering off",
            lambda x: with_d_b(bsdf, x).direct(theta_i, theta_r, phi, phi_h=phi_h),
            single,
            "linear in d_b, at most twice its slope",
        ),
        approach(
            "n to inf: a_f^n",
            lambda x: bsdf.transmittance(angle, torch.full_like(angle, 1 / x)),
            torch.zeros(()),
            (1.0, 0.1, 0.01, 0.001),
            lambda x: float(bsdf.d_f) * min(a_f, 1.0) ** (1 / x) * (1 + 1e-9),
            0.0,
            "at most d_f (max a_f)^n, a_f < 1",
        ),
    ]
    if convention.share == "complement":
        found.append(
            linear_approach(
                "v to 1: F_direct",
                lambda x: bsdf(theta_i, theta_r, phi, 2.0, 1.0 - x, phi_h=phi_h),
                direct,
                "linear in 1 - v, at most twice its slope",
            )
        )
    return found


def with_d_b(bsdf: DualScattering, d_b: float) -> DualScattering:
    """The same BSDF with another d_b, sharing its tables, which do not depend on it."""
    other = copy.copy(bsdf)
    other.d_b = torch.as_tensor(d_b, dtype=bsdf.fiber.dtype)
    return other


def absorbing_limit(bsdf: DualScattering) -> Approach:
    """sigma_a -> inf: only R is left.

    Inside, a ray travels at least s = 2 sqrt(1 - 1/eta^2) radii per segment, so `E_p(sigma) <= E_p(0) exp(-p s sigma)`
    (twice the square of sqrt(1 - 1/eta^2), times 2, for the absorption printed in 2003).
    """
    fiber, absorption = bsdf.fiber, bsdf.convention.absorption
    diff = torch.linspace(0.0, 1.5, 7, dtype=torch.float64)
    least = fiber.eta if fiber.is_round else fiber.eta_trt(torch.tensor([0.0, HALF_PI])).min()
    gap = float(1 - 1 / torch.minimum(fiber.eta, least) ** 2)
    path = 2 * math.sqrt(gap) if absorption == "geometric" else 4 * gap

    def inner(inverse: float) -> Tensor:
        sigma = torch.full_like(fiber.sigma_a, 1 / inverse)
        phi_h = None if fiber.is_round else torch.zeros_like(diff)
        bent = refractions(fiber, diff, phi_h)
        return lobe_energies(bent, sigma, absorption)[:, 1:]

    return approach(
        "sigma_a to inf: only R",
        inner,
        torch.zeros(()),
        (0.5, 0.25, 0.125, 0.0625, 0.03125),
        lambda x: math.exp(-path / x),
        0.0,
        "at most exp(-sigma x shortest path)",
    )


def narrow_limit(bsdf: DualScattering) -> Approach:
    """beta -> 0: the furnace of single scattering tends to the specular fibre's,
    `2 c_M sum_p E_p(theta_diff) cos^2(theta_o) / cos^2(theta_diff)` at theta_o = 2 alpha_p - theta_i, quadratically.

    With k the function of theta_h that the lobe averages, the distance is at most max |k''| beta^2 / 2 (a round
    section and the first channel are taken). E_p by code of its own.
    """
    fiber = bsdf.fiber.replace(eccentricity=torch.ones_like(bsdf.fiber.eta), sigma_a=bsdf.fiber.sigma_a[..., :1])
    theta_i = torch.tensor([0.0, 0.5, -1.0], dtype=torch.float64)
    ratio = fiber.beta / fiber.beta.max()
    steps = tuple(math.radians(x) for x in (1.0, 0.5, 0.25))
    alpha, scale = fiber.alpha.numpy()[:, None], 2 * bsdf.convention.lobe_constant

    def averaged(theta_h: np.ndarray) -> np.ndarray:
        """k of every lobe at theta_h `[3, 3 inclinations]`, `[3, 3, C]`."""
        diff, out = theta_h - theta_i.numpy(), 2 * theta_h - theta_i.numpy()
        energies = independent_energies(
            float(fiber.eta), diff[..., None], fiber.sigma_a.numpy(), bsdf.convention.absorption
        )
        lobes = np.stack([energies[p, ..., p] for p in range(3)])
        cosines = np.where(np.abs(out) < HALF_PI, np.cos(out) ** 2 / np.cos(diff) ** 2, 0.0)
        return scale * lobes * cosines[..., None]

    limit = averaged(alpha + 0 * theta_i.numpy()).sum(0)
    step, reach = 1e-2, np.linspace(-8, 8, 17) * steps[0]
    bends = [averaged(alpha + x + step) - 2 * averaged(alpha + x) + averaged(alpha + x - step) for x in reach]
    curvature = np.abs(np.array(bends)).max(0) / step**2
    norm = "energy" if bsdf.convention.lobe_norm == "energy" else "printed"

    def furnace(beta: float) -> Tensor:
        return single_furnace(fiber.replace(beta=beta * ratio), theta_i, norm, bsdf.convention.absorption)

    def bound(beta: float) -> float:
        spread = (curvature * (beta * ratio.numpy()[:, None, None]) ** 2 / 2).sum(0)
        return 1.05 * float(spread.max()) / float(limit.max()) + 1e-9

    law = "quadratic in beta, at most max |k''| beta^2 / 2"
    return approach("beta to 0: specular furnace", furnace, torch.from_numpy(limit), steps, bound, 1.8, law)


def wide_azimuth_limit(bsdf: DualScattering) -> Approach:
    """gamma_TT -> inf in the simplified azimuths: TT becomes uniform, `|g - 1/(2 pi)| <= exp(-gamma^2/2) / (pi (1 -
    exp(-3 gamma^2/2)))`, the first Fourier coefficient and a geometric series for the others."""
    phi = torch.linspace(-math.pi, math.pi, 41, dtype=torch.float64)
    steps = (1.0, 0.5, 1 / 3, 0.25, 0.125)

    def shape(inverse: float) -> Tensor:
        fiber = bsdf.fiber.replace(gamma_tt=torch.full_like(bsdf.fiber.gamma_tt, 1 / inverse))
        return simplified_shapes(fiber, phi)[:, 1]

    def bound(inverse: float) -> float:
        q = math.exp(-0.5 / inverse**2)
        return 2 * q / (1 - q**3)

    uniform = torch.full((), 1 / (2 * math.pi), dtype=torch.float64)
    law = "at most the first term of its Fourier series"
    return approach("gamma_TT to inf: uniform", shape, uniform, steps, bound, 0.0, law)


def round_limit(bsdf: DualScattering, generator: torch.Generator) -> Approach:
    """eccentricity a -> 1: f_s tends to that of the round section; eta* - eta ~ -4 (eta - 1) cos(2 phi_h) (1 - a).

    In the mean over directions: N_TRT starts like a square root at its edges, which move with eta*, so that the largest
    distance is only of order 1/2.
    """
    theta_i, theta_r, phi, phi_h = directions(2000, generator, 1.2)
    plain = bsdf.replace(fiber=_with_eccentricity(bsdf.fiber, 1.0), precision="exact")
    with torch.no_grad():
        limit = plain.single(theta_i, theta_r, phi)

    def distance(x: float) -> Tensor:
        bent = plain.replace(fiber=_with_eccentricity(bsdf.fiber, 1.0 - x))
        return (bent.single(theta_i, theta_r, phi, phi_h=phi_h) - limit).abs().mean() / limit.mean()

    slope = slope_at_zero(distance)
    law = "linear in 1 - a, at most twice its slope"
    return approach("eccentricity to 1: round", distance, torch.zeros(()), STEPS, lambda x: 2 * slope * x, 0.9, law)


def _with_eccentricity(fiber: Fiber, value: float) -> Fiber:
    return fiber.replace(eccentricity=torch.full_like(fiber.eccentricity, value))


def matched_limit(bsdf: DualScattering) -> Approach:
    """eta -> 1: R vanishes, linearly in delta = eta^2 - 1.

    |r_p| <= |r_s| = delta / (c + sqrt(c^2 + delta))^2 for the cosine c = cos(theta_diff) cos(gamma); integrated over
    offsets, with k = cos(theta_diff): `E_R <= sqrt(2) delta / (12 k^2) + delta^2 / (4 sqrt(2) k^4)`.
    """
    diff = torch.linspace(0.0, 1.4, 5, dtype=torch.float64)
    k = float(torch.cos(diff[-1]))

    def reflected(x: float) -> Tensor:
        fiber = _with_eccentricity(bsdf.fiber, 1.0).replace(eta=torch.full_like(bsdf.fiber.eta, 1.0 + x))
        phi, weight = panel_points(math.pi * (1 - torch.logspace(0, -30, 31, base=2.0, dtype=torch.float64)), 12)
        values = bsdf.replace(fiber=fiber, azimuthal="marschner", precision="exact").azimuthal(diff[:, None], phi)
        return 2 * (values[..., 0, :] * weight[:, None]).sum(1)

    def bound(x: float) -> float:
        delta = (1 + x) ** 2 - 1
        return math.sqrt(2) * delta / (12 * k**2) + delta**2 / (4 * math.sqrt(2) * k**4)

    law = "linear in eta^2 - 1, at most the bound from |r_s|"
    return approach("eta to 1: R vanishes", reflected, torch.zeros(()), STEPS, bound, 0.9, law)


def limits(bsdf: DualScattering, *, generator: torch.Generator) -> list[Approach]:
    """All limits of a BSDF of one fibre; about 3 s, most of it tables for other fibres."""
    return [
        *scattering_limits(bsdf, generator),
        absorbing_limit(bsdf),
        narrow_limit(bsdf),
        wide_azimuth_limit(bsdf),
        round_limit(bsdf, generator),
        matched_limit(bsdf),
    ]
