"""Adaptive cubature over the sphere of directions, in cells that follow curved edges of the integrand.

A cell is an interval of theta times one segment of azimuth between two edges phi_j(theta), phi_{j+1}(theta), mapped by
`phi = phi_j + (phi_{j+1} - phi_j) sin^2(pi s / 2)`. The map gathers nodes at both ends and turns half-integer powers
there (a caustic, a support edge) into analytic functions. Each cell is integrated by two Gauss rules without common
nodes; their difference is the error bound of the better one, and decides where to refine.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from dsfit.quadrature import gauss_legendre

_HIGH, _LOW = 10, 7
_CELLS_AT_ONCE = 256


@dataclass(frozen=True)
class Cells:
    """Cells `[M]`: theta interval, segment number, and interval of the segment coordinate s."""

    theta_low: Tensor
    theta_high: Tensor
    segment: Tensor
    s_low: Tensor
    s_high: Tensor

    def __len__(self) -> int:
        return len(self.theta_low)

    def __getitem__(self, index: Tensor | slice) -> Cells:
        return Cells(*(x[index] for x in self._fields()))

    def _fields(self) -> tuple[Tensor, ...]:
        return self.theta_low, self.theta_high, self.segment, self.s_low, self.s_high

    @staticmethod
    def join(parts: list[Cells]) -> Cells:
        """All cells of several lists."""
        return Cells(*(torch.cat(x) for x in zip(*(p._fields() for p in parts), strict=True)))

    @staticmethod
    def grid(theta_breaks: Tensor, segments: int) -> Cells:
        """Every theta panel times every azimuth segment."""
        panels = len(theta_breaks) - 1
        rows = torch.arange(panels).repeat_interleave(segments)
        segment = torch.arange(segments).repeat(panels)
        zero = torch.zeros(panels * segments, dtype=theta_breaks.dtype)
        return Cells(theta_breaks[rows], theta_breaks[rows + 1], segment, zero, zero + 1)

    def split(self, along_theta: Tensor) -> Cells:
        """Each cell halved, in theta where asked, else in s."""
        theta = torch.where(along_theta, (self.theta_low + self.theta_high) / 2, self.theta_high)
        s = torch.where(along_theta, self.s_high, (self.s_low + self.s_high) / 2)
        first = Cells(self.theta_low, theta, self.segment, self.s_low, s)
        theta_low = torch.where(along_theta, theta, self.theta_low)
        s_low = torch.where(along_theta, self.s_low, s)
        return Cells.join([first, Cells(theta_low, self.theta_high, self.segment, s_low, self.s_high)])


@dataclass(frozen=True)
class Cubature:
    """Integrals `[K]` with error bounds `[K]`, the cells `[M]` that gave them with each cell's part `[M, K]` of the
    integrals and of the bounds, and what they cost.
    """

    value: Tensor
    error: Tensor
    evaluations: int
    converged: bool
    cells: Cells
    parts: Tensor
    part_errors: Tensor


def nodes_of(cells: Cells, edges: Callable[[Tensor], Tensor], count: int) -> tuple[Tensor, Tensor, Tensor]:
    """theta, phi and weight `[M, count, count]` (theta first) of the tensor Gauss rule in each cell; sum w f = int f
    dtheta dphi.
    """
    x, w = gauss_legendre(count, cells.theta_low.dtype)
    half_theta = ((cells.theta_high - cells.theta_low) / 2)[:, None]
    theta = cells.theta_low[:, None] + half_theta * (1 + x)
    bounds = edges(theta)
    at = cells.segment[:, None].expand_as(theta)[..., None]
    low, high = bounds.gather(-1, at), bounds.gather(-1, at + 1)
    half_s = ((cells.s_high - cells.s_low) / 2)[:, None]
    s = cells.s_low[:, None] + half_s * (1 + x)
    angle = (math.pi / 2) * s[:, None, :]
    phi = low + (high - low) * torch.sin(angle) ** 2
    slope = (high - low) * (math.pi / 2) * torch.sin(2 * angle)
    weight = (half_theta * w)[:, :, None] * (half_s * w)[:, None, :] * slope
    return theta[:, :, None].expand_as(phi), phi, weight


def _apply(
    function: Callable[[Tensor, Tensor], Tensor], cells: Cells, edges: Callable[[Tensor], Tensor]
) -> tuple[Tensor, Tensor, Tensor]:
    """Cell integrals, error bounds `[M, K]`, and whether a cell should be split along theta `[M]`."""
    values, errors, along = [], [], []
    x, w = gauss_legendre(_HIGH, cells.theta_low.dtype)
    top = torch.stack([_legendre_polynomial(k, x) * w for k in (_HIGH - 2, _HIGH - 1)])
    for start in range(0, len(cells), _CELLS_AT_ONCE):
        part = cells[start : start + _CELLS_AT_ONCE]
        sums = []
        for count in (_HIGH, _LOW):
            theta, phi, weight = nodes_of(part, edges, count)
            f = function(theta, phi) * weight.unsqueeze(-1)
            sums.append(f.sum((1, 2)))
            if count == _HIGH:
                scaled = f / (w[:, None, None] * w[:, None])
                tail_theta = torch.einsum("tj,mjsk->mtsk", top, scaled).abs().sum((1, 2))
                tail_s = torch.einsum("sj,mtjk->mtsk", top, scaled).abs().sum((1, 2))
                along.append((tail_theta > tail_s).to(torch.float64).mean(-1) > 0.5)
        values.append(sums[0])
        errors.append((sums[0] - sums[1]).abs())
    return torch.cat(values), torch.cat(errors), torch.cat(along)


def _legendre_polynomial(k: int, x: Tensor) -> Tensor:
    before, current = torch.ones_like(x), x
    for j in range(1, k):
        before, current = current, ((2 * j + 1) * x * current - j * before) / (j + 1)
    return current


def integrate(
    function: Callable[[Tensor, Tensor], Tensor],
    theta_breaks: Tensor,
    edges: Callable[[Tensor], Tensor],
    rtol: float,
    max_evaluations: int,
) -> Cubature:
    """Integrate `function(theta, phi) -> [..., K]` over theta in [breaks[0], breaks[-1]] and phi between the outer
    edges.

    Args:
        theta_breaks: increasing ends of the first panels; nodes must see every peak, so put breaks at narrow ones.
        edges: theta `[...]` to sorted azimuths `[..., J + 1]`; segments of no width are allowed.
        rtol: wanted error of each integral, relative to it (integrals below 1e-6 of the largest count as that).
        max_evaluations: give up refining beyond this; `converged` is then False and the error bound says what was
            reached.

    The error bound is the sum over cells of |Gauss 10 - Gauss 7|, which overestimates the error of Gauss 10 by orders
    of magnitude where the integrand is smooth, plus rounding.
    """
    with torch.no_grad():
        segments = edges(theta_breaks[:1]).shape[-1] - 1
        cells = Cells.grid(theta_breaks, segments)
        value, error, along = _apply(function, cells, edges)
        per_cell = _HIGH**2 + _LOW**2
        evaluations = per_cell * len(cells)
        while True:
            total = value.sum(0)
            magnitude = total.abs()
            scale = torch.maximum(magnitude, 1e-6 * magnitude.max()).clamp_min(torch.finfo(total.dtype).tiny)
            rounding = 4 * torch.finfo(total.dtype).eps * value.abs().sum(0)
            relative = (error / scale).amax(-1)
            if bool((error.sum(0) + rounding <= rtol * scale).all()):
                return Cubature(total, error.sum(0) + rounding, evaluations, True, cells, value, error)
            order = torch.argsort(relative, descending=True)
            left = relative.sum() - torch.cumsum(relative[order], 0)
            count = int((left > 0.1 * rtol).sum()) + 1
            fine = relative[order] > 0.01 * rtol / len(cells)
            chosen = order[:count][fine[:count]]
            out_of_budget = evaluations + 2 * per_cell * len(chosen) > max_evaluations
            if out_of_budget or len(chosen) == 0:
                return Cubature(total, error.sum(0) + rounding, evaluations, False, cells, value, error)
            keep = torch.ones(len(cells), dtype=torch.bool)
            keep[chosen] = False
            children = cells[chosen].split(along[chosen])
            new = _apply(function, children, edges)
            evaluations += per_cell * len(children)
            cells = Cells.join([cells[keep], children])
            value, error = torch.cat([value[keep], new[0]]), torch.cat([error[keep], new[1]])
            along = torch.cat([along[keep], new[2]])
