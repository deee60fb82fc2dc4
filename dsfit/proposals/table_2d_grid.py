"""Tables that a renderer could make once: over theta_r for direct light, over (theta_r, n) for scattered light."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from dsfit.arguments import check_directions, check_uniforms
from dsfit.context import Context
from dsfit.errors import InputError, as_number, check_choice
from dsfit.frame import HALF_PI, cos_inclination, wrap
from dsfit.proposals.base import Distribution, Proposal
from dsfit.proposals.mixture import log_sum_exp
from dsfit.proposals.table_2d import Tables, check_count, check_resolution, tabulate

if TYPE_CHECKING:
    from dsfit.scene.integrand import Integrand

BLENDS = ("nearest", "linear")


class BlendedTables(Distribution):
    """A mixture of a few of the grid's tables for every context.

    Args:
        context: `[*batch]`.
        tables: all of the grid.
        which: indices of the context's tables, `[*batch, K]`.
        log_weights: their log weights, normalised, `[*batch, K]`.

    The table is drawn with the first uniform, which is then stretched and used for theta_i: two uniforms a direction.
    """

    dimension = 2

    def __init__(self, context: Context, tables: Tables, which: Tensor, log_weights: Tensor) -> None:
        self.context, self.tables, self.which, self.log_weights = context, tables, which, log_weights
        self.batch_shape = context.batch_shape
        weights = torch.exp(log_weights)
        self._ends = torch.nn.functional.pad(weights.cumsum(-1), (1, 0))

    def select(self, take: Callable[[Tensor], Tensor]) -> BlendedTables:
        which = torch.stack([take(x) for x in self.which.unbind(-1)], dim=-1)
        weights = torch.stack([take(x) for x in self.log_weights.unbind(-1)], dim=-1)
        return BlendedTables(self.context._map(take), self.tables, which, weights)

    def sample_with_log_prob(self, u: Tensor) -> tuple[Tensor, Tensor]:
        u = check_uniforms(u, self.dimension, self.batch_shape)
        shape = (*u.shape[:-1], self.which.shape[-1])
        inner = self._ends[..., 1:-1]
        k = (u[..., :1] >= inner).sum(-1, keepdim=True)
        low = self._ends[..., :-1].expand(shape).gather(-1, k)
        width = (self._ends[..., 1:].expand(shape).gather(-1, k) - low).clamp_min(torch.finfo(u.dtype).tiny)
        eps = torch.finfo(u.dtype).eps
        stretched = ((u[..., :1] - low) / width).clamp(eps / 4, 1 - eps / 2)
        chosen = self.which.expand(shape).gather(-1, k).squeeze(-1)
        theta_i, phi, _ = self.tables.find(chosen, torch.cat([stretched, u[..., 1:2]], dim=-1))
        omega = torch.stack([theta_i, wrap(self.context.phi_r - phi)], dim=-1)
        return omega, self._log_prob(theta_i, phi)

    def _log_prob(self, theta_i: Tensor, phi: Tensor) -> Tensor:
        found = self.tables.at(self.which, theta_i.unsqueeze(-1), phi.unsqueeze(-1))
        return log_sum_exp(found + self.log_weights) - torch.log(cos_inclination(theta_i))

    def log_prob(self, omega: Tensor) -> Tensor:
        check_directions(omega, self.batch_shape)
        theta_i, phi_i = omega.unbind(-1)
        return self._log_prob(*torch.broadcast_tensors(theta_i, wrap(self.context.phi_r - phi_i)))


class GridOfTables(Proposal):
    """Tables of the direct part (n = 0, v = 1) over theta_r and of the scattered part (v = 0) over (theta_r, n), looked
    up for every context.

    As F = v F_direct + (1 - v) F_scatter, a context's density is the mixture of a direct and a scattered one with their
    integrals, interpolated in logs, as weights: exact in v. Each of these is the grid's nearest table ("nearest"), or
    one of the 2 or 4 around it drawn with bilinear weights ("linear"; the density is that of the whole mixture).

    Args:
        integrand: without lights or scattering that change with the direction, so that F is all there is.
        views: values of theta_r, equally spaced over [-pi/2, pi/2]; at least 2.
        depths: values of n, increasing, >= 0; at least 2. Beyond the last its table is used.
        resolution, samples, defensive: as for `Table2D`.
        blend: "nearest" or "linear".
        dtype: of the tables; contexts of any dtype may look them up.

    Raises:
        InputError: an argument out of range.
    """

    _depths: Tensor

    def __init__(
        self,
        integrand: Integrand,
        views: int = 64,
        depths: tuple[float, ...] = (0.0, 1.0, 2.0, 4.0, 8.0, 16.0, 30.0),
        resolution: tuple[int, int] = (64, 64),
        samples: int = 1,
        defensive: float = 0.005,
        blend: str = "linear",
        dtype: torch.dtype = torch.float64,
    ) -> None:
        super().__init__()
        self.views, self.blend = check_count("views", views, 2), check_choice("blend", blend, BLENDS)
        depths = tuple(float(n) for n in depths)
        increasing = all(0 <= a < b < math.inf for a, b in zip(depths[:-1], depths[1:], strict=True))
        if len(depths) < 2 or not increasing:
            raise InputError("depths", depths, "at least two increasing numbers >= 0")
        given = check_resolution("resolution", resolution), check_count("samples", samples)
        share = as_number("defensive", defensive, 0.0, 1.0, open_low=True, open_high=True)
        self.register_buffer("_depths", torch.tensor(depths, dtype=torch.float64))
        theta_r = torch.linspace(-HALF_PI, HALF_PI, self.views, dtype=torch.float64).clamp(-1.5707, 1.5707)
        n = self._depths.repeat_interleave(self.views)
        theta = theta_r.repeat(1 + len(depths))
        lit = torch.zeros_like(theta)
        lit[: self.views] = 1.0
        grid = Context(theta, 0.0, torch.cat([torch.zeros_like(theta_r), n]), lit).to(dtype)
        self.tables = tabulate(integrand, grid, *given, share)
        self.register_buffer("_log_integral", torch.log(self.tables.integral.clamp_min(torch.finfo(dtype).tiny)))

    def forward(self, context: Context) -> BlendedTables:
        if context.dtype != self.tables.marginal.dtype:
            self.tables = self._in(context.dtype)
        row, along = self._position(context.theta_r)
        level, up = self._level(context.n)
        ends = [(row, torch.log1p(-along)), (row + 1, torch.log(along))]
        floors = [(level, torch.log1p(-up)), (level + 1, torch.log(up))]
        scattered = [(self.views * (1 + k) + i, x + y) for k, y in floors for i, x in ends]
        which, weights = [], []
        for group, share in ((ends, context.v), (scattered, 1 - context.v)):
            index, blend = torch.stack([i for i, _ in group], dim=-1), torch.stack([x for _, x in group], dim=-1)
            if self.blend == "nearest":
                best = blend.argmax(-1, keepdim=True)
                index, blend = index.gather(-1, best), torch.zeros_like(blend[..., :1])
            energy = (torch.exp(blend) * self._log_integral.to(context.dtype)[index]).sum(-1, keepdim=True)
            dark = share <= 0
            share = torch.log(torch.where(dark, 1.0, share)).masked_fill(dark, -math.inf)
            which.append(index)
            weights.append(blend + energy + share.unsqueeze(-1))
        log_weights = torch.log_softmax(torch.cat(weights, dim=-1), dim=-1)
        return BlendedTables(context, self.tables, torch.cat(which, dim=-1), log_weights)

    def _position(self, theta_r: Tensor) -> tuple[Tensor, Tensor]:
        at = (theta_r / math.pi + 0.5).clamp(0.0, 1.0) * (self.views - 1)
        row = at.long().clamp(0, self.views - 2)
        return row, (at - row).clamp(0.0, 1.0)

    def _level(self, n: Tensor) -> tuple[Tensor, Tensor]:
        depths = self._depths.to(n)
        level = (torch.searchsorted(depths, n.contiguous(), right=True) - 1).clamp(0, len(depths) - 2)
        return level, ((n - depths[level]) / (depths[level + 1] - depths[level])).clamp(0.0, 1.0)

    def _in(self, dtype: torch.dtype) -> Tables:
        old = self.tables
        columns = (old.log_density, old.marginal, old.conditional, old.integral)
        return Tables(*(x.to(dtype) for x in columns), old.even)
