"""A glowing ball at a finite distance."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from dsfit.scene.lights.cones import Cone, ConeLight
from dsfit.scene.lights.nearby import NearbyLight, check_length, check_radiance, check_vector


class SphereLight(ConeLight, NearbyLight):
    """Radiance L from every point of a sphere.

    From a distance d >= R of its centre the sphere is a cone of directions with `sin a = R / d`; a surface there that
    faces it receives the irradiance `pi L (R / d)^2`. Points on the sphere see the half of all directions that the
    centre is in; points inside see the radiance L from everywhere.

    Args:
        center: `[3]`, in world coordinates.
        radius: R in [1e-12, 1e12].
        radiance: L, a number or `[C]`, finite and >= 0.
        rotation, position: see `NearbyLight`.

    Raises:
        InputError: an argument is out of range.
    """

    center: Tensor
    radius: Tensor
    radiance: Tensor

    def __init__(
        self, center: Any, radius: Any, radiance: Any = 1.0, *, rotation: Any = None, position: Any = None
    ) -> None:
        NearbyLight.__init__(self, rotation, position)
        self.register_buffer("center", check_vector("center", center))
        self.register_buffer("radius", check_length("radius", radius))
        self.register_buffer("radiance", check_radiance(radiance))

    @property
    def label(self) -> str:
        return "sphere light"

    def cone(self) -> Cone:
        towards = self.seen(self.center)
        radius = self.radius.to(towards)
        square = towards.square().sum(-1)
        away = square > 0
        distance = torch.sqrt(torch.where(away, square, 1.0))
        inside = (distance < radius) | ~away
        # masked before the root, whose derivative has no bound where the sphere fills half of all directions
        apart = distance - radius
        beyond = apart > 0
        gap = torch.where(beyond, apart, 1.0) * (distance + radius) / torch.where(away, square, 1.0)
        cosine = torch.where(beyond, torch.sqrt(gap), 0.0)
        rise = (radius / distance) ** 2 / (1 + cosine)
        tangent = towards.new_tensor([1.0, 0.0, 0.0])
        axis = torch.where(away[..., None], towards, tangent) / distance[..., None]
        return Cone(axis, torch.where(inside, 2.0, rise))
