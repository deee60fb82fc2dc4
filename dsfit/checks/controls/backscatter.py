"""Controls of back scattering, in eqs (5), (7), (8) and (12)."""

from __future__ import annotations

import dataclasses
import math

import torch

from dsfit.bsdf.conventions import Convention
from dsfit.bsdf.dual_scattering import DualScattering
from dsfit.checks.controls.base import Registry, Trial
from dsfit.checks.controls.energy import LIGHT, outgoing_energy, smooth_bsdf
from dsfit.checks.controls.scene import (
    DEG,
    THETA_R,
    bsdf,
    non_absorbing,
    number,
    ratio,
    terms,
)
from dsfit.frame import cos_inclination, theta_diff

CONTROLS = Registry()


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
        with_back, without = (smooth_bsdf(d_b=d_b, convention=Convention(back_factor=mode)) for d_b in (0.7, 0.0))
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
