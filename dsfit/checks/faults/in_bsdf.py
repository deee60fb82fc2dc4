"""Faults in the BSDF and what it is made of."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from dsfit.checks.faults import looks
from dsfit.checks.faults.planting import Fault, Patch, changed, scaled

BSDF = "dsfit.bsdf"


def _inside_index(fresnel: Any) -> Any:
    """The parallel part forgotten."""

    def wrong(eta: Tensor, cos_angle: Tensor) -> tuple[Tensor, Tensor]:
        g = torch.sqrt((eta - 1) * (eta + 1) + cos_angle * cos_angle)
        reflected = ((g - cos_angle) / (g + cos_angle)) ** 2
        return reflected, 1 - reflected

    return wrong


def _printed_absorption(attenuation: Any) -> Any:
    def wrong(p: int, bent: Any, sigma_a: Tensor, sin_gamma: Tensor, cos_gamma: Tensor, absorption: str) -> Tensor:
        return attenuation(p, bent, sigma_a, sin_gamma, cos_gamma, "printed2003")

    return wrong


def _third_order(albedo: Any) -> Any:
    """Exponent 2 for 3, as in several published shaders."""

    def wrong(a_f: Tensor, a_b: Tensor) -> Tensor:
        x = a_f * a_f
        q = a_b / (1 - x)
        return x * q + a_b * x * q**2

    return wrong


def _standard_deviation(lobes: Any) -> Any:
    """M^G with beta + n beta_f for the square root of the sum of squares."""

    def wrong(fiber: Any, theta_h: Tensor, variance_f: Tensor) -> Tensor:
        from dsfit.special import log_gauss

        std = fiber.beta.unsqueeze(-1) + torch.sqrt(variance_f).unsqueeze(-2)
        return torch.exp(log_gauss(theta_h[..., None, None] - fiber.alpha.unsqueeze(-1), std))

    return wrong


def _window_one_sided(windows: Any) -> Any:
    """The window of N^G centred on 0 wherever it belongs, as printed."""

    def wrong(fiber: Any, bent: Any, phi: Tensor, model: str, absorption: str) -> Tensor:
        return windows(fiber, bent, torch.zeros_like(phi), model, absorption)

    return wrong


def _glint_twice(glint: Any) -> Any:
    def wrong(*args: Any) -> Any:
        found = glint(*args)
        return replace(found, strength=2 * found.strength)

    return wrong


BSDF_FAULTS = (
    Fault(
        "fresnel-unpolarised", f"{BSDF}.fresnel", "only the perpendicular polarisation is reflected",
        (Patch(f"{BSDF}.fresnel:fresnel", _inside_index),), "furnace", looks.energy(),
    ),
    Fault(
        "fresnel-digits", f"{BSDF}.fresnel", "a relative error of 1e-8 in the reflectance",
        (Patch(f"{BSDF}.fresnel:fresnel", changed(lambda r, *_: (r[0] * (1 + 1e-8), r[1]))),),
        "stability", looks.digits("bsdf.fresnel"),
    ),
    Fault(
        "snell-spread", f"{BSDF}.snell", "the slope of the azimuth at which TRT leaves, halved",
        (Patch(f"{BSDF}.snell:exit_trt_slope", scaled(0.5)),), "stability", looks.digits("bsdf.N_TRT"),
    ),
    Fault(
        "absorption-2003", f"{BSDF}.attenuation", "the printed absorption of 2003, twice as deep at the axis",
        (Patch(f"{BSDF}.attenuation:attenuation", _printed_absorption),), "stability",
        looks.digits("bsdf.N_TT", "bsdf.N_TRT"),
    ),
    Fault(
        "glint-per-root", f"{BSDF}.glint", "the glint added twice, once per root",
        (Patch(f"{BSDF}.glint:Glint.of", _glint_twice),), "stability", looks.digits("bsdf.N_TRT"),
    ),
    Fault(
        "azimuth-half", f"{BSDF}.azimuthal", "N_R without the factor 1/2",
        (Patch(f"{BSDF}.azimuthal:_n_r", scaled(2.0)),), "furnace", looks.energy(),
    ),
    Fault(
        "window-at-zero", f"{BSDF}.scattered", "N^G as printed: the window centred on 0, a constant",
        (Patch(f"{BSDF}.scattered:offset_windows", _window_one_sided),), "furnace", looks.energy(),
    ),
    Fault(
        "averages-half", f"{BSDF}.averages", "a_f and a_b with c_M = 1",
        (Patch(f"{BSDF}.averages:LobeShares._scaled_shares_at", scaled(2.0)),), "furnace", looks.energy(),
    ),
    Fault(
        "back-exponent", f"{BSDF}.backscatter", "exponent 2 for 3 in the denominator of A_3",
        (Patch(f"{BSDF}.backscatter:backscatter_albedo", _third_order),), "stability", looks.digits("bsdf.A_b"),
    ),
    Fault(
        "width-added", f"{BSDF}.longitudinal", "widths of M^G added instead of variances",
        (Patch(f"{BSDF}.longitudinal:scattered_lobes", _standard_deviation),), "stability", looks.digits("bsdf.M^G"),
    ),
    Fault(
        "projection", f"{BSDF}.dual_scattering", "1 / cos^2(theta_diff) forgotten in every lobe",
        (Patch(f"{BSDF}.dual_scattering:DualScattering._projection",
               changed(lambda r, self, diff: r * torch.cos(diff).unsqueeze(-1) ** 2)),),
        "furnace", looks.known_furnace(),
    ),
    Fault(
        "tilt-sign", f"{BSDF}.dual_scattering", "theta_diff 0.1 rad off in the azimuth of single scattering",
        (Patch(f"{BSDF}.dual_scattering:DualScattering.azimuthal",
               lambda original: lambda self, diff, phi, **k: original(self, diff + 0.1, phi, **k)),),
        "furnace", looks.symmetry(),
    ),
    Fault(
        "transmittance", f"{BSDF}.dual_scattering", "a_f^(n + 1) for a_f^n",
        (Patch(f"{BSDF}.dual_scattering:DualScattering._transmittance",
               lambda original: lambda self, average, n: original(self, average, n + 1)),),
        "furnace", looks.limiting(),
    ),
)  # fmt: skip

