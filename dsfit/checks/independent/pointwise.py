"""|F| at single directions against other ways of computing it: sharper than statistics, where there is another way."""

from __future__ import annotations

import math

import numpy as np
import torch
from scipy import stats
from torch import Tensor

from dsfit.bsdf.conventions import Convention
from dsfit.context import Context
from dsfit.frame import wrap
from dsfit.scene.integrand import Integrand


def exact_integrand(integrand: Integrand) -> Integrand | None:
    """The same integrand without tables; None if it has none."""
    if integrand.bsdf.precision == "exact":
        return None
    return Integrand(integrand.bsdf.replace(precision="exact"), integrand.light, integrand.scattering)


def assembly(integrand: Integrand, context: Context, omega: Tensor) -> np.ndarray | None:
    """F cos(theta_i) L put together once more from N_p, N^G_p and the averages, `[M, C]`, in the consistent convention:

        F = v (f_s + d_b f_back(0)) + (1 - v) d_f a_f^n (f_s^G + d_b f_back(n beta_f^2)),
        f_s = sum_p g(theta_h - alpha_p; beta_p) N_p / (2 cos^2 theta_diff),
        f_back(s) = A_b g(theta_h - Delta_b; sqrt(sigma_b^2 + s)) / (pi cos^2 theta_diff)

    (chapter eqs 4-9, 32). Plain numpy with scipy's normal density; sees wrong lobes, shares, cosines and widths, not
    wrong N_p or averages, which are the BSDF's own. None for other conventions and eccentric fibres.
    """
    bsdf = integrand.bsdf
    if bsdf.convention != Convention.named("consistent") or not bsdf.fiber.is_round:
        return None
    with torch.no_grad():
        n, v = (np.broadcast_to(x.numpy(), omega.shape[:1])[:, None] for x in integrand.scattering(omega, context))
        theta_i, theta_r = omega[:, 0], context.theta_r.expand(omega.shape[0])
        phi = wrap(context.phi_r - omega[:, 1])
        diff = 0.5 * (theta_r - theta_i)
        direct, spread = bsdf.azimuthal(diff, phi).numpy(), bsdf.azimuthal_scattered(diff, phi).numpy()
        mean = bsdf.averages(theta_i)
        averages = {name: getattr(mean, name).numpy() for name in ("a_f", "beta_f", "A_b", "delta_b", "sigma_b")}
        light = integrand.light(omega).numpy()
    half = 0.5 * (theta_i + theta_r).numpy()[:, None]
    alpha, beta = bsdf.fiber.alpha.numpy()[:, None], bsdf.fiber.beta.numpy()[:, None]
    share = 1 / (2 * np.cos(diff.numpy()) ** 2)[:, None]
    widened = n * averages["beta_f"] ** 2

    def lobes(azimuths: np.ndarray, extra: np.ndarray) -> np.ndarray:
        width = np.sqrt(beta**2 + extra[:, None, :])
        return share * (stats.norm.pdf(half[:, None, :], alpha, width) * azimuths).sum(axis=1)

    def back(extra: np.ndarray) -> np.ndarray:
        lobe = stats.norm.pdf(half, averages["delta_b"], np.sqrt(averages["sigma_b"] ** 2 + extra))
        return 2 * share * averages["A_b"] * lobe / math.pi

    d_f, d_b = float(bsdf.d_f), float(bsdf.d_b)
    lit = lobes(direct, 0 * widened) + d_b * back(0 * widened)
    scattered = d_f * averages["a_f"] ** n * (lobes(spread, widened) + d_b * back(widened))
    return (v * lit + (1 - v) * scattered) * np.cos(theta_i.numpy())[:, None] * light


def deviations(found: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """|found - expected| / |expected| with Euclidean norms over channels, `[M]`."""
    return np.linalg.norm(found - expected, axis=-1) / np.maximum(np.linalg.norm(expected, axis=-1), 1e-300)
