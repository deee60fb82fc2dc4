"""Fresnel reflectance of a dielectric, seen from outside."""

from __future__ import annotations

import torch
from torch import Tensor


def fresnel(eta: Tensor, cos_angle: Tensor) -> tuple[Tensor, Tensor]:
    """Unpolarised reflectance and transmittance (F, 1 - F) of a dielectric of relative index eta > 1.

    With c = cos_angle in [0, 1] and g = sqrt(eta^2 - 1 + c^2): r_s = (c - g)/(c + g), r_p = (eta^2 c - g)/(eta^2 c +
    g), F = (r_s^2 + r_p^2)/2; the transmittance comes from 1 - r^2 = 4 x y/(x + y)^2, free of cancellation.

    For a fibre c = cos(theta_diff) cos(gamma_i): this equals the reflectance with Bravais' indices eta', eta'' in the
    normal plane, and, by Stokes' relations, the reflectance from inside at gamma_t. Light that entered is never
    totally reflected.
    """
    g = torch.sqrt(eta * eta - 1 + cos_angle * cos_angle)
    p = eta * eta * cos_angle
    r_s, r_p = (cos_angle - g) / (cos_angle + g), (p - g) / (p + g)
    transmittance = 2 * g * (cos_angle / (cos_angle + g) ** 2 + p / (p + g) ** 2)
    return (r_s * r_s + r_p * r_p) / 2, transmittance
