"""From `[light]` to a light of the library."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from dsfit.errors import InputError

if TYPE_CHECKING:
    from dsfit.scene import Light

_DEG = math.pi / 180


def made(config: Any) -> Light:
    """The light of a `[light]` table; reads the map of an environment light.

    Raises:
        InputError: the library refuses it; the field is that of the table, `lights.K.` in front for a part of a total.
    """
    return _MAKERS[config.kind](config)


def _constant(config: Any) -> Light:
    from dsfit.scene import ConstantLight

    return ConstantLight(config.radiance)


def _environment(config: Any) -> Light:
    from dsfit.scene import EnvironmentLight

    return EnvironmentLight.from_file(config.path, scale=config.scale)


def _lobes(config: Any) -> Light:
    import torch

    from dsfit.scene import VonMisesFisherLights

    directions = [[lobe.theta_deg * _DEG, lobe.phi_deg * _DEG] for lobe in config.lobes]
    kappa = [float(VonMisesFisherLights.kappa_of_width(lobe.width_deg * _DEG)) for lobe in config.lobes]
    intensity = [lobe.intensity if isinstance(lobe.intensity, list) else [lobe.intensity] for lobe in config.lobes]
    channels = max(map(len, intensity))
    for index, value in enumerate(intensity):
        if len(value) not in (1, channels):
            raise InputError(f"light.lobes.{index}.intensity", value, f"a number or a list of {channels} numbers")
    full = [value * channels if len(value) == 1 else value for value in intensity]
    return VonMisesFisherLights(torch.tensor(directions, dtype=torch.float64), kappa, full, config.ambient)


def _sun(config: Any) -> Light:
    from dsfit.scene import SunLight

    radius = config.angular_radius_deg * _DEG
    return SunLight(config.direction, radius, config.irradiance, radiance=config.radiance)


def _sphere(config: Any) -> Light:
    from dsfit.scene import SphereLight

    return SphereLight(config.center, config.radius, config.radiance)


def _rectangle(config: Any) -> Light:
    from dsfit.scene import RectangleLight

    return RectangleLight(config.corner, config.edge_u, config.edge_v, config.radiance, config.two_sided)


def _ring(config: Any) -> Light:
    from dsfit.scene import RingLight

    return RingLight(config.center, config.normal, config.inner, config.outer, config.radiance, config.two_sided)


def _total(config: Any) -> Light:
    from dsfit.scene import TotalLight

    lights = []
    for index, part in enumerate(config.lights):
        try:
            lights.append(made(part))
        except InputError as error:
            raise InputError(f"light.lights.{index}.{error.field}", error.value, error.allowed) from None
    shares = [part.share for part in config.lights]
    if all(share is None for share in shares):
        return TotalLight(lights)
    if None in shares:
        raise InputError(f"light.lights.{shares.index(None)}.share", None, "a share for every light, or for none")
    return TotalLight(lights, shares)


_MAKERS = {
    "constant": _constant,
    "environment": _environment,
    "lobes": _lobes,
    "rectangle": _rectangle,
    "ring": _ring,
    "sphere": _sphere,
    "sun": _sun,
    "total": _total,
}
