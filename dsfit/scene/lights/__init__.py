"""Lights: constant, von Mises-Fisher lobes, equirectangular environment maps."""

from __future__ import annotations

from dsfit.scene.lights.base import Light
from dsfit.scene.lights.constant import ConstantLight
from dsfit.scene.lights.environment import EnvironmentLight
from dsfit.scene.lights.lobes import VonMisesFisherLights

__all__ = ["ConstantLight", "EnvironmentLight", "Light", "VonMisesFisherLights"]
