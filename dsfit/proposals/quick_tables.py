"""What a proposal needs to know of a fibre, tabulated in a fraction of the time that the BSDF's own tables take."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from dsfit.bsdf.averages import _EDGES, _JUMPS, LobeShares
from dsfit.bsdf.azimuthal import ALL_LOBES, azimuthal
from dsfit.bsdf.conventions import Convention
from dsfit.bsdf.dual_scattering import DualScattering
from dsfit.bsdf.fiber import Fiber
from dsfit.frame import HALF_PI, cos_inclination, wrap
from dsfit.proposals.conditional import FiberAzimuth
from dsfit.quadrature import gauss_legendre

_INCLINATIONS, _ENERGIES, _ORIENTED_ENERGIES = 257, 513, 129
_ROWS, _COLUMNS, _SUBSAMPLES = 97, (180, 720), (3, 2)
_ORIENTATIONS = 7


def interpolate(table: Tensor, position: Tensor) -> Tensor:
    """Rows `[..., V]` of `table [R, V]` at fractional row numbers `position [...]`, linear between rows."""
    row = position.detach().to(torch.int64).clamp(0, len(table) - 2)
    index = row.reshape(-1)
    share = (position - row).clamp(0.0, 1.0).reshape(-1, 1)
    value = torch.lerp(table.index_select(0, index), table.index_select(0, index + 1), share)
    return value.reshape(*position.shape, table.shape[-1])


class _Energies:
    """Azimuthal energies of one lobe over theta_diff in [0, pi/2]."""

    def __init__(self, rows: Tensor) -> None:
        self.rows = rows.contiguous()

    def __call__(self, theta_diff: Tensor) -> Tensor:
        return interpolate(self.rows, _from_grazing(theta_diff) * (len(self.rows) - 1))


def _from_grazing(angle: Tensor) -> Tensor:
    """Table coordinate in [0, 1] of an angle in [0, pi/2], whose equal steps get finer towards grazing."""
    return 1 - torch.sqrt((1 - angle / HALF_PI).clamp(0.0, 1.0))


def _to_grazing(x: Tensor) -> Tensor:
    """Inverse of `_from_grazing`."""
    return HALF_PI * (1 - (1 - x) ** 2)


class QuickShares(LobeShares):
    """Forward and backward shares of each lobe as `LobeShares` defines them, from tables linear in theta_diff and
    theta_in, to some 1e-4 of the largest share instead of 1e-11.
    """

    def __init__(self, fiber: Fiber, convention: Convention) -> None:
        self.fiber, self.convention = fiber, convention
        self._targets = _JUMPS if convention.split == "fraction" else _JUMPS + _EDGES
        self._kinks = self._jumps()
        rows = _ENERGIES if fiber.is_round else _ORIENTED_ENERGIES
        energies = self._energies_at(_to_grazing(torch.linspace(0.0, 1.0, rows, dtype=fiber.dtype)))
        self._energies = [_Energies(self._of_lobe(energies, p)) for p in range(3)]
        x = torch.linspace(-1.0, 1.0, _INCLINATIONS, dtype=fiber.dtype)
        limit = HALF_PI * (1 - 1e-6)  # shares over cosine have a limit at grazing, which is taken from inside
        self._rows = self._scaled_shares_at(torch.sign(x) * _to_grazing(x.abs()).clamp_max(limit))

    def energies(self, p: int, theta_diff: Tensor) -> Tensor:
        """Azimuthal energy E_p at theta_diff in [0, pi/2], `[..., C]`, averaged over orientations of the section."""
        return self._energies[p](theta_diff).unflatten(-1, (2, -1)).sum(-2)

    def __call__(self, theta_in: Tensor) -> tuple[Tensor, Tensor]:
        position = (1 + torch.sign(theta_in) * _from_grazing(theta_in.abs())) * ((_INCLINATIONS - 1) / 2)
        scaled = interpolate(self._rows.to(theta_in), position)
        scaled = scaled.reshape(*theta_in.shape, 2, 3, self.fiber.channels)
        value = scaled * cos_inclination(theta_in)[..., None, None, None]
        return value.select(-3, 0), value.select(-3, 1)


class QuickScattering(DualScattering):
    """A BSDF whose averages and N^G come from coarse tables that are made together in about 0.1 s for a round fibre,
    for shaping and training proposals. Direct terms stay exact.

    N^G is the running mean over a half circle of a table of N (cell averages, so an integrable caustic does no harm):

        N^G(phi_j) = (1/pi) sum of N's cells within pi/2 of phi_j,

    linear between rows of theta_diff and columns of phi, and, for an eccentric fibre, between 7 values of the index
    that TRT sees.

    Args:
        bsdf: what is approximated; a single fibre without gradients.
    """

    def __init__(self, bsdf: DualScattering) -> None:
        super().__init__(bsdf.fiber, bsdf.d_f, bsdf.d_b, bsdf.model, bsdf.convention, terms=bsdf.terms)
        with torch.no_grad():
            self._mean_shares = QuickShares(self._fiber(torch.float64), self.convention)
            self._table = self._direct_table()
            self._mean_table = _half_circle_means(self._table)

    def lobe_shares(self, theta_in: Tensor) -> tuple[Tensor, Tensor]:
        """As `DualScattering.lobe_shares`, from the table."""
        front, back = self._mean_shares(theta_in.to(torch.float64))
        return front.to(theta_in.dtype), back.to(theta_in.dtype)

    def azimuthal_scattered(
        self, theta_diff: Tensor, phi: Tensor, *, phi_h: Tensor | None = None, lobes: tuple[int, ...] = ALL_LOBES
    ) -> Tensor:
        """N^G of R, TT, TRT (those of `lobes`), `[..., len(lobes), C]`, from the table."""
        if self._printed_shapes or self.convention.scattered_azimuth == "constant":
            return super().azimuthal_scattered(theta_diff, phi, phi_h=phi_h, lobes=lobes)
        value = self._interpolated(theta_diff, phi, phi_h)
        return value if lobes == ALL_LOBES else value[..., list(lobes), :]

    def _interpolated(self, theta_diff: Tensor, phi: Tensor, phi_h: Tensor | None) -> Tensor:
        theta_diff, phi = torch.broadcast_tensors(theta_diff, wrap(phi).abs())
        table = self._mean_table.to(theta_diff)
        slices, rows, columns = table.shape[:3]
        x, y = theta_diff.abs() * ((rows - 1) / HALF_PI), phi * ((columns - 1) / math.pi)
        flat, tail = table.reshape(slices * rows * columns, -1), table.shape[3:]
        row, column = (z.detach().to(torch.int64).clamp(0, n - 2) for z, n in ((x, rows), (y, columns)))

        def plane(first: Any) -> Tensor:
            at = ((first * rows + row) * columns + column).reshape(-1)
            share = (y - column).clamp(0.0, 1.0).reshape(-1, 1)
            ends = [
                torch.lerp(flat.index_select(0, at + k), flat.index_select(0, at + k + 1), share) for k in (0, columns)
            ]
            return torch.lerp(ends[0], ends[1], (x - row).clamp(0.0, 1.0).reshape(-1, 1))

        if slices == 1:
            return plane(0).reshape(*phi.shape, *tail)
        angle = torch.zeros_like(phi) if phi_h is None else phi_h.expand_as(phi)
        z = (torch.cos(2 * angle) + 1) * ((slices - 1) / 2)
        low = z.detach().to(torch.int64).clamp(0, slices - 2)
        share = (z - low).clamp(0.0, 1.0).reshape(-1, 1)
        return torch.lerp(plane(low), plane(low + 1), share).reshape(*phi.shape, *tail)

    def _direct_table(self) -> Tensor:
        """Cell averages of N about nodes of theta_diff and |phi|, `[slices, rows, columns + 1, 3, C]`; slices at
        equidistant cos(2 phi_h)."""
        fiber = self._fiber(torch.float64)
        narrow = float(fiber.caustic_width.min())
        columns = int(min(_COLUMNS[1], max(_COLUMNS[0], math.ceil(math.pi / (narrow / 8)))))
        columns += columns % 2  # a quarter circle is a whole number of cells
        theta = torch.linspace(0.0, HALF_PI, _ROWS, dtype=torch.float64)
        step = math.pi / columns
        phi = torch.arange(columns + 1, dtype=torch.float64) * step
        slices = 1 if fiber.is_round else _ORIENTATIONS
        angles = torch.acos(torch.linspace(-1.0, 1.0, max(slices, 2), dtype=torch.float64)) / 2
        offsets, weights = gauss_legendre(_SUBSAMPLES[slices > 1])
        parts = []
        for angle in angles[:slices]:
            total: Tensor | float = 0.0
            for offset, weight in zip(offsets, weights, strict=True):
                at = math.pi - (math.pi - (phi + 0.5 * step * offset).abs()).abs()
                value = azimuthal(fiber, theta[:, None], at[None, :], angle, self.model, self.convention.absorption)
                total = total + value * (weight / 2)
            parts.append(torch.as_tensor(total))
        return torch.stack(parts)

    def azimuth_laws(self, scattered: bool) -> list[FiberAzimuth]:
        """Laws of phi given theta_diff of R, TT, TRT, or of their N^G: norm over channels, averaged over orientations
        of the section.
        """
        table = self._mean_table if scattered else self._table
        if scattered and self.convention.scattered_azimuth == "constant":
            table = torch.ones_like(table)
        norm = torch.linalg.vector_norm(table, dim=-1)
        mean = torch.tensordot(_slice_weights(len(norm)), norm, dims=1)
        return [FiberAzimuth(mean[..., p].contiguous()) for p in range(3)]


def _half_circle_means(table: Tensor) -> Tensor:
    """(1/pi) int of N over the half circle about each column, from cell averages `[slices, rows, columns + 1, ...]`."""
    columns = table.shape[2] - 1
    whole = torch.cat([table, table[:, :, 1:-1].flip(2)], dim=2)  # cells about phi_j once around, N being even
    turned = torch.cat([whole] * 3, dim=2)
    sums = torch.cat([torch.zeros_like(turned[:, :, :1]), turned.cumsum(2)], dim=2)
    quarter, first = columns // 2, 2 * columns
    at = torch.arange(first, first + columns + 1)
    inner = sums.index_select(2, at + quarter) - sums.index_select(2, at - quarter + 1)
    ends = turned.index_select(2, at - quarter) + turned.index_select(2, at + quarter)
    return ((inner + ends / 2) / columns).contiguous()


def _slice_weights(slices: int) -> Tensor:
    """Weights of the slices in a mean over orientations: integrals of hat functions of cos(2 phi_h)."""
    if slices == 1:
        return torch.ones(1, dtype=torch.float64)
    angle = (torch.arange(512, dtype=torch.float64) + 0.5) * (math.pi / 512)
    z = (torch.cos(angle) + 1) * ((slices - 1) / 2)
    distance = (z[:, None] - torch.arange(slices, dtype=torch.float64)).abs()
    return (1 - distance).clamp_min(0.0).mean(0)


__all__ = ["QuickScattering", "QuickShares", "interpolate"]
