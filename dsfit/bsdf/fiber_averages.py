"""The averages of a fibre, or of each fibre of a batch, from tables that are made when first asked for."""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Any

import torch
from torch import Tensor

from dsfit.bsdf.averages import Averages, LobeShares, averages_from_shares
from dsfit.bsdf.conventions import Convention
from dsfit.bsdf.fiber import Fiber
from dsfit.bsdf.grey import one_channel
from dsfit.quadrature import PiecewiseChebyshev


class FiberAverages:
    """What a BSDF knows of its fibre's averages; `fiber`, `d_b` and `convention` are the BSDF's."""

    def __init__(self, fiber: Fiber, d_b: Tensor, convention: Convention) -> None:
        self.fiber, self.d_b, self.convention = fiber, d_b, convention
        self._fibers = {fiber.dtype: fiber}
        self.origin: Any = self  # the BSDF whose terms were changed to make this one: its tables serve both

    @property
    def channels(self) -> int:
        """Number of channels C."""
        return self.fiber.channels

    @one_channel
    def averages(self, theta_in: Tensor) -> Averages:
        """a_f, a_b, alpha, beta, A_b, Delta_b, sigma_b at inclination theta_in, each `[..., C]` (Zinke et al. 2008,
        eqs 6, 12-17).

        From raw attenuation integrals over offsets, whatever the azimuthal model: the averages count energy, which
        the treatment of the caustic only moves.
        """
        fiber, dtype = self._fiber(torch.float64), theta_in.dtype
        front, back = self.lobe_shares(theta_in.to(torch.float64))  # 1 - a_f^2 cancels: round at the end
        average = averages_from_shares(fiber, self.convention, front, back, self.d_b.to(torch.float64))
        return Averages(*(getattr(average, field.name).to(dtype) for field in dataclasses.fields(Averages)))

    @one_channel
    def lobe_shares(self, theta_in: Tensor) -> tuple[Tensor, Tensor]:
        """Forward and backward shares a_f^p, a_b^p of R, TT, TRT at theta_in, each `[..., 3, C]`; a_f and a_b are
        their sums.
        """
        fiber, dtype = self._fiber(torch.float64), theta_in.dtype
        theta_in = theta_in.to(torch.float64)  # panels next to grazing are narrower than float32 can tell
        if not fiber.batch_shape:
            return tuple(x.to(dtype) for x in self._shares(theta_in))  # type: ignore[return-value]
        shape = torch.broadcast_shapes(theta_in.shape, fiber.batch_shape)
        which = torch.arange(math.prod(fiber.batch_shape)).reshape(fiber.batch_shape).expand(shape)
        theta = theta_in.expand(shape)
        parts = []
        for half in range(2):
            value = theta.new_zeros(*shape, 3, self.channels)
            for k, table in enumerate(self._shares_of_batch):
                here = which == k
                value = value.index_put((here,), table(theta[here])[half])
            parts.append(value.to(dtype))
        return parts[0], parts[1]

    @property
    def share_series(self) -> PiecewiseChebyshev:
        """a_f^p and a_b^p over cos(theta_in) as piecewise Chebyshev series of 2 x 3 x C components, of one fibre."""
        return self._shares.series

    def _fiber(self, dtype: torch.dtype) -> Fiber:
        if dtype not in self._fibers:
            self._fibers[dtype] = self.fiber.to(dtype)
        return self._fibers[dtype]

    def _tables(self, fiber: Fiber) -> LobeShares:
        return LobeShares(fiber, self.convention)

    @property
    def _shares(self) -> LobeShares:
        if self.fiber.requires_grad:  # a graph serves one backward pass
            return self._tables(self._fiber(torch.float64))
        return self._cached_shares

    @functools.cached_property
    def _cached_shares(self) -> LobeShares:
        if self.origin is not self:
            return self.origin._cached_shares
        return self._tables(self._fiber(torch.float64))

    @property
    def _shares_of_batch(self) -> list[LobeShares]:
        if self.fiber.requires_grad:
            return self._build_batch()
        return self._cached_batch

    @functools.cached_property
    def _cached_batch(self) -> list[LobeShares]:
        if self.origin is not self:
            return self.origin._cached_batch
        return self._build_batch()

    def _build_batch(self) -> list[LobeShares]:
        fiber, shape = self._fiber(torch.float64), self.fiber.batch_shape
        rows = {
            name: value.expand(*shape, *value.shape[-1:]).reshape(-1, value.shape[-1])
            if name in ("sigma_a", "alpha", "beta")
            else value.expand(shape).reshape(-1)
            for name, value in fiber.parameters().items()
        }
        return [self._tables(Fiber(**{k: x[i] for k, x in rows.items()})) for i in range(math.prod(shape))]
