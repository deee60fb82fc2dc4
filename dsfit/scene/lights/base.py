"""What every light is: radiance as a function of omega_i, a proposal that samples it, where quadrature must break."""

from __future__ import annotations

import copy
import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, Self

import torch
from torch import Tensor, nn

from dsfit.context import Context
from dsfit.errors import InputError, as_real, check_finite
from dsfit.frame import HALF_PI, to_angles, to_vector, wrap
from dsfit.proposals.base import Distribution, Proposal


def check_rotation(rotation: Any) -> Tensor | None:
    """A rotation matrix `[*batch, 3, 3]` (world -> fibre) or None; raises `InputError` for anything else.

    Orthonormality is asked for to 1e-4, which float32 matrices meet.
    """
    if rotation is None:
        return None
    matrix = check_finite("rotation", as_real("rotation", rotation))
    if matrix.shape[-2:] != (3, 3):
        raise InputError("rotation", tuple(matrix.shape), "shape [..., 3, 3]")
    data = matrix.detach().to(torch.float64)
    defect = (data @ data.mT - torch.eye(3, dtype=data.dtype, device=data.device)).abs().amax()
    if defect > 1e-4 or (torch.linalg.det(data) < 0).any():
        raise InputError("rotation", matrix.detach().tolist(), "orthonormal matrices with determinant +1")
    return matrix


