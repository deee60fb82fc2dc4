"""Controls of sampling the azimuth, eqs (21)-(31), (37), (38)."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from scipy import stats
from torch import Tensor

from dsfit.bsdf.conventions import Convention
from dsfit.bsdf.dual_scattering import DualScattering
from dsfit.checks.controls.base import Registry, Trial, generator_of
from dsfit.checks.controls.energy import ENERGY_BOUND, energy_gap, smooth_bsdf, smooth_fiber
from dsfit.checks.controls.longitudinal import CHI_SQUARE, MASS, MASS_BOUND
from dsfit.checks.controls.samplers import AzimuthSlip, MassSlip, UnwrappedSlip, mass_gap, sampler_test
from dsfit.checks.controls.scene import DEG, blond, bsdf, context, integrand, terms
from dsfit.frame import HALF_PI
from dsfit.mis import estimate
from dsfit.proposals.azimuth import CosineHalf
from dsfit.proposals.base import Product, Proposal
from dsfit.proposals.printed import AzimuthClamped, CosineAsPrinted, FrontAsPrinted
from dsfit.proposals.printed import cosine_cdf as printed_cdf
from dsfit.proposals.uniform import FrontHemisphere, UniformInclination, UniformSphere
from dsfit.quadrature import panel_points
from dsfit.quality import reference
from dsfit.special import wrapped_normal_log_prob

CONTROLS = Registry()
WIDE = 2.0
"""An azimuthal width, radians, at which what lies beyond one turn matters."""

Function = Callable[[Tensor], Tensor]


def _transmitted() -> tuple[Tensor, Tensor, Tensor]:
    """|phi|, weights for the whole circle, and N_TT / int N_TT at theta_diff = 0; panels shrink towards both ends."""
    edge = 2 * torch.asin(1 / blond().eta)  # TT starts here
    steps = torch.logspace(-13, 0, 79, dtype=torch.float64) * (math.pi - edge)
    breaks = torch.sort(torch.cat([edge[None], edge + steps, math.pi - steps, torch.tensor([math.pi]).double()])).values
    phi, weight = panel_points(breaks, 16)
    lobe = bsdf().azimuthal(torch.zeros_like(phi), phi)[:, 1, 0]
    return phi, 2 * weight, lobe / float((2 * weight * lobe).sum())


def _excess(log_density: Function, beyond: float = 0.0) -> float:
    """int N^2 / p dphi - 1 of the normalised N_TT, without the last `beyond` radians before phi = pi."""
    phi, weight, lobe = _transmitted()
    used = (lobe > 0) & (math.pi - phi >= beyond)
    phi, weight, lobe = phi[used], weight[used], lobe[used]
    return float((weight * torch.exp(2 * torch.log(lobe) - log_density(phi))).sum()) - 1


def _gaussian(width: float) -> Function:
    return lambda phi: wrapped_normal_log_prob(math.pi - phi, torch.full_like(phi, width))


def _uniform(phi: Tensor) -> Tensor:
    return torch.full_like(phi, -math.log(2 * math.pi))


def _cosine(phi: Tensor) -> Tensor:
    return torch.log(torch.cos(phi / 2)) - math.log(4)


@CONTROLS.add(
    "azimuth_width",
    "(21), (22), (24)",
    printed="width β_TT, that of θ_h",
    corrected="γ_TT, the azimuthal width",
    kind="variance",
    check="no more excess over N_TT than uniform φ",
)
def azimuth_width(seed: int) -> Trial:
    fiber = blond()
    widths = float(fiber.beta[1]), float(fiber.gamma_tt)
    uniform = _excess(_uniform)
    printed, corrected = (_excess(_gaussian(width)) for width in widths)
    effect = (
        f"{widths[0] / DEG:.2f}° for {widths[1] / DEG:.0f}°: excess 10^{math.log10(printed):.0f} "
        f"instead of {corrected:.2f}; uniform φ has {uniform:.2f}"
    )
    data = {"log10_excess": math.log10(printed), "corrected_excess": corrected, "uniform_excess": uniform}
    return Trial(printed, corrected, uniform, effect, data)


@CONTROLS.add(
    "azimuth_unwrapped",
    "(21)",
    printed="g(π − φ) for φ in [−π, π]",
    corrected="g(wrap(π − φ))",
    kind="not a density",
    check=MASS,
)
def azimuth_unwrapped(seed: int) -> Trial:
    gamma = float(blond().gamma_tt)
    printed, corrected = (sampler_test(law(gamma=gamma), 0.4, seed) for law in (UnwrappedSlip, AzimuthSlip))
    effect = f"mass {printed.mass:.3f}: the side φ < 0 is lost"
    return Trial(mass_gap(printed), mass_gap(corrected), MASS_BOUND, effect, {"mass": printed.mass})


def _beyond(width: float) -> float:
    """Share of a Gaussian on the line that lies beyond one turn."""
    return math.erfc(math.pi / (width * math.sqrt(2)))


@CONTROLS.add(
    "azimuth_clamp",
    "(22)",
    printed="φ clamped to ±π",
    corrected="wrapped, or truncated and normalised",
    kind="not a density",
    check=CHI_SQUARE,
)
def azimuth_clamp(seed: int) -> Trial:
    printed, corrected = (
        sampler_test(law(gamma=WIDE), 0.4, seed, k) for k, law in enumerate((AzimuthClamped, AzimuthSlip))
    )
    share, usual = _beyond(WIDE), _beyond(float(blond().gamma_tt))
    effect = f"{share:.1%} of the directions in the point φ = 0 at a width of 2 rad; {usual:.0e} at γ_TT = 30°"
    return Trial(printed.p_value, corrected.p_value, None, effect, {"point_mass": share, "usual": usual})


@CONTROLS.add(
    "azimuth_mass",
    "(24)",
    printed="g(φ), normalised on the line",
    corrected="g(φ) / erf(π / (γ √2)) on [−π, π]",
    kind="not a density",
    check=MASS,
)
def azimuth_mass(seed: int) -> Trial:
    printed, corrected = (sampler_test(law(gamma=WIDE), 0.4, seed) for law in (MassSlip, AzimuthSlip))
    effect = f"mass {printed.mass:.3f} at a width of 2 rad; 1 − {_beyond(float(blond().gamma_tt)):.0e} at γ_TT = 30°"
    return Trial(mass_gap(printed), mass_gap(corrected), MASS_BOUND, effect, {"mass": printed.mass})


@CONTROLS.add(
    "lobe_swap",
    "(25)",
    printed="N_R = N_TT = cos(φ/2)",
    corrected="N_R = N_TRT = cos(φ/2)",
    kind="variance",
    check="second moment converges at φ = π",
)
def lobe_swap(seed: int) -> Trial:
    """N_TT is largest where cos(phi/2) / 4 vanishes: int N_TT^2 / p diverges like a logarithm, though unbiased."""

    def growth(law: Function) -> float:
        """What the last decade of distance to phi = pi adds."""
        return _excess(law, 1e-12) - _excess(law, 1e-11)

    printed, corrected = growth(_cosine), growth(_gaussian(float(blond().gamma_tt)))
    uniform = _excess(_uniform)
    effect = f"infinite: each decade towards φ = π adds {printed:.1f} to the excess; uniform φ has {uniform:.2f} in all"
    return Trial(printed, corrected, 1e-6, effect, {"per_decade": printed, "uniform_excess": uniform})


@CONTROLS.add(
    "bare_azimuth",
    "(21), (25)",
    printed="N_R = cos(φ/2), N_TT = g",
    corrected="cos(φ/2)/4 and g times each lobe's energy",
    kind="bias",
    check="energy of a smooth fibre",
)
def bare_azimuth(seed: int) -> Trial:
    """Harmless in a proposal, whose density is normalised; eq (37) puts it into the BSDF."""
    bare = smooth_bsdf(convention=Convention(simplified_energy="printed"))
    zero = torch.zeros(1, dtype=torch.float64)
    right = DualScattering(smooth_fiber(), azimuthal="simplified").azimuthal(zero, zero)[0, :, 0]
    found = 1 / (4 * float(right[0]))
    printed = energy_gap(bare.single)
    effect = f"N_R ×{4 * found:.0f} as a term of the BSDF; none as a proposal"
    return Trial(printed, energy_gap(smooth_bsdf().single), ENERGY_BOUND, effect, {"factor": 4 * found})


@CONTROLS.add(
    "cosine_cdf",
    "before (31)",
    printed="P(φ) = 2 (sin(φ/2) + 1)",
    corrected="(1 + sin(φ/2)) / 2",
    kind="not a density",
    check="P is the integral of (30), P(π) = 1",
)
def cosine_cdf(seed: int) -> Trial:
    phi = torch.linspace(-math.pi, math.pi, 33, dtype=torch.float64)
    mass = torch.stack([_integral(lambda x: torch.cos(x / 2) / 4, -math.pi, float(end)) for end in phi])
    printed, corrected = printed_cdf(phi), (1 + torch.sin(phi / 2)) / 2
    gap = [float((p - mass).abs().max()) for p in (printed, corrected)]
    return Trial(gap[0], gap[1], 1e-12, f"P(π) = {float(printed[-1]):.0f}", {"end": float(printed[-1])})


def _integral(function: Function, low: float, high: float) -> Tensor:
    x, weight = panel_points(torch.linspace(low, high, 5, dtype=torch.float64), 16)
    return (weight * function(x)).sum()


@CONTROLS.add(
    "cosine_inverse",
    "(31)",
    printed="φ = 2 asin(ξ/2 − 1)",
    corrected="φ = 2 asin(2ξ − 1)",
    kind="bias",
    check=CHI_SQUARE,
)
def cosine_inverse(seed: int) -> Trial:
    """phi lies in [-pi, -pi/3] with density cos(phi/2), four times what (30) claims."""
    printed = sampler_test(CosineAsPrinted(), 0.4, seed)
    corrected = sampler_test(Product(UniformInclination(), CosineHalf()), 0.4, seed, 1)
    scene = terms()
    value = scene.weight * scene.total
    share = float(value[scene.phi > math.pi / 3].sum() / value.sum()) / 2
    effect = f"φ in [−180°, −60°] only, at 4 times its density; ×{4 * share:.2f} with uniform θ"
    return Trial(printed.p_value, corrected.p_value, None, effect, {"ratio": 4 * share})


@CONTROLS.add(
    "scattered_constant",
    "(37)",
    printed="N_R^G = (2/π) ∫ cos u du = 4/π",
    corrected="limits ±π/4: 2√2/π, and at φ = 0 only",
    kind="bias",
    check="quadrature of the printed integral",
)
def scattered_constant(seed: int) -> Trial:
    integral = float(_integral(lambda x: torch.cos(x / 2), -HALF_PI, HALF_PI)) / math.pi
    forward = float(_integral(lambda x: torch.cos(x / 2), HALF_PI, math.pi)) * 2 / math.pi
    printed, corrected = 4 / math.pi, 2 * math.sqrt(2) / math.pi
    effect = f"×{printed / integral:.3f} at φ = 0, ×{printed / forward:.2f} at φ = π"
    data = {"backward_ratio": printed / integral, "forward_ratio": printed / forward}
    return Trial(abs(printed - integral), abs(corrected - integral), 1e-12, effect, data)


@CONTROLS.add(
    "front_density",
    "(38)",
    printed="p = 1/π",
    corrected="p = 1/(2π) per steradian",
    kind="not a density",
    check=MASS,
)
def front_density(seed: int) -> Trial:
    printed, corrected = (sampler_test(law(), 0.4, seed) for law in (FrontAsPrinted, FrontHemisphere))
    effect = f"mass {printed.mass:.3f}"
    return Trial(mass_gap(printed), mass_gap(corrected), MASS_BOUND, effect, {"mass": printed.mass})


@CONTROLS.add(
    "front_only",
    "(38) and text",
    printed="draw N^G on the front half only; (37) integrates |φ′| < π/2, the back",
    corrected="the whole circle; front is |φ| > π/2",
    kind="bias",
    check="z-score of an estimate",
)
def front_only(seed: int) -> Trial:
    """Front half with its right density, against the uniform sphere, in the same estimator of scattered light."""
    point = context(v=0.0)
    truth = float(reference(integrand(), point, 1e-6).value)

    def p_value(proposal: Proposal, stream: int) -> float:
        found = estimate(integrand(), proposal, point, 50_000, generator=generator_of(seed, stream), test=False)
        return float(2 * stats.norm.sf(abs(float(found.value) - truth) / float(found.standard_error)))

    scene = terms()
    value = scene.weight * scene.scatter
    share = float(value[scene.phi > HALF_PI].sum() / value.sum())
    effect = f"scattered light ×{share:.3f}"
    return Trial(p_value(FrontHemisphere(), 0), p_value(UniformSphere(), 1), None, effect, {"scattered_ratio": share})
