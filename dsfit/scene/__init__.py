"""What surrounds a shading point: lights, scattering fibres, and images on disk."""

from __future__ import annotations

from dsfit.scene.exr import ExrImage, read_exr, write_exr
from dsfit.scene.function_integrand import FunctionIntegrand
from dsfit.scene.integrand import Integrand
from dsfit.scene.lights import (
    ConstantLight,
    EnvironmentLight,
    Light,
    RectangleLight,
    RingLight,
    SphereLight,
    SunLight,
    TotalLight,
    VonMisesFisherLights,
)
from dsfit.scene.scattering import ConstantScattering, Scattering, SlabScattering, SphereScattering

__all__ = [
    "ConstantLight",
    "ConstantScattering",
    "EnvironmentLight",
    "ExrImage",
    "FunctionIntegrand",
    "Integrand",
    "Light",
    "RectangleLight",
    "RingLight",
    "Scattering",
    "SlabScattering",
    "SphereLight",
    "SphereScattering",
    "SunLight",
    "TotalLight",
    "VonMisesFisherLights",
    "read_exr",
    "write_exr",
]
