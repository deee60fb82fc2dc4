"""Controls of the scattering equations (4)-(6), (8)-(12) and (32); `backscatter` has those of f_back."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from scipy import stats
from torch import Tensor

from dsfit.bsdf.conventions import Convention
from dsfit.bsdf.dual_scattering import DualScattering
from dsfit.checks.controls.base import Registry, Trial, generator_of
from dsfit.checks.controls.energy import ENERGY_BOUND, energy_gap, outgoing_energy, smooth_bsdf
from dsfit.checks.controls.scene import (
    DEG,
    THETA_R,
    N,
    V,
    bsdf,
    context,
    integrand,
    nodes,
    number,
    ratio,
    terms,
)
from dsfit.checks.unbiased import z_test
from dsfit.frame import cos_inclination, theta_diff, to_vector
from dsfit.material import Material
from dsfit.proposals.structured import StructuredProposal
from dsfit.quality import reference

CONTROLS = Registry()
SMOOTH = "energy of a smooth fibre"


@CONTROLS.add(
    "pbrt_cosine",
    "(4)",
    printed="f = F cosθ_i, given to PBRT, which multiplies by |n·ω_i|",
    corrected="f = F cosθ_i / |n·ω_i|",
    kind="bias",
    check="z-score of a renderer's estimate",
)
def pbrt_cosine(seed: int) -> Trial:
    """An integrator that does what PBRT's do: mean of f |n . wi| / pdf."""
    point = context()
    proposal = StructuredProposal(bsdf(), point, defensive=0.05).requires_grad_(False)
    material = Material(bsdf(), proposal, N, V)
    viewer = to_vector(torch.stack([point.theta_r, point.phi_r]))
    dimension = material.proposal(material.context(viewer)).dimension
    u = torch.rand(20_000, dimension, generator=generator_of(seed), dtype=torch.float64)
    sample = material.sample_f(viewer, u.clamp(1e-12, 1 - 1e-12))
    cosine = sample.wi[:, 1].abs()
    truth = float(reference(integrand(), point, 1e-6).value)
    corrected = sample.f[:, 0] * cosine / sample.pdf
    printed = material.f_cos(viewer, sample.wi)[:, 0] * cosine / sample.pdf
    right = terms()
    share = float((right.weight * right.total * cos_inclination(right.theta_i) * torch.cos(right.phi).abs()).sum())
    share /= right.integral()
    effect = f"×{share:.3f} (viewer at φ_r = 0)"
    return Trial(z_test(printed, truth), z_test(corrected, truth), None, effect, {"ratio": share})


@CONTROLS.add(
    "direct_twice",
    "(4), (5), (8)",
    printed="F^direct + F^scatter",
    corrected="v F^direct + (1 − v) F^scatter",
    kind="bias",
    check=SMOOTH,
)
def direct_twice(seed: int) -> Trial:
    def lobe(share: str) -> Callable[[Tensor, Tensor, Tensor], Tensor]:
        model = _switched(share=share)
        return lambda i, r, phi: model(i, r, phi, 0.0, 1.0) / cos_inclination(i).unsqueeze(-1)

    lit = terms(n=0.0)
    both = float((lit.weight * (lit.direct + lit.scatter)).sum() / (lit.weight * lit.direct).sum())
    effect = f"×{both:.2f} in full light (n = 0, v = 1)"
    return _energy_trial(lobe("sum"), lobe("complement"), 1.0, effect, {"full_light_ratio": both})


def _switched(**switches: Any) -> DualScattering:
    """The smooth fibre in a convention with switches changed."""
    return smooth_bsdf(convention=Convention(**switches))


def _energy_trial(printed: Callable, corrected: Callable, expected: float, effect: str, data: dict) -> Trial:
    return Trial(energy_gap(printed, expected), energy_gap(corrected, expected), ENERGY_BOUND, effect, data)


@CONTROLS.add(
    "projection",
    "(6), (9)",
    printed="Σ M_X N_X, no cosines",
    corrected="Σ M_X N_X / cos²θ_diff",
    kind="bias",
    check=SMOOTH,
)
def projection(seed: int) -> Trial:
    right = terms()
    cos2 = cos_inclination(theta_diff(right.theta_i, torch.full_like(right.theta_i, THETA_R))) ** 2
    wrong = dataclasses.replace(right, single=right.single * cos2, single_scattered=right.single_scattered * cos2)
    lobe = _switched(inverse_cos2=False).single
    kept = outgoing_energy(lobe) / outgoing_energy(smooth_bsdf().single)
    found = ratio(wrong)
    effect = f"×{found:.3f}; a smooth fibre at 60° scatters ×{kept:.3f}"
    return _energy_trial(lobe, smooth_bsdf().single, 1.0, effect, {"ratio": found, "smooth_ratio": kept})


@CONTROLS.add(
    "density_twice",
    "(8), (32)",
    printed="T_f d_f with T_f = d_f ∏ a_f",
    corrected="d_f ∏ a_f",
    kind="bias",
    check=SMOOTH,
)
def density_twice(seed: int) -> Trial:
    right = terms()
    wrong = dataclasses.replace(right, transmittance=right.transmittance * float(bsdf().d_f))
    found = ratio(wrong)

    def lobe(power: int) -> Callable[[Tensor, Tensor, Tensor], Tensor]:
        return lambda i, r, phi: _switched(density_power=power).scatter(i, r, phi, 0.0)

    effect = f"scattered light ×{float(bsdf().d_f):.2f}, all light ×{found:.3f}"
    return _energy_trial(lobe(2), lobe(1), float(bsdf().d_f), effect, {"ratio": found})


