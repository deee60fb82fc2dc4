"""Controls of sampling the longitudinal lobes, eqs (13)-(20)."""

from __future__ import annotations

import math

import torch
from scipy.stats import norm

from dsfit.checks.controls.base import Registry, Trial
from dsfit.checks.controls.samplers import AngularSlip, ClampSlip, CorrectedLobe, MirrorSlip, mass_gap, sampler_test
from dsfit.checks.controls.scene import DEG, THETA_R, blond, number, terms
from dsfit.frame import HALF_PI, cos_inclination
from dsfit.proposals.printed import LobeAsPrinted, box_muller

CONTROLS = Registry()
MASS_BOUND = 1e-5
CHI_SQUARE = "chi-square of the sampler"
MASS = "integral over the sphere"
GRAZING = 85 * DEG


def _lobe(name: str) -> tuple[float, float]:
    """alpha and beta of a lobe of the scene's fibre, radians."""
    k = ("R", "TT", "TRT").index(name)
    fiber = blond()
    return float(fiber.alpha[k]), float(fiber.beta[k])


@CONTROLS.add(
    "box_muller_zero",
    "(13), (14)",
    printed="u_1 ∈ [0, 1]",
    corrected="u_1 ∈ (0, 1], as 1 − u",
    kind="NaN",
    check="finite directions on the closed unit square",
)
def box_muller_zero(seed: int) -> Trial:
    """What `torch.rand` can return, 0 included and 1 excluded, on both axes."""
    ends = torch.tensor([0.0, 2.0**-24, 0.25, 0.5, 1 - 2.0**-24], dtype=torch.float32)
    u1, u2 = torch.meshgrid(ends, ends, indexing="ij")
    bad = [int((~torch.cos(box_muller(u, u2)).isfinite()).sum()) for u in (u1, 1 - u1)]
    effect = "u_1 = 0, once in 2²⁴ float32 numbers, gives θ = ∞ and a direction of NaN"
    return Trial(float(bad[0]), float(bad[1]), 0.0, effect, {"not_finite": float(bad[0])})


@CONTROLS.add(
    "reach",
    "(16)",
    printed="|θ| ≤ π/2 − |θ_r/2 − α|",
    corrected="θ_r/2 − α − π/4 ≤ θ ≤ θ_r/2 − α + π/4",
    kind="bias",
    check="the ends of the interval are θ_i = ∓π/2",
)
def reach(seed: int) -> Trial:
    """What the interval lets through, what it cuts off, and what its obvious repair does near grazing."""
    alpha, beta = _lobe("R")
    middle = GRAZING / 2 - alpha
    limit = HALF_PI - abs(middle)
    ends = {"printed": (-limit, limit), "corrected": (middle - math.pi / 4, middle + math.pi / 4)}
    gap = {
        key: max(abs(2 * (t + alpha) - GRAZING - side * HALF_PI) for t, side in zip(pair, (-1, 1), strict=True))
        for key, pair in ends.items()
    }
    impossible = float(norm.cdf(ends["corrected"][0] / beta))
    shift, width = _lobe("TRT")
    center = -80 * DEG / 2 - shift
    cut = HALF_PI - abs(center)
    inside = norm.cdf((center + math.pi / 4) / width) - norm.cdf((center - math.pi / 4) / width)
    lost = float(norm.cdf(-cut / width) - norm.cdf((center - math.pi / 4) / width)) / float(inside)
    repaired = math.pi / 4 - abs(middle)
    effect = (
        f"{impossible:.1%} of M_R beyond |θ_i| = 90° (θ_r = 85°); {lost:.1%} of M_TRT never drawn (θ_r = −80°); "
        f"with π/4 for π/2 θ_max is {number(repaired / DEG)}° at 85° and no draw is accepted"
    )
    data = {"impossible": impossible, "lost": lost, "repaired_deg": repaired / DEG}
    return Trial(gap["printed"], gap["corrected"], 1e-12, effect, data)


