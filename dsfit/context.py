"""What is known when a direction is drawn."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from dsfit.errors import as_real, check_broadcast, check_range, common_dtype
from dsfit.frame import HALF_PI


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
        limit = torch.tensor(HALF_PI, dtype=dtype).item()
        check_range("context.theta_r", fields[0], -limit, limit)
        check_range("context.phi_r", fields[1])
        check_range("context.n", fields[2], 0.0)
        if v is None:
            share = (fields[2] == 0).to(dtype)
        else:
            share = check_range("context.v", as_real("context.v", v, dtype, device), 0.0, 1.0)
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
        return Context(function(self.theta_r), function(self.phi_r), function(self.n), function(self.v))

    def to(self, *args: Any, **kwargs: Any) -> Context:
        """The same context in another dtype or on another device (arguments of `Tensor.to`)."""
        return self._map(lambda x: x.to(*args, **kwargs))

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
