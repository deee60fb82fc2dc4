"""Tabulated 2-D inversion: |f| cos(theta_i) on a grid of (theta_i, phi), a constant density in every cell."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from dsfit.arguments import check_directions, check_uniforms
from dsfit.context import Context
from dsfit.errors import InputError, as_number
from dsfit.frame import HALF_PI, cos_inclination, wrap
from dsfit.proposals.base import Distribution, Proposal

if TYPE_CHECKING:
    from dsfit.scene.integrand import Integrand

_EVALUATIONS_AT_ONCE = 1 << 18


@dataclass(frozen=True)
class Tables:
    """M tables over theta_i in [-pi/2, pi/2] x phi, each of masses that sum to 1.

    Attributes:
        log_density: log of mass over (d theta_i d phi), `[M, rows, columns]`, radians^-2.
        marginal: upper ends of the rows' CDF, `[M, rows]`. conditional: of the columns' in each row, `[M, rows,
            columns]`.
        integral: int |f| domega as the table's midpoints have it, `[M]`.
        even: whether columns cover |phi| in [0, pi], the sign being drawn with it, or phi in [-pi, pi].
    """

    log_density: Tensor
    marginal: Tensor
    conditional: Tensor
    integral: Tensor
    even: bool

    @staticmethod
    def of(mass: Tensor, defensive: float, even: bool) -> Tables:
        """From cell integrals of |f| `[M, rows, columns]`, with a share that is uniform over the grid."""
        rows, columns = mass.shape[1:]
        integral = mass.sum((1, 2))
        dark = integral <= 0
        scale = torch.where(dark, 1.0, integral)[:, None, None]
        share = torch.where(dark[:, None, None], 1 / (rows * columns), mass / scale)
        share = (1 - defensive) * share + defensive / (rows * columns)
        in_row = share.sum(-1)
        marginal, conditional = in_row.cumsum(-1), share.cumsum(-1)
        area = (math.pi / rows) * (2 * math.pi / columns)
        return Tables(
            torch.log(share / area), marginal / marginal[:, -1:], conditional / conditional[..., -1:], integral, even
        )

    def find(self, which: Tensor, u: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """theta_i, phi and log density per d theta_i d phi, from uniforms `[..., 2]` in tables `which[...]`.

        Monotone in both uniforms (in |phi|, if even): marginal CDF of theta_i, then the CDF of phi in its row.
        """
        _, rows, columns = self.log_density.shape
        marginal, conditional = self.marginal.reshape(-1), self.conditional.reshape(-1)
        row, first = _search(marginal, which * rows, rows, u[..., 0])
        theta = _inside(marginal, which * rows, row, first, u[..., 0]) * (math.pi / rows) - HALF_PI
        start = (which * rows + row) * columns
        v = (2 * u[..., 1] - 1).abs() if self.even else u[..., 1]
        column, before = _search(conditional, start, columns, v)
        x = _inside(conditional, start, column, before, v) * (1 / columns)
        size = math.pi * x
        phi = torch.where(u[..., 1] < 0.5, -size, size) if self.even else 2 * size - math.pi
        return theta.clamp(-HALF_PI, HALF_PI), phi, self.log_density.reshape(-1)[start + column]

    def at(self, which: Tensor, theta_i: Tensor, phi: Tensor) -> Tensor:
        """Log density per d theta_i d phi at `theta_i, phi` in [-pi, pi], of tables `which`; all `[...]`."""
        _, rows, columns = self.log_density.shape
        row = ((theta_i + HALF_PI) * (rows / math.pi)).long().clamp(0, rows - 1)
        x = phi.abs() if self.even else 0.5 * (phi + math.pi)
        column = (x * (columns / math.pi)).long().clamp(0, columns - 1)
        return self.log_density.reshape(-1)[(which * rows + row) * columns + column]


def _search(cumulative: Tensor, start: Tensor, count: int, u: Tensor) -> tuple[Tensor, Tensor]:
    """Index k in 0..count - 1 of the first `cumulative[start + k]` above u, and the value before it (0 for k = 0)."""
    start, u = torch.broadcast_tensors(start, u.detach())
    low, high = torch.zeros_like(start), torch.full_like(start, count - 1)
    for _ in range(max(1, math.ceil(math.log2(count)))):
        middle = (low + high) // 2
        above = cumulative[start + middle] > u
        low, high = torch.where(above, low, torch.minimum(middle + 1, high)), torch.where(above, middle, high)
    before = torch.where(low > 0, cumulative[start + (low - 1).clamp_min(0)], 0.0)
    return low, before


def _inside(cumulative: Tensor, start: Tensor, index: Tensor, before: Tensor, u: Tensor) -> Tensor:
    """index + the share of the cell that u has passed."""
    width = (cumulative[start + index] - before).clamp_min(torch.finfo(u.dtype).tiny)
    return index + ((u - before) / width).clamp(0.0, 1.0)


class TableDistribution(Distribution):
    """Directions from one table per context: `which[*batch]` of `tables`."""

    dimension = 2

    def __init__(self, context: Context, tables: Tables, which: Tensor) -> None:
        self.context, self.tables, self.which = context, tables, which
        self.batch_shape = context.batch_shape

    def select(self, take: Callable[[Tensor], Tensor]) -> TableDistribution:
        return TableDistribution(self.context._map(take), self.tables, take(self.which))

    def sample_with_log_prob(self, u: Tensor) -> tuple[Tensor, Tensor]:
        u = check_uniforms(u, self.dimension, self.batch_shape)
        theta_i, phi, log_density = self.tables.find(self.which, u)
        omega = torch.stack([theta_i, wrap(self.context.phi_r - phi)], dim=-1)
        return omega, log_density - torch.log(cos_inclination(theta_i))

    def log_prob(self, omega: Tensor) -> Tensor:
        check_directions(omega, self.batch_shape)
        theta_i, phi_i = omega.unbind(-1)
        log_density = self.tables.at(self.which, *torch.broadcast_tensors(theta_i, wrap(self.context.phi_r - phi_i)))
        return log_density - torch.log(cos_inclination(theta_i))


def tabulate(
    integrand: Integrand, context: Context, resolution: tuple[int, int], samples: int, defensive: float
) -> Tables:
    """One table for every context `[M]`: cell averages of |f| cos(theta_i) by `samples` x `samples` midpoints.

    Memory is bounded: contexts are taken some hundred thousand evaluations at a time.
    """
    rows, columns = (int(n) * samples for n in resolution)
    even, dtype = integrand.is_even, context.dtype
    theta = ((torch.arange(rows, dtype=dtype) + 0.5) / rows - 0.5) * math.pi
    x = (torch.arange(columns, dtype=dtype) + 0.5) / columns
    phi = math.pi * x if even else math.pi * (2 * x - 1)
    area = (math.pi / rows) * (2 * math.pi / columns)
    flat = context.reshape(-1)
    parts = []
    with torch.no_grad():
        for start in range(0, len(flat), max(1, _EVALUATIONS_AT_ONCE // (rows * columns))):
            one = flat[start : start + max(1, _EVALUATIONS_AT_ONCE // (rows * columns))]
            azimuth = wrap(one.phi_r - phi[:, None]).expand(rows, columns, -1)
            omega = torch.stack([theta[:, None, None].expand_as(azimuth), azimuth], dim=-1)
            norm = torch.linalg.vector_norm(integrand(omega.reshape(rows * columns, -1, 2), one), dim=-1)
            mass = norm.reshape(rows, columns, -1) * cos_inclination(theta)[:, None, None] * area
            blocks = mass.reshape(resolution[0], samples, resolution[1], samples, -1).sum((1, 3))
            parts.append(blocks.movedim(-1, 0))
    return Tables.of(torch.cat(parts), defensive, even)


class Table2D(Proposal):
    """For every context its own table of |f| cos(theta_i) over (theta_i, phi), drawn by inverting the marginal CDF of
    theta_i and the CDF of phi in its row.

    The density is constant in every cell per d theta_i d phi, so per steradian it is that over cos(theta_i). Made anew
    whenever it is called: rows x columns x samples^2 evaluations of the integrand per context. For integrands even in
    phi the columns cover half the circle.

    Args:
        integrand: what is tabulated.
        resolution: rows in theta_i and columns in phi.
        samples: midpoints per cell and axis that its average is taken from.
        defensive: share that is uniform over the grid, in (0, 1): covers what midpoints miss.

    Raises:
        InputError: a resolution or a number of samples that is no integer >= 1, defensive out of range.
    """

    def __init__(
        self,
        integrand: Integrand,
        resolution: tuple[int, int] = (64, 64),
        samples: int = 1,
        defensive: float = 0.005,
    ) -> None:
        super().__init__()
        self.integrand = integrand
        self.resolution = check_resolution("resolution", resolution)
        self.samples = check_count("samples", samples)
        self.defensive = as_number("defensive", defensive, 0.0, 1.0, open_low=True, open_high=True)

    def forward(self, context: Context) -> TableDistribution:
        tables = tabulate(self.integrand, context, self.resolution, self.samples, self.defensive)
        which = torch.arange(context.batch_shape.numel()).reshape(context.batch_shape)
        return TableDistribution(context, tables, which)


def check_count(field: str, value: object, least: int = 1) -> int:
    """An integer >= least, else `InputError`."""
    if isinstance(value, bool) or not isinstance(value, int) or value < least:
        raise InputError(field, value, f"an integer >= {least}")
    return value


def check_resolution(field: str, value: object) -> tuple[int, int]:
    """Two integers >= 1, else `InputError`."""
    if not isinstance(value, tuple | list) or len(value) != 2:
        raise InputError(field, value, "two integers >= 1: rows in theta_i, columns in phi")
    return check_count(field, value[0]), check_count(field, value[1])
