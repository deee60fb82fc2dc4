"""What a scene lets one leave out without any error, and whether anything more can be proven of it."""

from __future__ import annotations

import torch

from dsfit.bsdf.conventions import Convention
from dsfit.bsdf.dual_scattering import DualScattering
from dsfit.context import Context
from dsfit.frame import HALF_PI
from dsfit.scene.integrand import Integrand
from dsfit.scene.lights import ConstantLight
from dsfit.scene.planning.boxes import Boxes, ContextRange
from dsfit.scene.planning.surroundings import arrival, radiance
from dsfit.scene.planning.terms import NAMES
from dsfit.special import is_differentiated


def exact_reasons(integrand: Integrand, boxes: Boxes, contexts: Context | ContextRange) -> dict[tuple[str, str], str]:
    """Terms that are multiplied by a zero that nobody asks a derivative of, and why."""
    bsdf, found = integrand.bsdf, {}
    for half, name in NAMES:
        if name not in getattr(bsdf.terms, half):
            found[half, name] = "left out of the BSDF already"
    if isinstance(integrand.light, ConstantLight) and not bool((integrand.light.radiance != 0).any()):
        return {key: "the light is black" for key in NAMES}
    if bsdf.convention.share == "complement" and not _shares_differentiated(integrand, contexts):
        v = arrival(integrand.scattering)(boxes)[1]
        if bool((v.high == 0).all()):
            _half(found, "direct", "v = 0 everywhere")
        if bool((v.low == 1).all()):
            _half(found, "scattered", "v = 1 everywhere (n = 0)")
    if bool(bsdf.d_f == 0) and not is_differentiated(bsdf.d_f):
        _half(found, "scattered", "d_f = 0")
    if bool(bsdf.d_b == 0) and not is_differentiated(bsdf.d_b):
        for half in ("direct", "scattered"):
            found.setdefault((half, "back"), "d_b = 0")
    return found


def why_no_bound(integrand: Integrand) -> str | None:
    """Why nothing but exact zeros can be left out of this integrand, or None."""
    bsdf = integrand.bsdf
    if bsdf.fiber.batch_shape:
        return "a batch of fibres"
    if bsdf.fiber.requires_grad or is_differentiated(bsdf.d_b) or is_differentiated(bsdf.d_f):
        return "derivatives in the fibre, d_f or d_b are asked for: a bound on a value says nothing of its derivative"
    if any(is_differentiated(x) for x in (*integrand.light.buffers(), *integrand.light.parameters())):
        return "derivatives in the light are asked for"
    switch = _unproven(bsdf.convention)
    if switch:
        return f"no bound is proven for the convention's {switch}"
    if radiance(integrand.light) is None:
        return f"nothing is known of a {type(integrand.light).__name__}"
    return None


def fade_is_over(bsdf: DualScattering) -> bool:
    """Whether eta' >= 2 + Delta eta' in every direction, so that the treatment of TRT's caustic changes nothing.

    eta' = sqrt(eta^2 - sin^2 d) / cos d is least at theta_diff = 0, where it is eta.
    """
    fiber = bsdf.fiber
    if fiber.requires_grad:
        return False
    axes = torch.tensor([0.0, HALF_PI], dtype=fiber.dtype)
    ends = [fiber.eta] if fiber.is_round else [fiber.eta_trt(angle) for angle in axes]
    return all(bool((eta >= 2 + fiber.caustic_fade).all()) for eta in ends)


def _shares_differentiated(integrand: Integrand, contexts: Context | ContextRange) -> bool:
    """Whether v carries a derivative: of a context, or of what the scattering is made of."""
    scattering = integrand.scattering
    own = any(is_differentiated(x) for x in (*scattering.buffers(), *scattering.parameters()))
    return own or (isinstance(contexts, Context) and any(is_differentiated(x) for x in (contexts.v, contexts.n)))


def _half(found: dict[tuple[str, str], str], half: str, reason: str) -> None:
    for key in NAMES:
        if key[0] == half:
            found.setdefault(key, reason)


def _unproven(convention: Convention) -> str | None:
    """The first switch under which terms may be negative or averages are taken elsewhere."""
    needed = {
        "inverse_cos2": True, "share": "complement", "scattered_azimuth": "convolution", "back_argument": "theta_h",
        "back_width": "scatter", "average_angle": "theta_in", "limit_energy": True, "simplified_energy": "attenuation",
    }  # fmt: skip
    return next((name for name, value in needed.items() if getattr(convention, name) != value), None)


__all__ = ["exact_reasons", "fade_is_over", "why_no_bound"]