@CONTROLS.add(
    "variance_argument",
    "(10), (12), (36)",
    printed="g(β_X² + σ_f², …) where (12) has g(β_X, …)",
    corrected="standard deviation √(β_X² + σ_f²)",
    kind="bias",
    check="Kolmogorov-Smirnov against simulated scattering",
)
def variance_argument(seed: int) -> Trial:
    """theta_h of light after n events of width beta_f and one of beta_TT: the sum of its turns."""
    fibers = int(N)
    beta = float(bsdf().fiber.beta[1])
    beta_f = float(bsdf().averages(torch.tensor(-THETA_R, dtype=torch.float64)).beta_f)
    turns = torch.randn(20_000, 1 + fibers, generator=generator_of(seed), dtype=torch.float64)
    theta = beta * turns[:, 0] + beta_f * turns[:, 1:].sum(-1)
    variance = beta**2 + fibers * beta_f**2
    p = [float(stats.kstest(np.asarray(theta), "norm", args=(0.0, s)).pvalue) for s in (variance, math.sqrt(variance))]
    effect = f"M_TT^G {variance / DEG:.2f}° wide instead of {math.sqrt(variance) / DEG:.2f}°"
    return Trial(p[0], p[1], None, effect, {"printed_deg": variance / DEG, "corrected_deg": math.sqrt(variance) / DEG})


@CONTROLS.add(
    "azimuth_constant",
    "(11), (37)",
    printed="(1/π) ∫ N_X(φ′) dφ′ over |φ′| < π/2: no φ left",
    corrected="(1/π) ∫ N_X(φ − φ′) dφ′",
    kind="bias",
    check=SMOOTH,
)
def azimuth_constant(seed: int) -> Trial:
    right = terms()
    wrong = dataclasses.replace(right, single_scattered=terms(scattered_azimuth="constant").single_scattered)
    found = ratio(wrong)
    zero, forward = (torch.tensor([x], dtype=torch.float64) for x in (0.0, math.pi))
    constant, true = (float(bsdf().azimuthal_scattered(zero, phi)[0, 1, 0]) for phi in (zero, forward))

    def lobe(mode: str) -> Callable[[Tensor, Tensor, Tensor], Tensor]:
        return lambda i, r, phi: _switched(scattered_azimuth=mode).scatter(i, r, phi, 0.0)

    effect = f"N_TT^G {constant:.4f} instead of {true:.3f} at φ = π; all light ×{found:.3f}"
    data = {"ratio": found, "printed_tt": constant, "corrected_tt": true}
    return _energy_trial(lobe("constant"), lobe("convolution"), float(bsdf().d_f), effect, data)


@CONTROLS.add(
    "lobe_energy",
    "(12)",
    printed="M_X = g(θ_h − α_X), unit integral in θ_h",
    corrected="g/2: dθ_i = 2 dθ_h",
    kind="bias",
    check=SMOOTH,
)
def lobe_energy(seed: int) -> Trial:
    lobe = _switched(lobe_norm="printed").single
    found = outgoing_energy(lobe)
    effect = f"×2: a smooth fibre at 60° scatters {found:.3f} of the light"
    return _energy_trial(lobe, smooth_bsdf().single, 1.0, effect, {"energy": found})


@CONTROLS.add(
    "average_angle",
    "(32)",
    printed="a_f(θ_d)ⁿ",
    corrected="∏ a_f(θ_i) of the light's own inclination",
    kind="bias",
    check="T_f does not depend on the viewer",
)
def average_angle(seed: int) -> Trial:
    viewers = torch.linspace(-60, 60, 25, dtype=torch.float64) * DEG
    light, n = torch.full_like(viewers, 0.3), torch.full_like(viewers, N)
    printed, corrected = bsdf().transmittance(theta_diff(light, viewers), n), bsdf().transmittance(light, n)
    right = terms()
    wrong = dataclasses.replace(right, transmittance=terms(average_angle="theta_diff").transmittance)
    found = ratio(wrong)
    spread = [float(x.max() / x.min() - 1) for x in (printed, corrected)]
    effect = f"×{found:.3f}; T_f varies ×{spread[0] + 1:.2f} with θ_r"
    return Trial(spread[0], spread[1], 1e-12, effect, {"ratio": found, "spread": spread[0]})


@CONTROLS.add(
    "all_together",
    "(4)–(12), (32)",
    printed="all of them at once",
    corrected="the model as above",
    kind="negative",
    check="F ≥ 0",
)
def all_together(seed: int) -> Trial:
    """The printed convention in the scene: A_b < 0 outweighs everything else."""
    theta_i, phi, weight = nodes()
    viewer = torch.full_like(theta_i, THETA_R)
    models = (bsdf().replace(convention="printed", precision="exact"), bsdf())
    printed, corrected = (model(theta_i, viewer, phi, N, V)[:, 0] for model in models)
    share = float(weight[printed < 0].sum() / weight.sum())
    found = float((weight * printed).sum() / (weight * corrected).sum())
    effect = f"×{number(found, 2)}: F is negative in {share:.0%} of the directions"
    dips = [max(0.0, -float(value.min())) / float(corrected.max()) for value in (printed, corrected)]
    return Trial(dips[0], dips[1], 1e-9, effect, {"integral_ratio": found, "negative": share})
