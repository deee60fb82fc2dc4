"""Controls of the scattering equations (4)-(12) and (32)."""

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
from dsfit.checks.controls.energy import ENERGY_BOUND, LIGHT, energy_gap, outgoing_energy, smooth_bsdf
from dsfit.checks.controls.scene import (
    DEG,
    THETA_R,
    N,
    V,
    bsdf,
    context,
    integrand,
    non_absorbing,
    number,
    ratio,
    terms,
)
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
    return Trial(_z_test(printed, truth), _z_test(corrected, truth), None, effect, {"ratio": share})


def _z_test(values: Tensor, truth: float) -> float:
    z = (float(values.mean()) - truth) / (float(values.std()) / math.sqrt(len(values)))
    return float(2 * stats.norm.sf(abs(z)))


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


def _back_gap(model: DualScattering) -> float:
    """|int f_back cos(theta_o) domega_o / (2 A_b) - 1| over the back half: f_back = 2 A_b S_b / cos, S_b of unit
    integral."""
    albedo = float(model.averages(torch.tensor(LIGHT, dtype=torch.float64)).A_b)
    return abs(outgoing_energy(model.back_scattering, phi_max=math.pi / 2) / (2 * albedo) - 1)


@CONTROLS.add(
    "back_projection",
    "(7)",
    printed="f^back = 2 A_b g",
    corrected="f^back = 2 A_b g / (π cos²θ_diff)",
    kind="bias",
    check="S_b integrates to 1 over the back half",
)
def back_projection(seed: int) -> Trial:
    right = terms()
    factor = math.pi * cos_inclination(theta_diff(right.theta_i, torch.full_like(right.theta_i, THETA_R))) ** 2
    wrong = dataclasses.replace(right, back=right.back * factor, back_scattered=right.back_scattered * factor)
    back = float((right.weight * wrong.back).sum() / (right.weight * right.back).sum())
    found = ratio(wrong)
    effect = f"back scattering ×{back:.2f}, all light ×{found:.3f}"
    printed, corrected = (_back_gap(smooth_bsdf(d_b=0.7, convention=Convention(inverse_cos2=k))) for k in (False, True))
    return Trial(printed, corrected, 1e-4, effect, {"ratio": found, "back_ratio": back})


@CONTROLS.add(
    "back_argument",
    "(7)",
    printed="g(…, θ_d + θ_o − Δ_b), θ_d = (θ_r − θ_i)/2",
    corrected="g(θ_h − Δ_b; …)",
    kind="bias",
    check="an untilted fibre scatters back about the mirror direction",
)
def back_argument(seed: int) -> Trial:
    theta_r = 20 * DEG
    theta_i = torch.linspace(-math.pi / 2, math.pi / 2, 3601, dtype=torch.float64)
    viewer = torch.full_like(theta_i, theta_r)

    def peak(argument: str) -> float:
        model = smooth_bsdf(d_b=0.7, convention=Convention(back_argument=argument))
        fiber = type(model.fiber)(sigma_a=(0.0,), alpha=(0.0, 0.0, 0.0), beta=(DEG, DEG, DEG))
        lobe = model.replace(fiber=fiber).back_scattering(theta_i, viewer, torch.zeros_like(theta_i))[:, 0]
        return float(theta_i[int(lobe.argmax())])

    printed, corrected = peak("theta_diff+theta_r"), peak("theta_h")
    right = terms()
    moved = terms(back_argument="theta_diff+theta_r")
    wrong = dataclasses.replace(right, back=moved.back, back_scattered=moved.back_scattered)
    back = float((right.weight * wrong.back).sum() / (right.weight * right.back).sum())
    effect = f"peak at {number(printed / DEG, 0)}° instead of −20° (θ_r = 20°); back scattering ×{back:.3f}"
    data = {"peak_deg": printed / DEG, "back_ratio": back, "ratio": ratio(wrong)}
    return Trial(abs(printed + theta_r), abs(corrected + theta_r), 1 * DEG, effect, data)


