"""Lights: constant, von Mises-Fisher lobes, environment maps, sun, sphere, rectangle, ring, and sums of them."""

from __future__ import annotations

from dsfit.scene.lights.base import Light
from dsfit.scene.lights.constant import ConstantLight
from dsfit.scene.lights.environment import EnvironmentLight
from dsfit.scene.lights.lobes import VonMisesFisherLights
from dsfit.scene.lights.rectangle import RectangleLight
from dsfit.scene.lights.ring import RingLight
from dsfit.scene.lights.sphere import SphereLight
from dsfit.scene.lights.sun import SunLight
from dsfit.scene.lights.total import TotalLight

__all__ = [
    "ConstantLight",
    "EnvironmentLight",
    "Light",
    "RectangleLight",
    "RingLight",
    "SphereLight",
    "SunLight",
    "TotalLight",
    "VonMisesFisherLights",
]
