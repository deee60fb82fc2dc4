"""Marginals and joint density of p* by walkers, by weighted samples of a proposal, and by a grid."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch

from dsfit.checks.independent import Chains, Weighted
from dsfit.checks.independent.chains import Size, to_omega
from dsfit.checks.independent.welch import Sample
from dsfit.context import Context
from dsfit.frame import HALF_PI

BINS = {"theta": 36, "phi": 36, "size": 24}
"""Bins of theta_i, phi and log |F|."""
_GRID = (540, 720)  # midpoints in theta and phi, whole numbers to every bin
_MAP = (60, 80)


@dataclass(frozen=True)
class Grid:
    """|F| cos(theta_i) at midpoints of even cells of (theta_i, phi).

    Attributes:
        norm: int |F| domega by the midpoint rule.
        share: of p* in each cell, `[540, 720]`.
        log_size: log |F|.
    """

    norm: float
    share: np.ndarray
    log_size: np.ndarray

    @staticmethod
    def of(size: Size, context: Context) -> Grid:
        """Evaluate one half of the circle, which the other mirrors: |F| is even in phi."""
        rows, columns = _GRID
        theta = (torch.arange(rows, dtype=torch.float64) + 0.5) / rows * math.pi - HALF_PI
        phi = (torch.arange(columns // 2, dtype=torch.float64) + 0.5) / columns * 2 * math.pi
        half = torch.stack(torch.meshgrid(theta, phi, indexing="ij"), dim=-1)
        value = torch.cat([size(to_omega(part.reshape(-1, 2).numpy(), context)) for part in half.split(60)])
        positive = value.reshape(rows, columns // 2).numpy()
        both = np.concatenate([positive[:, ::-1], positive], axis=1)
        density = both * np.cos(theta.numpy())[:, None]
        norm = float(density.sum() * (math.pi / rows) * (2 * math.pi / columns))
        with np.errstate(divide="ignore"):
            return Grid(norm, density / density.sum(), np.log(both))


def marginals(chains: Chains, drawn: Weighted, grid: Grid, effective: float) -> dict[str, np.ndarray]:
    """Shares of p* in bins: `AXIS.chain`, `.proposal`, their `_error`s, `.quadrature`, and `.edges` in degrees."""
    finite = grid.log_size[grid.share > 0]
    order = np.argsort(finite)
    level = np.cumsum(grid.share[grid.share > 0][order])
    low, high = (float(finite[order][np.searchsorted(level, q)]) for q in (1e-3, 1 - 1e-9))
    edges = {
        "theta": np.linspace(-HALF_PI, HALF_PI, BINS["theta"] + 1),
        "phi": np.linspace(-math.pi, math.pi, BINS["phi"] + 1),
        "size": np.linspace(low, high + 1e-9, BINS["size"] + 1),
    }
    chain = {"theta": chains.place[..., 0], "phi": chains.place[..., 1], "size": chains.log_size}
    own = {"theta": drawn.place[:, 0], "phi": drawn.place[:, 1], "size": drawn.log_size}
    weight = np.exp(drawn.log_weight - drawn.log_weight.max())
    arrays: dict[str, np.ndarray] = {}
    for axis, bounds in edges.items():
        count = len(bounds) - 1
        rows = np.stack([_shares(chain[axis][:, e].ravel(), bounds) for e in range(chains.ensembles)])
        found = Sample.of_independent(rows)
        # the scatter of few ensembles may be small by chance; the autocorrelation knows better then
        least = np.sqrt(found.mean * (1 - found.mean) / effective)
        arrays[f"{axis}.chain"] = found.mean
        arrays[f"{axis}.chain_error"] = np.maximum(np.sqrt(found.variance), least)
        index = np.searchsorted(bounds, own[axis], side="right") - 1
        inside = (index[:, None] == np.arange(count)).astype(float)
        other = Sample.of_weights(weight, inside)
        arrays[f"{axis}.proposal"] = other.mean
        arrays[f"{axis}.proposal_error"] = np.sqrt(np.asarray(other.variance))
    for axis, way in (("theta", 1), ("phi", 0)):
        arrays[f"{axis}.quadrature"] = grid.share.sum(axis=way).reshape(BINS[axis], -1).sum(axis=1)
    arrays["size.quadrature"] = np.histogram(grid.log_size, edges["size"], weights=grid.share)[0]
    kept = {name: value.astype(np.float32) for name, value in arrays.items()}
    return kept | {"size.edges": edges["size"]}


def _shares(values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    return np.histogram(values, edges)[0] / len(values)


def joint(chains: Chains, grid: Grid) -> dict[str, np.ndarray]:
    """p* over (theta_i, phi) in `[60, 80]` cells by the grid; the chains' counts in `[36, 36]`."""
    rows, columns = _MAP
    blocks = grid.share.reshape(rows, _GRID[0] // rows, columns, _GRID[1] // columns).sum(axis=(1, 3))
    every = chains.place.reshape(-1, 2)
    bounds = [[-HALF_PI, HALF_PI], [-math.pi, math.pi]]
    counts = np.histogram2d(every[:, 0], every[:, 1], bins=(BINS["theta"], BINS["phi"]), range=bounds)[0]
    return {"map.quadrature": blocks.astype(np.float32), "map.chain": (counts / len(every)).astype(np.float32)}
