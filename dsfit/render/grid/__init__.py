"""How many fibres a ray crosses, from a voxel grid of the fibres' moments."""

from __future__ import annotations

from dsfit.render.grid.density import DensityGrid
from dsfit.render.grid.scattering import GridScattering
from dsfit.render.grid.table import DirectionalTable

__all__ = ["DensityGrid", "DirectionalTable", "GridScattering"]