@CONTROLS.add(
    "back_width",
    "(5), (7)",
    printed="width σ_b² + σ_f² in direct light too",
    corrected="σ_b² in F^direct, σ_b² + σ_f² in F^scatter",
    kind="bias",
    check="direct light has met no fibres: no n in F^direct",
)
def back_width(seed: int) -> Trial:
    right = terms()
    i, r = right.theta_i, torch.full_like(right.theta_i, THETA_R)

    def change(mode: str) -> float:
        model = bsdf().replace(convention=Convention(back_width=mode))
        near, far = (model.direct(i, r, right.phi, torch.full_like(i, n)) for n in (0.0, 20.0))
        return float((far - near).abs().max() / near.max())

    average = bsdf().averages(torch.tensor(-THETA_R, dtype=torch.float64))
    width = float(average.sigma_b) / DEG
    wide = math.hypot(width, math.sqrt(20.0) * float(average.beta_f) / DEG)
    effect = f"direct back lobe {wide:.1f}° wide instead of {width:.1f}° at n = 20"
    data = {"printed_deg": wide, "corrected_deg": width}
    return Trial(change("always"), change("scatter"), 1e-12, effect, data)


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
    "back_pi",
    "(8)",
    printed="π d_b f_back beside N^G with its 1/π",
    corrected="d_b f_back",
    kind="bias",
    check="(11) leaves what does not depend on φ as it is",
)
def back_pi(seed: int) -> Trial:
    right = terms()
    wrong = dataclasses.replace(right, back_scattered=right.back_scattered * math.pi)

    def factor(mode: str) -> float:
        """f_back in F_scatter over the average of f_back over an incident half circle, at one pair of directions."""
        with_back, without = (
            smooth_bsdf(d_b=d_b, convention=Convention(back_factor=mode)) for d_b in (0.7, 0.0)
        )
        i, r, phi = (torch.tensor([x], dtype=torch.float64) for x in (0.5, -0.5, 0.3))
        turned = phi + torch.linspace(-math.pi / 2, math.pi / 2, 181, dtype=torch.float64)
        lobes = with_back.back_scattering(i.expand(181), r.expand(181), turned)[:, 0]
        average = float(torch.trapezoid(lobes, turned)) / math.pi
        back = float(with_back.scatter(i, r, phi, 0.0) - without.scatter(i, r, phi, 0.0))
        return back / (0.7 * 0.7 * average)

    found = ratio(wrong)
    printed, corrected = factor("pi"), factor("derived")
    effect = f"scattered back light ×{printed:.2f}, all light ×{found:.3f}"
    return Trial(abs(printed - 1), abs(corrected - 1), 1e-9, effect, {"ratio": found})


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
    "back_albedo",
    "(12) in A_b",
    printed="a_f of (12): above 1",
    corrected="a_f of g/2",
    kind="negative",
    check="0 ≤ A_b ≤ 5/8",
)
def back_albedo(seed: int) -> Trial:
    theta = torch.linspace(-80, 80, 33, dtype=torch.float64) * DEG

    def outside(norm: str) -> float:
        worst = 0.0
        for fiber in (bsdf().fiber, non_absorbing()):
            model = DualScattering(fiber, convention=Convention(lobe_norm=norm, limit_energy=False))
            found = model.averages(theta).A_b
            worst = max(worst, float((-found).max()), float((found - 0.625).max()))
        return worst

    zero = torch.zeros((), dtype=torch.float64)
    wrong = DualScattering(bsdf().fiber, convention=Convention(lobe_norm="printed", limit_energy=False)).averages(zero)
    a_f, albedo = float(wrong.a_f), float(wrong.A_b)
    right = float(bsdf().averages(zero).A_b)
    effect = f"a_f = {a_f:.2f}, A_b = {number(albedo, 2)} instead of {right:.2f} (θ = 0)"
    return Trial(
        outside("printed"), outside("energy"), 1e-3, effect, {"a_f": a_f, "A_b": albedo, "corrected_A_b": right}
    )


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
