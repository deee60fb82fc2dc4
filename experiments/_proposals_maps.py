"""Proposals over (theta_i, phi): probabilities of even cells by quadrature, and counts of samples in them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from dsfit.checks.cells import CellGrid, cell_masses
from dsfit.checks.chi_square import pooled_chi_square
from dsfit.context import Context
from dsfit.frame import HALF_PI, wrap
from dsfit.proposals.base import Distribution, Proposal
from dsfit.random import uniforms

SHAPE = (24, 36)
"""Cells in theta_i and phi."""
_PILOT = 4096


@dataclass(frozen=True)
class Map:
    """Cells of one proposal `[24, 36]`: expected counts and counts; mass of the density and p-value of chi-square."""

    expected: np.ndarray
    observed: np.ndarray
    mass: float
    p_value: float


def even_cells() -> CellGrid:
    """24 x 36 cells of 7.5 by 10 degrees."""
    theta = torch.linspace(-HALF_PI, HALF_PI, SHAPE[0] + 1, dtype=torch.float64)
    return CellGrid(theta, torch.linspace(-torch.pi, torch.pi, SHAPE[1] + 1, dtype=torch.float64))


def measure(proposal: Proposal, context: Context, samples: int, seed: int) -> Map:
    """Draw and count, and integrate the density over the cells."""
    with torch.no_grad():
        distribution, grid = proposal(context), even_cells()
        pilot, drawn = (_drawn(distribution, count, seed + k) for k, count in enumerate((_PILOT, samples)))
        observed = grid.count(drawn[:, 0], wrap(context.phi_r - drawn[:, 1]))
        mass = cell_masses(distribution, context, grid, [pilot], rtol=1e-5).mass
    total = float(mass.sum())
    expected = mass * (samples / total)
    return Map(expected.numpy(), observed.numpy(), total, pooled_chi_square(observed, expected)[0])


def _drawn(distribution: Distribution, count: int, seed: int) -> Tensor:
    return distribution.sample(
        uniforms((count,), distribution.dimension, generator=torch.Generator().manual_seed(seed))
    )
