"""Rows of the atlas: the BSDF, from refraction to the whole F cos(theta_i)."""

from __future__ import annotations

from dsfit.checks.stability import bsdf_averages, bsdf_azimuth, bsdf_optics, bsdf_scattered
from dsfit.checks.stability.function import Function

FUNCTIONS: list[Function] = [
    *bsdf_optics.FUNCTIONS,
    *bsdf_azimuth.FUNCTIONS,
    *bsdf_scattered.FUNCTIONS,
    *bsdf_averages.FUNCTIONS,
]
"""Every entry of the BSDF."""