@CONTROLS.add(
    "clamp",
    "(18)",
    printed="clamp θ_h to its interval",
    corrected="redraw or inverse CDF, density over its mass Z",
    kind="not a density",
    check=CHI_SQUARE,
)
def clamp(seed: int) -> Trial:
    theta_r = 80 * DEG
    alpha, beta = _lobe("R")
    test = sampler_test(ClampSlip(alpha, beta), theta_r, seed)
    share = float(norm.cdf((theta_r / 2 - math.pi / 4 - alpha) / beta))
    effect = f"{share:.1%} of M_R in the point θ_i = −90° (θ_r = 80°); the density has mass {test.mass:.3f}"
    right = sampler_test(CorrectedLobe(alpha, beta), theta_r, seed, 1)
    return Trial(test.p_value, right.p_value, None, effect, {"point_mass": share, "mass": test.mass})


@CONTROLS.add(
    "mirror_angle",
    "(19)",
    printed="θ_i = 2 θ_h − θ",
    corrected="θ_i = 2 θ_h − θ_r",
    kind="bias",
    check=CHI_SQUARE,
)
def mirror_angle(seed: int) -> Trial:
    alpha, beta = _lobe("R")
    printed, corrected = (
        sampler_test(law(alpha, beta), THETA_R, seed, k) for k, law in enumerate((MirrorSlip, CorrectedLobe))
    )
    u = torch.linspace(0, 1, 2001, dtype=torch.float64)[1:-1]
    u = torch.stack([u, u, torch.full_like(u, 0.5)], dim=-1)
    theta_r = torch.tensor(THETA_R, dtype=torch.float64)
    means = [float(law(alpha, beta).draw(u, theta_r)[0].mean()) / DEG for law in (MirrorSlip, CorrectedLobe)]
    effect = f"mean θ_i of M_R {number(means[0])}° instead of {number(means[1])}°"
    return Trial(printed.p_value, corrected.p_value, None, effect, {"mean_deg": means[0], "corrected_deg": means[1]})


@CONTROLS.add(
    "angular_density",
    "(20)",
    printed="p = g(θ)",
    corrected="p = g(θ) p_φ / (2 Z cosθ_i) per steradian",
    kind="not a density",
    check=MASS,
)
def angular_density(seed: int) -> Trial:
    alpha, beta = _lobe("R")
    printed, corrected = (sampler_test(law(alpha, beta), THETA_R, seed) for law in (AngularSlip, CorrectedLobe))
    normal = sampler_test(AngularSlip(alpha, beta), 0.0, seed).mass
    effect = f"mass {printed.mass:.2f}, and {normal:.2f} at θ_r = 0"
    return Trial(mass_gap(printed), mass_gap(corrected), MASS_BOUND, effect, {"mass": printed.mass, "normal": normal})


@CONTROLS.add(
    "lobe_together",
    "(16)–(20)",
    printed="all of them at once, as in figure 2",
    corrected="M_R as above",
    kind="bias",
    check=MASS,
)
def lobe_together(seed: int) -> Trial:
    """theta_i - 2 alpha is Gaussian, cut off at theta_max, with density g / (2 pi cos theta_i) per steradian; g is
    claimed."""
    alpha, beta = _lobe("R")
    laws = (LobeAsPrinted(alpha, beta), CorrectedLobe(alpha, beta))
    printed, corrected = (sampler_test(law, THETA_R, seed) for law in laws)
    scene = terms()
    drawn = (scene.theta_i - 2 * alpha).abs() <= HALF_PI - abs(THETA_R / 2 - alpha)
    value = scene.weight * scene.total / (2 * math.pi * cos_inclination(scene.theta_i))
    found = float(value[drawn].sum()) / scene.integral()
    effect = f"estimates of the scene tend to ×{found:.3f}"
    return Trial(mass_gap(printed), mass_gap(corrected), MASS_BOUND, effect, {"ratio": found, "mass": printed.mass})
