"""Fresnel reflectance of a dielectric, seen from outside."""

from __future__ import annotations

import torch
from torch import Tensor


def fresnel(eta: Tensor, cos_angle: Tensor) -> tuple[Tensor, Tensor]:
    """Unpolarised reflectance and transmittance (F, 1 - F) of a dielectric of relative index eta > 1.

    With c = cos_angle in [0, 1], m = eta^2 - 1 and g = sqrt(m + c^2): r_s = -m/(c + g)^2, r_p = m ((eta^2 + 1) c^2 -
    1)/(eta^2 c + g)^2, F = (r_s^2 + r_p^2)/2, and the transmittance from 1 - r^2 = 4 x y/(x + y)^2. Whichever of the
    two is the smaller is computed and the other is its complement, so that both, and their derivatives, keep their
    digits at grazing (F near 1) and for an index near 1 (F near 0).

    For a fibre c = cos(theta_diff) cos(gamma_i): this equals the reflectance with Bravais' indices eta', eta'' in the
    normal plane, and, by Stokes' relations, the reflectance from inside at gamma_t. Light that entered is never
    totally reflected.
    """
    eta2 = eta * eta
    m, c2 = (eta - 1) * (eta + 1), cos_angle * cos_angle
    g = torch.sqrt(m + c2)
    p = eta2 * cos_angle
    s_sum, p_sum = (cos_angle + g) ** 2, (p + g) ** 2
    transmittance = 2 * g * (cos_angle / s_sum + p / p_sum)
    reflectance = 0.5 * m * m * (1 / (s_sum * s_sum) + (((eta2 + 1) * c2 - 1) / p_sum) ** 2)
    opaque = transmittance < 0.5
    return torch.where(opaque, 1 - transmittance, reflectance), torch.where(opaque, transmittance, 1 - reflectance)
