"""What is known when a direction is drawn."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

from dsfit.arguments import check_inside
from dsfit.errors import as_real, check_broadcast, common_dtype
from dsfit.frame import HALF_PI

_LIMIT = {dtype: torch.tensor(HALF_PI, dtype=dtype).item() for dtype in (torch.float64, torch.float32)}


@dataclass(frozen=True, init=False)
class Context:
    """Shading context: viewing direction and scattering hints, a batch of them at once.

    Args:
        theta_r: inclination of the viewing direction, radians, |theta_r| <= pi/2.
        phi_r: azimuth of the viewing direction, radians.
        n: hint for the number of scattering fibres towards the light, real and >= 0.
        v: hint for the directly lit share in [0, 1]; left out, it is 1 where n = 0 and 0 elsewhere.
        dtype: dtype of all fields; left out, that of the first tensor given, else float64.

    All fields are broadcast to one batch shape. Context dimensions are the last ones of any sample: `omega` drawn for
    a context of shape `[*batch]` has shape `[*samples, *batch, 2]`.

    Raises:
        InputError: a field is not a real number, not finite or out of range, shapes do not broadcast, another dtype.

    Example:
        >>> import dsfit
        >>> context = dsfit.Context([0.0, 0.5], n=[[0.0], [3.0]])
        >>> context.batch_shape
        torch.Size([2, 2])
        >>> context.v.tolist()
        [[1.0, 1.0], [0.0, 0.0]]
    """

    theta_r: Tensor
    phi_r: Tensor
    n: Tensor
    v: Tensor

    def __init__(
        self, theta_r: Any, phi_r: Any = 0.0, n: Any = 0.0, v: Any = None, *, dtype: torch.dtype | None = None
    ) -> None:
        dtype, device = common_dtype("context.dtype", dtype, (theta_r, phi_r, n, v))
        given = {"theta_r": theta_r, "phi_r": phi_r, "n": n}
        fields = [as_real(f"context.{name}", value, dtype, device) for name, value in given.items()]
        check_inside("context.theta_r", fields[0], -_LIMIT[dtype], _LIMIT[dtype])
        check_inside("context.phi_r", fields[1], -math.inf, math.inf)
        check_inside("context.n", fields[2], 0.0, math.inf)
        if v is None:
            share = (fields[2] == 0).to(dtype)
        else:
            share = check_inside("context.v", as_real("context.v", v, dtype, device), 0.0, 1.0)
        check_broadcast(theta_r=fields[0], phi_r=fields[1], n=fields[2], v=share)
        for name, value in zip(("theta_r", "phi_r", "n", "v"), torch.broadcast_tensors(*fields, share), strict=True):
            object.__setattr__(self, name, value)

    @property
    def batch_shape(self) -> torch.Size:
        """Shape of every field."""
        return self.theta_r.shape

    @property
    def dtype(self) -> torch.dtype:
        """dtype of every field."""
        return self.theta_r.dtype

    @property
    def device(self) -> torch.device:
        """Device of every field."""
        return self.theta_r.device

    def _map(self, function: Any) -> Context:
        """The context with a function that changes no number applied to every field; so nothing is checked again."""
        result = object.__new__(type(self))
        for field in fields(self):
            object.__setattr__(result, field.name, function(getattr(self, field.name)))
        return result

    def to(self, *args: Any, **kwargs: Any) -> Context:
        """The same context in another dtype or on another device (arguments of `Tensor.to`)."""
        return Context(*(x.to(*args, **kwargs) for x in (self.theta_r, self.phi_r, self.n, self.v)))

    def reshape(self, *shape: int) -> Context:
        """The same contexts in another batch shape."""
        return self._map(lambda x: x.reshape(*shape))

    def expand(self, *shape: int) -> Context:
        """The contexts broadcast to a larger batch shape."""
        return self._map(lambda x: x.expand(*shape))

    def __getitem__(self, index: Any) -> Context:
        return self._map(lambda x: x[index])

    def __len__(self) -> int:
        return len(self.theta_r)
