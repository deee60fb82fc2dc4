"""The laws that the figure of proposals shows: the chapter's as printed beside the library's, and the library's own."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from dsfit.bsdf.dual_scattering import DualScattering
from dsfit.checks.controls.samplers import (
    AngularSlip,
    ClampSlip,
    CorrectedLobe,
    MassSlip,
    MirrorSlip,
    TransmittanceMassSlip,
    UnwrappedSlip,
)
from dsfit.context import Context
from dsfit.fit.transmittance import fit_transmittance
from dsfit.proposals.azimuth import CosineHalf, Scattered, TruncatedGaussian, WrappedGaussian
from dsfit.proposals.base import Azimuthal, Product, Proposal
from dsfit.proposals.chapter import chapter_proposals
from dsfit.proposals.gaussian_lobe import GaussianLobe
from dsfit.proposals.lobe import LOBES
from dsfit.proposals.printed import (
    AzimuthClamped,
    CosineAsPrinted,
    FrontAsPrinted,
    LobeAsPrinted,
    LobeWithoutJacobian,
    TransmittanceAsPrinted,
    TransmittanceInclinationAsPrinted,
    cosine_cdf,
    transmittance_cdf,
)
from dsfit.proposals.transmittance import TransmittanceCosine, TransmittanceGaussian
from dsfit.proposals.uniform import FrontHemisphere, UniformAzimuth, UniformInclination, UniformSphere

DEG = math.pi / 180
WIDE = 2.0
"""An azimuthal width, radians, at which what lies beyond one turn matters."""
DEEP = 50.0
"""Number of fibres behind which the transmittance is narrow."""

Function = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class Law:
    """One law in both forms.

    Attributes:
        name: unique.
        page: figure that it belongs to.
        equations: printed numbers.
        title: symbol of the law and where it is shown.
        slip: what is wrong with the printed form, a few words.
        axis: "theta" (theta_i), "phi" (about back scattering) or "forward" (phi in [0, 2 pi], about forward
            scattering).
        context: where.
        printed, corrected: both forms as proposals.
        printed_cdf: of the coordinate, radians, where the chapter prints one.
        target: what the law is meant for, up to a factor, of the coordinate.
    """

    name: str
    page: str
    equations: str
    title: str
    slip: str
    axis: str
    context: Context
    printed: Proposal
    corrected: Proposal
    printed_cdf: Function | None = None
    target: Function | None = None


def at(theta_r_deg: float, n: float = 0.0) -> Context:
    """A context in degrees, half directly lit."""
    return Context(theta_r_deg * DEG, 0.0, n, 0.5, dtype=torch.float64)


def laws(bsdf: DualScattering, theta_r_deg: float, grazing_deg: float, n: float) -> list[Law]:
    """All laws of the chapter, in the order of the equations.

    Args:
        bsdf: whose fibre has the shifts and widths.
        theta_r_deg: viewing inclination.
        grazing_deg: another one, where clamping is felt.
        n: number of scattering fibres.
    """
    return [
        *_longitudinal(bsdf, theta_r_deg),
        *_clamped(bsdf, grazing_deg),
        *_transmitted(bsdf),
        *_cosine(bsdf),
        *_transmittance(bsdf, theta_r_deg),
        *_scattered(bsdf, theta_r_deg, n),
    ]


def _lobe(bsdf: DualScattering, k: int) -> tuple[float, float]:
    return float(bsdf.fiber.alpha[k]), float(bsdf.fiber.beta[k])


def _right(bsdf: DualScattering, k: int) -> Product:
    return Product(GaussianLobe(*_lobe(bsdf, k)), UniformAzimuth())


def _longitudinal(bsdf: DualScattering, theta_r: float) -> list[Law]:
    page, where = "longitudinal", at(theta_r)
    found = [
        Law(
            f"printed_{name}",
            page,
            "(16)–(20)",
            f"M_{name}, θ_r = {theta_r:g}°",
            "all at once, as in figure 2",
            "theta",
            where,
            LobeAsPrinted(*_lobe(bsdf, k)),
            _right(bsdf, k),
        )
        for k, name in enumerate(LOBES)
    ]
    slips = (
        ("mirror", "(19)", MirrorSlip, "alone: θ where θ_r belongs"),
        ("angular", "(20)", AngularSlip, "alone: g(θ) claimed per steradian"),
    )
    for name, equation, law, slip in slips:
        forms = law(*_lobe(bsdf, 0)), _right(bsdf, 0)
        found.append(Law(name, page, equation, f"M_R, θ_r = {theta_r:g}°", slip, "theta", where, *forms))
    return found


def _clamped(bsdf: DualScattering, theta_r: float) -> list[Law]:
    page = "clamp"
    slip = "beyond the pole, no Jacobian, not truncated"
    first = LobeWithoutJacobian(*_lobe(bsdf, 0)), _right(bsdf, 0)
    found = [Law("beyond", page, "(16)–(18), (20)", f"M_R, θ_r = {theta_r:g}°", slip, "theta", at(theta_r), *first)]
    for k, name in enumerate(LOBES):
        side = theta_r if k != 2 else -theta_r  # the tilt of TRT brings the other end near
        forms = ClampSlip(*_lobe(bsdf, k)), _right(bsdf, k)
        title = f"M_{name}, θ_r = {side:g}°".replace("-", "−")
        slip = "alone: clamped, not redrawn"
        found.append(Law(f"clamp_{name}", page, "(18)", title, slip, "theta", at(side), *forms))
    return found


def _azimuthal(law: Azimuthal) -> Product:
    """An azimuth with a uniform inclination, as the printed controls have it."""
    return Product(UniformInclination(), law)


def _transmitted(bsdf: DualScattering) -> list[Law]:
    page, where, axis = "transmitted", at(0.0), "forward"
    beta, gamma = float(bsdf.fiber.beta[1]), float(bsdf.fiber.gamma_tt)
    wrapped, truncated = WrappedGaussian(gamma), TruncatedGaussian(WIDE)
    rows: list[tuple[str, str, str, str, Proposal, Azimuthal]] = [
        ("width", "(21), (22), (24)", f"N_TT, γ = {gamma / DEG:.0f}°", "width β_TT of θ_h for γ_TT",
         AzimuthClamped(gamma=beta), wrapped),
        ("unwrapped", "(21)", f"N_TT, γ = {gamma / DEG:.0f}°", "π − φ not wrapped: φ < 0 lost",
         UnwrappedSlip(gamma=gamma), wrapped),
        ("azimuth_clamp", "(22)", f"N_TT, γ = {WIDE:g} rad", "clamped to ±π, not redrawn",
         AzimuthClamped(gamma=WIDE), truncated),
        ("azimuth_mass", "(24)", f"N_TT, γ = {WIDE:g} rad", "normalised on the line, not on the circle",
         MassSlip(gamma=WIDE), truncated),
    ]  # fmt: skip
    return [
        Law(name, page, equations, title, slip, axis, where, printed, _azimuthal(law))
        for name, equations, title, slip, printed, law in rows
    ]


def _cosine(bsdf: DualScattering) -> list[Law]:
    page, where = "cosine", at(0.0)
    gamma = WrappedGaussian(float(bsdf.fiber.gamma_tt))
    whole = "front half only, 1/π per steradian"
    return [
        Law("cosine", page, "(30), (31)", "N_R, N_TRT", "P ends at 4, its inverse at −60°", "phi", where,
            CosineAsPrinted(), _azimuthal(CosineHalf()), printed_cdf=cosine_cdf),
        Law("scattered_cosine", page, "(37), (38)", "N^G of R and TRT", whole, "phi", where,
            FrontAsPrinted(), _azimuthal(Scattered(CosineHalf()))),
        Law("scattered_gaussian", page, "(37), (38)", "N^G of TT", whole, "forward", where,
            FrontAsPrinted(), _azimuthal(Scattered(gamma))),
        Law("front", page, "(38)", "front half", "1/π per steradian, which is 1/(2π)", "forward", where,
            FrontAsPrinted(), FrontHemisphere()),
    ]  # fmt: skip


def _transmittance(bsdf: DualScattering, theta_r: float) -> list[Law]:
    page, where, title = "transmittance", at(theta_r), f"a_f, θ_r = {theta_r:g}°"
    cosine = Product(TransmittanceCosine(), UniformAzimuth())
    fit = fit_transmittance(bsdf, (DEEP,))[0]
    gaussian = Product(TransmittanceGaussian(fit.width, fit.centre, variable="in"), UniformAzimuth())

    def target(theta: Tensor) -> Tensor:
        with torch.no_grad():
            a_f = bsdf.averages(theta).a_f.mean(-1)
        return (a_f / a_f.max()) ** DEEP

    return [
        Law("difference_mass", page, "(33)", title, "alone: much of θ_d cannot be reached", "theta", where,
            TransmittanceMassSlip(), cosine),
        Law("difference", page, "(33)–(35)", title, "the same, and asin(ξ − 1) stays below 0", "theta", where,
            TransmittanceAsPrinted(), cosine),
        Law("inclination", page, "(33)–(35), θ_d as θ_i", "a_f", "P ends at 2, its inverse at 0", "theta", at(0.0),
            TransmittanceInclinationAsPrinted(), UniformSphere(), printed_cdf=transmittance_cdf),
        Law("fitted", page, "(33)", f"a_f^n, n = {DEEP:g}", "cosθ for every n, against a fitted Gaussian", "theta",
            at(0.0, DEEP), UniformSphere(), gaussian, target=target),
    ]  # fmt: skip


def _scattered(bsdf: DualScattering, theta_r: float, n: float) -> list[Law]:
    page, where = "scattered", at(theta_r, n)
    own = chapter_proposals(bsdf)
    average = bsdf.averages(-where.theta_r)
    spread = n * float(average.beta_f.mean()) ** 2
    found = []
    for k, name in enumerate(LOBES):
        alpha, beta = _lobe(bsdf, k)
        found.append(
            Law(f"scattered_{name}", page, "(10)", f"M^G_{name}, n = {n:g}", "a variance where a width belongs",
                "theta", where, CorrectedLobe(alpha, beta**2 + spread), own[f"MG_{name}"])
        )  # fmt: skip
    delta, width = float(average.delta_b.mean()), float(average.sigma_b.mean())
    # (7): the argument is theta_d + theta_r - Delta_b, a Gaussian of theta_d about Delta_b - theta_r
    moved = TransmittanceGaussian(width**2 + spread, delta - float(where.theta_r), variable="diff")
    found.append(
        Law("back", page, "(7)", f"f_back, n = {n:g}", "θ_d + θ_r for θ_h, a variance for a width", "theta", where,
            Product(moved, UniformAzimuth()), own["back"])
    )  # fmt: skip
    return found
