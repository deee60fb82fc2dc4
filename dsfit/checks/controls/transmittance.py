"""Controls of sampling the transmittance, eqs (33)-(35), and of what the text says about it."""

from __future__ import annotations

import functools
import math

import numpy as np
import torch
from scipy import stats
from torch import Tensor

from dsfit.bsdf.attenuation import lobe_energies
from dsfit.bsdf.dual_scattering import DualScattering
from dsfit.bsdf.fiber import Fiber
from dsfit.bsdf.snell import Refraction
from dsfit.checks.controls.base import Registry, Trial
from dsfit.checks.controls.longitudinal import CHI_SQUARE, MASS, MASS_BOUND
from dsfit.checks.controls.samplers import TransmittanceMassSlip, mass_gap, sampler_test
from dsfit.checks.controls.scene import DEG, THETA_R, bsdf, number, terms
from dsfit.fit.transmittance import TransmittanceFit, fit_transmittance
from dsfit.frame import HALF_PI
from dsfit.proposals.base import Product
from dsfit.proposals.printed import TransmittanceInclinationAsPrinted
from dsfit.proposals.printed import transmittance_cdf as printed_cdf
from dsfit.proposals.transmittance import TransmittanceCosine
from dsfit.proposals.uniform import UniformAzimuth, UniformSphere
from dsfit.quadrature import panel_points

CONTROLS = Registry()
DEEP = 50.0
CLOSE = 0.01
"""Excess over a_f^n that a law fitted to it may have."""


@CONTROLS.add(
    "transmittance_mass",
    "(33)",
    printed="p(θ_d) = cosθ_d / 2",
    corrected="cosθ_d / (√2 cos(θ_r/2)) on what θ_r reaches",
    kind="not a density",
    check=MASS,
)
def transmittance_mass(seed: int) -> Trial:
    corrected = Product(TransmittanceCosine(), UniformAzimuth())
    tests = [sampler_test(law, THETA_R, seed) for law in (TransmittanceMassSlip(), corrected)]
    mass = tests[0].mass
    effect = f"mass {mass:.3f}: {1 - mass:.1%} of the directions cannot occur; read as θ_d = θ_i it is a uniform sphere"
    return Trial(mass_gap(tests[0]), mass_gap(tests[1]), MASS_BOUND, effect, {"mass": mass})


@CONTROLS.add(
    "transmittance_cdf",
    "(34)",
    printed="P(θ_d) = 1 + sinθ_d",
    corrected="(1 + sinθ_d) / 2 for (33)",
    kind="not a density",
    check="P is the integral of (33), P(π/2) = 1",
)
def transmittance_cdf(seed: int) -> Trial:
    ends = torch.linspace(-HALF_PI, HALF_PI, 33, dtype=torch.float64)
    mass = torch.stack([_cosine_mass(float(end)) for end in ends])
    printed, corrected = printed_cdf(ends), (1 + torch.sin(ends)) / 2
    gap = [float((p - mass).abs().max()) for p in (printed, corrected)]
    return Trial(gap[0], gap[1], 1e-12, f"P(π/2) = {float(printed[-1]):.0f}", {"end": float(printed[-1])})


def _cosine_mass(end: float) -> Tensor:
    x, weight = panel_points(torch.linspace(-HALF_PI, end, 5, dtype=torch.float64), 16)
    return (weight * torch.cos(x) / 2).sum()


@CONTROLS.add(
    "transmittance_inverse",
    "(35)",
    printed="θ_d = asin(ξ − 1)",
    corrected="asin(2ξ − 1) for (33)",
    kind="bias",
    check=CHI_SQUARE,
)
def transmittance_inverse(seed: int) -> Trial:
    """theta_d read as theta_i, so that nothing else is wrong: the lower half of the sphere at twice its density."""
    printed = sampler_test(TransmittanceInclinationAsPrinted(), THETA_R, seed)
    corrected = sampler_test(UniformSphere(), THETA_R, seed, 1)
    shares = []
    for theta_r in (THETA_R, -THETA_R):
        scene = terms(theta_r)
        value = scene.weight * scene.total
        shares.append(2 * float(value[scene.theta_i < 0].sum() / value.sum()))
    effect = f"θ_d > 0 never drawn: ×{shares[0]:.2f} at θ_r = 45°, ×{shares[1]:.3f} at −45°"
    data = {"ratio": shares[0], "ratio_below": shares[1]}
    return Trial(printed.p_value, corrected.p_value, None, effect, data)


