"""A sun: a uniform disc of light at infinity."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from dsfit.errors import InputError, as_number
from dsfit.scene.lights.cones import Cone, ConeLight
from dsfit.scene.lights.lobes import unit_vectors
from dsfit.scene.lights.nearby import check_radiance

SUN_RADIUS = math.radians(0.2665)
"""Half the mean angular diameter of the sun (31'59"), radians."""
MIN_RADIUS = 1e-6


class SunLight(ConeLight):
    """Radiance L from all directions within `angular_radius` of `direction`, none from elsewhere.

    A surface that faces the sun receives the irradiance `E = pi L sin^2(angular_radius)`.

    Args:
        direction: towards the sun, `[3]` as a vector of any length or `[2]` as (theta, phi), in the light's frame.
        angular_radius: in [1e-6, pi/2] radians.
        irradiance: E of a surface that faces the sun, a number or `[C]`, finite and >= 0.
        radiance: L; one of the two is given.
        rotation: see `Light`.

    Raises:
        InputError: an argument is out of range, or not exactly one of irradiance and radiance is given.
    """

    direction: Tensor
    radiance: Tensor

    def __init__(
        self,
        direction: Any,
        angular_radius: Any = SUN_RADIUS,
        irradiance: Any = None,
        *,
        radiance: Any = None,
        rotation: Any = None,
    ) -> None:
        super().__init__(rotation)
        mu = unit_vectors("direction", direction)
        if mu.shape[0] != 1:
            raise InputError("direction", tuple(mu.shape), "one direction, [2] (theta, phi) or [3] (a vector)")
        self.angular_radius = as_number("angular_radius", angular_radius, MIN_RADIUS, math.pi / 2)
        if (irradiance is None) == (radiance is None):
            given = {"irradiance": irradiance, "radiance": radiance}
            raise InputError("irradiance", given, "either irradiance or radiance")
        if radiance is None:
            value = check_radiance(irradiance, "irradiance") / (math.pi * math.sin(self.angular_radius) ** 2)
            check_radiance(value.detach(), "irradiance")
        else:
            value = check_radiance(radiance)
        self.register_buffer("direction", mu[0])
        self.register_buffer("radiance", value)

    @property
    def label(self) -> str:
        return f"sun {math.degrees(2 * self.angular_radius):.3g} deg"

    def cone(self) -> Cone:
        axis = self.to_fibre(self.direction)
        rise = 2 * math.sin(self.angular_radius / 2) ** 2
        return Cone(axis, torch.full_like(axis[..., 0], rise, dtype=torch.float64))