class Light(nn.Module, ABC):
    """Incident radiance L(omega_i), in the fibre frame: `light(omega_i [..., 2]) -> [..., C]`, in the dtype of omega_i.

    Args:
        rotation: matrix R `[3, 3]`, or `[*batch, 3, 3]` with one fibre frame per context, that takes directions from
            the frame in which the light was described ("world") to the fibre frame: `w_fibre = R w_world`. None: the
            two are the same. Batch dimensions are aligned on the right with those of omega_i, as those of a `Context`
            are.
    """

    channels: int
    """C, the number of colour channels."""
    rotation: Tensor | None
    batched: dict[str, int] = {"rotation": 2}
    """Buffers that may have one value per context, and how many dimensions one value has."""

    def __init__(self, rotation: Any = None) -> None:
        super().__init__()
        self.register_buffer("rotation", check_rotation(rotation))

    @abstractmethod
    def forward(self, omega_i: Tensor) -> Tensor:
        """Radiance `[..., C]` from directions `[..., 2]`."""

    @abstractmethod
    def proposal(self) -> Proposal:
        """A proposal that samples the light by the mean of its channels."""

    @property
    @abstractmethod
    def label(self) -> str:
        """A short name for tables and plots."""

    def breakpoints(self) -> tuple[list[float], list[float]]:
        """Inclinations theta_i in (-pi/2, pi/2) and absolute azimuths phi_i in (-pi, pi] where panels should break.

        Sorted; they bracket peaks and mark kinks. Empty lists: the light is smooth.

        Raises:
            InputError: the light has a batch of rotations, and so no single list.
        """
        return [], []

    def power(self) -> Tensor:
        """What arrives from all directions together, `int mean_c L_c domega`, `[]` or one per context `[*batch]`.

        By this a `TotalLight` shares out its samples; a light that has no closed form gives a close approximation.

        Raises:
            InputError: the light does not know it.
        """
        raise InputError("light", type(self).__name__, "a light that knows its power")

    def covers(self) -> bool:
        """Whether the proposal's density is certainly above zero in every direction; False where that is not known."""
        return False

    def azimuth_edges(self, theta_i: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Absolute azimuths phi_i where the light jumps, peaks or has a kink at inclinations `[...]`.

        Returns:
            centre, `[J]`; offsets from it, `[..., J]`, in [-pi, pi], continuous in theta_i between the breakpoints; and
            the largest that an offset can be, `[J]`. The azimuths are `centre + offset`, not wrapped. By default the
            breakpoints in phi, whatever the inclination.
        """
        centre = theta_i.new_tensor(self.breakpoints()[1])
        return centre, theta_i.new_zeros(()).expand(*theta_i.shape, len(centre)), torch.zeros_like(centre)

    def rotated(self, rotation: Any) -> Self:
        """The same light in another frame, sharing all tables: one light serves every fibre of a scene."""
        return self._with_buffers(rotation=check_rotation(rotation))

    def placed(self, position: Tensor, rotation: Tensor) -> Self:
        """The light as points `[*batch, 3]` of the world with fibre frames `[*batch, 3, 3]` see it.

        Lights at infinity look the same from everywhere, so only their rotation matters; lights nearby override this.
        """
        return self.rotated(rotation)

    def _with_buffers(self, **buffers: Tensor | None) -> Self:
        other = copy.copy(self)
        other._buffers = {**self._buffers, **buffers}
        return other

    def taken(self, batch_shape: torch.Size, index: Tensor) -> Self | None:
        """The light of the contexts `index` `[N]` of a flattened batch; None if it has values for a larger batch."""
        chosen: dict[str, Tensor | None] = {}
        for name, dimensions in self.batched.items():
            value = self._buffers.get(name)
            if value is None or value.dim() == dimensions:
                continue
            batch, one = value.shape[: value.dim() - dimensions], value.shape[value.dim() - dimensions :]
            if torch.broadcast_shapes(batch, batch_shape) != batch_shape:
                return None
            chosen[name] = value.expand(*batch_shape, *one).reshape(-1, *one)[index]
        return self._with_buffers(**chosen) if chosen else self

    def world_vector(self, omega_i: Tensor) -> Tensor:
        """Unit vectors `[..., 3]` in the frame of the light's description."""
        vector = to_vector(omega_i)
        if self.rotation is None:
            return vector
        return _turned(vector, self.rotation.to(vector).mT)

    def to_fibre(self, vector: Tensor) -> Tensor:
        """Vectors `[..., 3]` from the light's frame into the fibre frame."""
        if self.rotation is None:
            return vector
        return _turned(vector, self.rotation.to(vector))

    def single_frame(self) -> None:
        """Raise `InputError` if there is a batch of rotations."""
        if self.rotation is not None and self.rotation.dim() > 2:
            raise InputError(
                "rotation", tuple(self.rotation.shape), "one 3 x 3 matrix to ask a light for its breakpoints"
            )

    def extra_repr(self) -> str:
        return f"{self.label}, channels={self.channels}"


def _turned(vector: Tensor, matrix: Tensor) -> Tensor:
    """Matrices `[*batch, 3, 3]` times vectors `[..., 3]`; a batch by its elements: of such small ones matmul copies and
    multiplies one by one."""
    if matrix.dim() == 2:
        return vector @ matrix.mT
    x, y, z = vector.unbind(-1)
    return torch.stack([x * m[..., 0] + y * m[..., 1] + z * m[..., 2] for m in matrix.unbind(-2)], dim=-1)


def tidy(thetas: list[float], phis: list[float]) -> tuple[list[float], list[float]]:
    """Sorted, distinct (to 1e-12) breakpoints: theta inside (-pi/2, pi/2), phi wrapped."""

    def distinct(values: list[float]) -> list[float]:
        kept: list[float] = []
        for value in sorted(values):
            if not kept or value - kept[-1] > 1e-12:
                kept.append(value)
        return kept

    wrapped = [wrap(torch.tensor(phi, dtype=torch.float64)).item() for phi in phis]
    return distinct([theta for theta in thetas if abs(theta) < HALF_PI]), distinct(wrapped)


def around(direction: Tensor, width: float, multiples: tuple[float, ...]) -> tuple[list[float], list[float]]:
    """Breakpoints at a peak in the fibre-frame direction `[3]` and at multiples of its angular width on both sides."""
    theta, phi = (x.item() for x in to_angles(direction.detach().to(torch.float64)).unbind(-1))
    thetas, phis = [theta], [phi]
    for step in (m * width for m in multiples):
        if step < math.pi:
            thetas += [theta - step, theta + step]
        # A cap of angular radius r around inclination theta spans asin(sin r / cos theta) in azimuth, and all of it
        # past the pole.
        if step < HALF_PI and math.sin(step) < math.cos(theta):
            spread = math.asin(math.sin(step) / math.cos(theta))
            phis += [phi - spread, phi + spread]
    return tidy(thetas, phis)


class LightDistribution(Distribution):
    """A distribution that belongs to a light and depends on the context only through its batch shape."""

    def __init__(self, light: Light, context: Context) -> None:
        self.light = light
        self.context = context
        self.batch_shape = context.batch_shape

    def select(self, take: Callable[[Tensor], Tensor]) -> Self | None:
        count = self.batch_shape.numel()
        index = take(torch.arange(count, device=self.context.device).reshape(self.batch_shape))
        light = self.light.taken(self.batch_shape, index)
        return None if light is None else type(self)(light, self.context._map(take))

    def sample_with_log_prob(self, u: Tensor) -> tuple[Tensor, Tensor]:
        # The density of the returned direction, not of the one before rounding: what other strategies of a MIS estimate
        # will see.
        omega = self.sample(u)
        return omega, self.log_prob(omega)


class LightProposal(Proposal):
    """Directions by a light's own law, whatever the context."""

    def __init__(self, light: Light, law: type[LightDistribution]) -> None:
        super().__init__()
        self.light, self.law = light, law

    def forward(self, context: Context) -> LightDistribution:
        return self.law(self.light, context)
