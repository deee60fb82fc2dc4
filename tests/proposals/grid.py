"""Quadrature of a density of directions over cells of (theta_i, phi), and the chi-square test of samples against it."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from dsfit.checks.chi_square import pooled_chi_square
from dsfit.context import Context
from dsfit.frame import HALF_PI, cos_inclination, wrap
from dsfit.proposals.base import Distribution

Peak = tuple[float, float]

STEPS = (0.25, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 11.0, 16.0, 24.0, 40.0)
NODES, WEIGHTS = np.polynomial.legendre.leggauss(12)


def edges_of(low: float, high: float, cells: int, peaks: list[Peak], breaks: tuple[float, ...]) -> np.ndarray:
    """Panel edges: the cell edges, the breaks, and panels that grow away from each peak."""
    edges = [*np.linspace(low, high, cells + 1), *breaks]
    for centre, width in peaks:
        edges += [centre, *(centre + side * width * step for side in (-1, 1) for step in STEPS)]
    found = np.unique(np.clip(edges, low, high))
    return found[np.concatenate([[True], np.diff(found) > 1e-13])]


def nodes_of(edges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Legendre nodes and weights `[panels, 12]`."""
    half = np.diff(edges)[:, None] / 2
    return edges[:-1, None] + half * (1 + NODES), half * WEIGHTS


def cell_masses(
    distribution: Distribution,
    context: Context,
    cells: tuple[int, int],
    theta_peaks: list[Peak],
    phi_peaks: list[Peak],
    phi_breaks: tuple[float, ...],
) -> Tensor:
    """Integral of exp(log_prob) over every cell `[theta cells, phi cells]`; the sum is that over the sphere."""
    # A lobe out of reach is an exponential against +-pi/2, however narrow: panels that shrink towards both.
    ends = tuple(side * (HALF_PI - 0.1 * 2.0**-k) for side in (-1, 1) for k in range(0, 26, 2))
    theta_edges = edges_of(-HALF_PI, HALF_PI, cells[0], theta_peaks, ends)
    phi_edges = edges_of(-math.pi, math.pi, cells[1], phi_peaks, (-HALF_PI, 0.0, HALF_PI, *phi_breaks))
    (theta, theta_weight), (phi, phi_weight) = nodes_of(theta_edges), nodes_of(phi_edges)
    columns = torch.from_numpy(phi.ravel())
    phi_i = wrap(context.phi_r - columns)
    rows = []
    for x, weight in zip(theta, theta_weight, strict=True):
        angle = torch.from_numpy(x)[:, None].expand(-1, len(columns))
        density = torch.exp(distribution.log_prob(torch.stack([angle, phi_i.expand_as(angle)], dim=-1)))
        rows.append((density * (cos_inclination(angle) * torch.from_numpy(weight)[:, None])).sum(dim=0))
    panel = (torch.stack(rows).reshape(len(theta), len(phi), -1) * torch.from_numpy(phi_weight)).sum(dim=-1)
    row_cell = _cell_of(theta_edges, -HALF_PI, HALF_PI, cells[0])
    column_cell = _cell_of(phi_edges, -math.pi, math.pi, cells[1])
    masses = torch.zeros(cells, dtype=torch.float64)
    masses.index_put_((row_cell[:, None], column_cell[None, :]), panel, accumulate=True)
    return masses


def _cell_of(edges: np.ndarray, low: float, high: float, cells: int) -> Tensor:
    middle = (edges[1:] + edges[:-1]) / 2
    return torch.from_numpy(np.clip(np.floor((middle - low) / (high - low) * cells), 0, cells - 1).astype(np.int64))


def counts(omega: Tensor, context: Context, cells: tuple[int, int]) -> Tensor:
    """Number of directions in every cell."""
    theta, phi = omega[..., 0].reshape(-1), wrap(context.phi_r - omega[..., 1]).reshape(-1)
    row = ((theta + HALF_PI) / math.pi * cells[0]).floor().long().clamp(0, cells[0] - 1)
    column = ((phi + math.pi) / (2 * math.pi) * cells[1]).floor().long().clamp(0, cells[1] - 1)
    return torch.bincount(row * cells[1] + column, minlength=cells[0] * cells[1]).reshape(cells)


def chi_square(observed: Tensor, probability: Tensor) -> float:
    """p-value of counts against cell probabilities, by the library's own test."""
    return pooled_chi_square(observed, probability * observed.sum())[0]