@functools.cache
def _fit() -> TransmittanceFit:
    """Truncated Gaussians fitted to a_f(theta)^50 of the scene's hair."""
    return fit_transmittance(bsdf(), (DEEP,))[0]


@CONTROLS.add(
    "transmittance_centre",
    "text before (33)",
    printed="a_fⁿ peaks at θ_d = 0",
    corrected="peak shifted by the tilt of the cuticle",
    kind="variance",
    check=f"excess over a_fⁿ below {CLOSE}",
)
def transmittance_centre(seed: int) -> Trial:
    fit = _fit()
    effect = (
        f"centred at {number(fit.centre / DEG, plus='+')}° (n = 50): "
        f"excess {fit.excess_centred:.3f} for a Gaussian about 0, {fit.excess:.3f} about that"
    )
    data = {"centre_deg": fit.centre / DEG, "excess_centred": fit.excess_centred, "excess": fit.excess}
    return Trial(fit.excess_centred, fit.excess, CLOSE, effect, data)


@CONTROLS.add(
    "transmittance_width",
    "(33)",
    printed="cosθ_d for every n",
    corrected="a width that shrinks with n",
    kind="variance",
    check=f"excess over a_fⁿ below {CLOSE}",
)
def transmittance_width(seed: int) -> Trial:
    fit = _fit()
    cosine = math.sqrt(math.pi**2 / 4 - 2) / DEG
    effect = (
        f"std {cosine:.1f}° for every n, a_fⁿ has {fit.std / DEG:.1f}° at n = 50: "
        f"excess {fit.excess_cosine:.2f} instead of {fit.excess:.3f}"
    )
    data = {"std_deg": fit.std / DEG, "excess_cosine": fit.excess_cosine, "excess": fit.excess}
    return Trial(fit.excess_cosine, fit.excess, CLOSE, effect, data)


@CONTROLS.add(
    "absorption_shape",
    "text before (33)",
    printed="absorption does not change the scattering behaviour",
    corrected="it takes TT and TRT away and leaves R",
    kind="bias",
    check="chi-square of rays traced through brown hair",
)
def absorption_shape(seed: int) -> Trial:
    brown, clear = (Fiber(sigma_a=(s,)) for s in (0.612, 0.0))
    observed = traced_lobes(float(brown.sigma_a), 100_000, seed)
    p_values, shares = [], []
    for fiber in (clear, brown):
        bent = Refraction.at(fiber.eta, torch.zeros((), dtype=torch.float64))
        energy = lobe_energies((bent, bent, bent), fiber.sigma_a, "geometric")[:, 0].numpy()
        shares.append(float(energy[1] / energy.sum()))
        p_values.append(float(stats.chisquare(observed, energy / energy.sum() * observed.sum()).pvalue))
    zero = torch.zeros((), dtype=torch.float64)
    shift = [float(DualScattering(Fiber(sigma_a=(s,))).averages(zero).alpha_f) / DEG for s in (0.0, 5.58)]
    effect = (
        f"TT carries {shares[0]:.0%} of the light of clear hair and {shares[1]:.0%} of brown; "
        f"forward shift α_f {number(shift[0], plus='+')}° in clear hair, {number(shift[1])}° in black"
    )
    data = {"clear_tt": shares[0], "brown_tt": shares[1], "clear_deg": shift[0], "black_deg": shift[1]}
    return Trial(p_values[0], p_values[1], None, effect, data)


def traced_lobes(sigma_a: float, rays: int, seed: int, eta: float = 1.55) -> np.ndarray:
    """How many of `rays` rays in the normal plane left as R, TT and TRT, `[3]`: Fresnel, Snell and Beer in numpy,
    without the library's optics."""
    rng = np.random.default_rng(seed)
    sine = rng.uniform(-1, 1, rays)
    outer, inner = np.sqrt(1 - sine**2), np.sqrt(1 - (sine / eta) ** 2)
    r_s, r_p = (outer - eta * inner) / (outer + eta * inner), (eta * outer - inner) / (eta * outer + inner)
    reflected, passed = (r_s**2 + r_p**2) / 2, np.exp(-2 * sigma_a * inner)
    entered, first = 1 - reflected, rng.random(rays) < reflected
    inside = ~first & (rng.random(rays) < passed)
    out = inside & (rng.random(rays) < entered)
    again = inside & ~out & (rng.random(rays) < passed)
    last = again & (rng.random(rays) < entered)
    return np.array([first.sum(), out.sum(), last.sum()])
