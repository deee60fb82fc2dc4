"""Angles of the fibre frame: u = tangent, v = normal, w = binormal; theta from the normal plane, phi around the
tangent.

A direction is `omega = [..., 2] = (theta, phi)` in radians or a unit vector `[..., 3]` in (tangent, normal, binormal):
`(sin theta, cos theta cos phi, cos theta sin phi)`. Both omega_i (to the light) and omega_r (to the viewer) point away
from the fibre. Relative azimuth: `phi = wrap(phi_r - phi_i)`; |phi| = 0 is back scattering, |phi| = pi is forward
scattering.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

HALF_PI = math.pi / 2
TWO_PI = 2 * math.pi


def wrap(angle: Tensor) -> Tensor:
    """Angle modulo 2 pi in [-pi, pi], with derivative 1 everywhere.

    `wrap(x) = x - 2 pi round(x / (2 pi))`; the multiple of 2 pi is a constant to autograd, so there is no spurious
    jump term.
    """
    return angle - TWO_PI * torch.round(angle.detach() / TWO_PI)


def cos_inclination(theta: Tensor) -> Tensor:
    """cos(theta) for an inclination in [-pi/2, pi/2], never zero or negative.

    Rounded to float32, pi/2 is too large and its cosine is negative; densities per steradian divide by this number and
    integrands multiply by it, so both must use the same positive value for the weight to stay finite.
    """
    return torch.cos(theta).clamp_min(torch.finfo(theta.dtype).eps ** 2)


def theta_half(theta_i: Tensor, theta_r: Tensor) -> Tensor:
    """theta_h = (theta_i + theta_r) / 2."""
    return (theta_i + theta_r) / 2


def theta_diff(theta_i: Tensor, theta_r: Tensor) -> Tensor:
    """theta_diff = (theta_r - theta_i) / 2."""
    return (theta_r - theta_i) / 2


def reachable(theta_r: Tensor) -> tuple[Tensor, Tensor]:
    """Interval [L, H] = theta_r / 2 -+ pi / 4 that theta_h (and theta_diff) can take when |theta_i| <= pi / 2."""
    return theta_r / 2 - math.pi / 4, theta_r / 2 + math.pi / 4


def to_vector(omega: Tensor) -> Tensor:
    """(theta, phi) `[..., 2]` to the unit vector `[..., 3]` in (tangent, normal, binormal).

    Example:
        >>> import torch
        >>> from dsfit.frame import to_angles, to_vector
        >>> omega = torch.tensor([0.5, -2.0], dtype=torch.float64)
        >>> [round(x, 6) for x in to_angles(to_vector(omega)).tolist()]
        [0.5, -2.0]
    """
    theta, phi = omega.unbind(-1)
    cos_theta = cos_inclination(theta)
    return torch.stack([torch.sin(theta), cos_theta * torch.cos(phi), cos_theta * torch.sin(phi)], dim=-1)


def to_angles(vector: Tensor) -> Tensor:
    """Unit vector `[..., 3]` to (theta, phi) `[..., 2]`; theta by atan2, which stays accurate near the poles.

    On the fibre axis itself phi is taken as 0 and its gradient is 0.
    """
    x, y, z = vector.unbind(-1)
    radius2 = y * y + z * z
    on_axis = radius2 == 0
    radius = torch.where(on_axis, 0.0, torch.sqrt(torch.where(on_axis, 1.0, radius2)))
    phi = torch.atan2(torch.where(on_axis, 0.0, z), torch.where(on_axis, 1.0, y))
    return torch.stack([torch.atan2(x, radius), phi], dim=-1)
