"""Azimuths drawn from the fibre's own N_p or N^G_p, given theta_diff: one table per lobe, inverted by CDF."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from dsfit.context import Context
from dsfit.errors import InputError, as_real, check_range
from dsfit.frame import HALF_PI
from dsfit.proposals.base import Azimuthal, AzimuthalDistribution
from dsfit.quadrature import gauss_legendre

_ROWS, _SUBSAMPLES = 97, 3
_COLUMNS = (180, 720)


@dataclass(frozen=True)
class ConditionalAzimuth(AzimuthalDistribution):
    """Density linear in |phi| between nodes and linear in |theta_diff| between rows; even in phi.

    The same blend of two rows gives the density and the CDF, so what is drawn is exactly what `log_prob` says.
    """

    theta_r: Tensor
    density: Tensor
    cumulative: Tensor

    def select(self, take: Callable[[Tensor], Tensor]) -> ConditionalAzimuth:
        return ConditionalAzimuth(take(self.theta_r), self.density, self.cumulative)

    def _row(self, theta_i: Tensor) -> tuple[Tensor, Tensor]:
        """Lower row and share of the upper one."""
        rows = self.density.shape[0] - 1
        position = (0.5 * (self.theta_r - theta_i)).abs() * (rows / HALF_PI)
        row = position.detach().to(torch.int64).clamp(0, rows - 1)
        return row, (position - row).clamp(0, 1)

    def log_prob(self, phi: Tensor, theta_i: Tensor) -> Tensor:
        row, share = self._row(theta_i)
        columns = self.density.shape[1] - 1
        position = phi.abs() * (columns / math.pi)
        column = position.detach().to(torch.int64).clamp(0, columns - 1)
        x = (position - column).clamp(0, 1)
        table, width = self.density.flatten(), columns + 1
        at = row * width + column
        index = at.reshape(-1)  # one dimension even for scalars: vmap has a rule for that
        corners = [table[index + k].reshape(at.shape) for k in (0, 1, width, width + 1)]
        lower, upper = torch.lerp(corners[0], corners[1], x), torch.lerp(corners[2], corners[3], x)
        density = torch.lerp(lower, upper, share.expand_as(lower)) / 2
        empty = density <= 0
        return torch.log(torch.where(empty, 1.0, density)).masked_fill(empty, -math.inf)

    def sample(self, u: Tensor, theta_i: Tensor) -> Tensor:
        signed = 2 * u[..., 0] - 1
        target = signed.abs()
        row, share = self._row(theta_i)
        row, share, target = torch.broadcast_tensors(row, share, target)
        width = self.density.shape[1]
        first = row * width
        cumulative, density = self.cumulative.flatten(), self.density.flatten()

        def blend(table: Tensor, column: Tensor, t: Tensor) -> Tensor:
            return torch.lerp(table[first + column], table[first + column + width], t)

        with torch.no_grad():  # the last column whose blended CDF does not exceed the target
            low, high = torch.zeros_like(first), torch.full_like(first, width - 1)
            for _ in range(math.ceil(math.log2(width))):
                middle = (low + high) // 2
                below = blend(cumulative, middle, share) <= target
                low, high = torch.where(below, middle, low), torch.where(below, high, middle)
            low = low.clamp_max(width - 2)
        step = math.pi / (width - 1)
        rest = (target - blend(cumulative, low, share)) / step
        f0, f1 = blend(density, low, share), blend(density, low + 1, share)
        tiny = torch.finfo(f0.dtype).tiny
        root = torch.sqrt((f0 * f0 + 2 * (f1 - f0) * rest).clamp_min(tiny))
        x = (2 * rest / (f0 + root)).clamp(0, 1)
        return torch.copysign(((low + x) * step).clamp_max(math.pi), signed)


class FiberAzimuth(Azimuthal):
    """phi from a table of azimuthal densities over theta_diff: `p(phi | theta_diff) = N(theta_diff, phi) / int N dphi`.

    Args:
        density: nodal densities `[rows, columns + 1]` over |theta_diff| in [0, pi/2] and |phi| in [0, pi]; any positive
        scale per row. A
            row that is zero throughout becomes uniform.

    Raises:
        InputError: fewer than two rows or columns, a density that is negative or not finite.
    """

    density: Tensor
    cumulative: Tensor

    def __init__(self, density: Tensor) -> None:
        super().__init__()
        density = check_range("density", as_real("density", density), 0.0)
        if density.ndim != 2 or min(density.shape) < 2:
            raise InputError("density", tuple(density.shape), "shape [rows, columns + 1], at least [2, 2]")
        step = math.pi / (density.shape[1] - 1)
        mass = (density[:, 1:] + density[:, :-1]).sum(1, keepdim=True) * (step / 2)
        empty = mass <= torch.finfo(density.dtype).tiny
        density = torch.where(empty, 1 / math.pi, density / torch.where(empty, 1.0, mass))
        cells = (density[:, 1:] + density[:, :-1]) * (step / 2)
        cumulative = torch.cat([torch.zeros_like(mass), cells.cumsum(1)], dim=1)
        self.register_buffer("density", density)
        self.register_buffer("cumulative", cumulative / cumulative[:, -1:])

    def forward(self, context: Context) -> ConditionalAzimuth:
        return ConditionalAzimuth(context.theta_r, self.density.to(context.dtype), self.cumulative.to(context.dtype))


@torch.no_grad()
def lobe_azimuths(bsdf, *, scattered: bool = False, orientations: int = 8) -> list[FiberAzimuth]:  # noqa: ANN001
    """The laws of R, TT and TRT (or of N^G_R, N^G_TT, N^G_TRT) of a `DualScattering`: norm over channels, each
    normalised per theta_diff.

    For an eccentric fibre TRT is averaged over `orientations` of the section. Cells are averages, so an integrable
    caustic (the `raw` model) gives a finite table.
    """
    narrow = float(bsdf.fiber.caustic_width.detach().min())
    columns = int(min(_COLUMNS[1], max(_COLUMNS[0], math.ceil(math.pi / (narrow / 8)))))
    theta = torch.linspace(0.0, HALF_PI, _ROWS, dtype=torch.float64)
    step = math.pi / columns
    phi = torch.arange(columns + 1, dtype=torch.float64) * step
    source = bsdf.azimuthal_scattered if scattered else bsdf.azimuthal
    offsets, weights = gauss_legendre(_SUBSAMPLES)
    if scattered:
        offsets, weights = torch.zeros(1, dtype=torch.float64), torch.full((1,), 2.0, dtype=torch.float64)
    angles = [None] if bsdf.fiber.is_round else [k * math.pi / orientations for k in range(orientations)]
    total: Tensor | float = 0.0
    for angle in angles:
        phi_h = None if angle is None else torch.tensor(angle, dtype=torch.float64)
        for offset, weight in zip(offsets, weights, strict=True):
            at = (phi + 0.5 * step * offset).abs()
            at = math.pi - (math.pi - at).abs()
            value = source(theta[:, None], at[None, :], phi_h=phi_h)
            total = total + torch.linalg.vector_norm(value, dim=-1) * (weight / 2)
    table = torch.as_tensor(total)
    return [FiberAzimuth(table[..., k].contiguous()) for k in range(3)]
