"""An integrand that is a user's own function."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from dsfit.arguments import check_directions
from dsfit.context import Context
from dsfit.errors import InputError
from dsfit.frame import HALF_PI


class FunctionIntegrand:
    """Any f(omega_i) on the sphere as the integrand of references, fits, estimates and checks.

    Args:
        function: `function(omega_i [*samples, *batch, 2], context [*batch]) -> [*samples, *batch, C]`: reflectance
            times radiance times cos(theta_i), per steradian of omega_i = (theta_i, phi_i) in the fibre's frame.
        channels: number C of its channels.
        inclinations: theta_i, radians, at which it peaks or has edges. Quadrature starts with panels that shrink
            towards them and sees peaks of 1e-4 rad there; one narrower than some degrees that is not named may be
            missed.
        azimuths: the same for the relative azimuth phi = phi_r - phi_i.
        is_even: whether f(theta_i, phi) = f(theta_i, -phi) in every context; halves the work of quadrature.

    Raises:
        InputError: points out of range; when called, directions that do not fit the context, or a result of another
            shape.

    Example:
        >>> import torch
        >>> import dsfit
        >>> cosine = dsfit.FunctionIntegrand(lambda omega, context: torch.cos(omega[..., :1]))
        >>> round(float(dsfit.reference(cosine, dsfit.Context(0.0)).value), 8)  # pi^2
        9.8696044
    """

    def __init__(
        self,
        function: Callable[[Tensor, Context], Tensor],
        *,
        channels: int = 1,
        inclinations: Sequence[float] = (),
        azimuths: Sequence[float] = (),
        is_even: bool = False,
    ) -> None:
        self.function, self.is_even = function, is_even
        if isinstance(channels, bool) or not isinstance(channels, int) or channels < 1:
            raise InputError("channels", channels, "an integer >= 1")
        self.channels = channels
        self._inclinations = _points("inclinations", inclinations, HALF_PI)
        self._azimuths = _points("azimuths", azimuths, math.pi)

    def __call__(self, omega_i: Tensor, context: Context) -> Tensor:
        check_directions(omega_i, context.batch_shape, "omega_i")
        value = self.function(omega_i, context)
        expected = (*torch.broadcast_shapes(omega_i.shape[:-1], context.batch_shape), self.channels)
        if not isinstance(value, Tensor) or tuple(value.shape) != expected:
            found = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
            raise InputError("integrand's result", found, f"a tensor of shape {expected}")
        return value

    def theta_breaks(self, context: Context) -> Tensor:
        """Panel ends in theta_i: every 22.5 degrees, and towards the points named."""
        even = torch.linspace(-HALF_PI, HALF_PI, 9, dtype=torch.float64)
        return torch.unique(torch.cat([even, _graded(self._inclinations, HALF_PI)]))

    def azimuth_edges(self, context: Context, theta_i: Tensor, *, coarse: bool = False) -> Tensor:
        """Panel ends in phi `[*theta_i, J]`: quarters of the circle, and towards the points named and, where the
        function is even, their mirror images."""
        quarters = torch.tensor([-math.pi, -HALF_PI, 0.0, HALF_PI, math.pi], dtype=torch.float64)
        named = _graded(self._azimuths, math.pi)
        points = torch.unique(torch.cat([quarters, named, -named] if self.is_even else [quarters, named]))
        return points.to(theta_i.dtype).expand(*theta_i.shape, -1)


def _graded(points: list[float], end: float) -> Tensor:
    """The points, and on either side of each ends of panels at a third of a radian and ever nearer."""
    at = torch.tensor(points, dtype=torch.float64)[:, None]
    steps = torch.cat([torch.zeros(1, dtype=torch.float64), 0.3 * 0.2 ** torch.arange(5, dtype=torch.float64)])
    return torch.cat([at - steps, at + steps]).clamp(-end, end).flatten()


def _points(name: str, values: Sequence[float], end: float) -> list[float]:
    points = [float(value) for value in values]
    if any(not abs(value) <= end for value in points):
        raise InputError(name, points, f"angles in [-{end:.6g}, {end:.6g}] radians")
    return points
