"""What every proposal is: a module that, given the shading context, returns a distribution over incident directions.

Directions factor as `p(omega_i) = p_theta(theta_i) p_phi(phi | theta_i) / cos(theta_i)` per steradian, so most
proposals are a `Product` of a longitudinal law (per radian of theta_i) and an azimuthal law (per radian of the
relative azimuth phi).
"""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Self

import torch
from torch import Tensor, nn
from torch.func import functional_call, grad, jacfwd, vmap

from dsfit.arguments import check_directions, check_uniforms
from dsfit.context import Context
from dsfit.frame import cos_inclination, wrap
from dsfit.proposals.parameters import Constrained, constrained_values


class Selectable:
    """Something that may be restricted to some elements of the context batch.

    Optional: where `select` returns None, as here, a mixture computes the component everywhere instead of only where
        it was chosen.
    """

    def select(self, take: Callable[[Tensor], Tensor]) -> Self | None:
        """The same law with `take` applied to every tensor over the context batch; None if that is not supported."""
        return None


class BatchFields(Selectable):
    """`select` for dataclasses whose every tensor field broadcasts to the context batch."""

    def select(self, take: Callable[[Tensor], Tensor]) -> Self | None:
        assert dataclasses.is_dataclass(self)
        changes: dict[str, object] = {}
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if isinstance(value, Tensor):
                changes[field.name] = take(value)
            elif isinstance(value, Selectable):
                changes[field.name] = value.select(take)
                if changes[field.name] is None:
                    return None
        return dataclasses.replace(self, **changes)


class Learnable:
    """Mixin of proposals and laws."""

    def constrained(self) -> Constrained:
        """Every learnable value by dotted name as (value, low, high), so that a fit can report which sit at a bound."""
        assert isinstance(self, nn.Module)
        return constrained_values(self)


class Distribution(Selectable, ABC):
    """A distribution over omega_i for a batch of contexts.

    Shapes: uniforms `u` are `[*samples, *batch, dimension]` in the open interval (0, 1); directions `[*samples,
        *batch, 2]`.
    """

    dimension: int
    """How many uniform numbers one direction takes."""
    batch_shape: torch.Size
    """Shape of the context batch."""

    @abstractmethod
    def sample_with_log_prob(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """Directions `[..., 2]` and their log density per steradian `[...]`."""

    @abstractmethod
    def log_prob(self, omega: Tensor) -> Tensor:
        """Log density per steradian `[...]` at directions `[..., 2]`; -inf where the density is zero."""

    def sample(self, u: Tensor) -> Tensor:
        """Directions `[..., 2]` by a map that is differentiable in `u` and in the parameters almost everywhere."""
        return self.sample_with_log_prob(u)[0]


class Proposal(Learnable, nn.Module, ABC):
    """`proposal(context)` returns a `Distribution`."""

    @abstractmethod
    def forward(self, context: Context) -> Distribution:
        """The distribution over omega_i for these contexts."""

    def log_prob_with_jacobian(self, context: Context, omega: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """`log p(omega)` `[...]` and its derivative `[..., *parameter]` in every parameter by name; detached.

        What Gauss-Newton over many directions asks for. For one context the derivative is taken in reverse mode
        direction by direction, vectorised by vmap, which costs about as much as five evaluations whatever the number of
        parameters; for a batch of contexts in forward mode. It is 0 where p is 0.
        """
        parameters = {name: value.detach() for name, value in self.named_parameters()}
        if not parameters:
            with torch.no_grad():
                return self(context).log_prob(omega), {}

        def log_prob(values: dict[str, Tensor], direction: Tensor) -> tuple[Tensor, Tensor]:
            found = functional_call(self, values, (context,)).log_prob(direction)
            return torch.where(found.isinf(), 0.0, found), found

        if len(context.batch_shape):
            jacobian, value = jacfwd(log_prob, has_aux=True)(parameters, omega)
            return value, jacobian
        flat = omega.reshape(-1, omega.shape[-1])
        jacobian, value = vmap(grad(log_prob, has_aux=True), in_dims=(None, 0))(parameters, flat)
        shape = omega.shape[:-1]
        return value.reshape(shape), {name: x.reshape(*shape, *x.shape[1:]) for name, x in jacobian.items()}


class LongitudinalDistribution(Selectable, ABC):
    """A law of theta_i on [-pi/2, pi/2] per radian, for a batch of contexts; takes one uniform."""

    @abstractmethod
    def sample(self, u: Tensor) -> Tensor:
        """theta_i `[...]` by inverse CDF from uniforms `[...]`."""

    @abstractmethod
    def log_prob(self, theta_i: Tensor) -> Tensor:
        """Log density per radian of theta_i; its exponential integrates to 1 over [-pi/2, pi/2]."""


class AzimuthalDistribution(Selectable, ABC):
    """A law of the relative azimuth phi in [-pi, pi], possibly given theta_i; per radian."""

    dimension: int = 1

    @abstractmethod
    def sample(self, u: Tensor, theta_i: Tensor) -> Tensor:
        """phi `[...]` from uniforms `[..., dimension]`."""

    @abstractmethod
    def log_prob(self, phi: Tensor, theta_i: Tensor) -> Tensor:
        """Log density per radian of phi, given theta_i."""


class Longitudinal(Learnable, nn.Module, ABC):
    """`law(context)` returns a `LongitudinalDistribution`."""

    @abstractmethod
    def forward(self, context: Context) -> LongitudinalDistribution:
        """The law of theta_i for these contexts."""


class Azimuthal(Learnable, nn.Module, ABC):
    """`law(context)` returns an `AzimuthalDistribution`; `dimension` says how many uniforms it takes."""

    dimension: int = 1

    @abstractmethod
    def forward(self, context: Context) -> AzimuthalDistribution:
        """The law of phi for these contexts."""


class ProductDistribution(Distribution):
    """theta_i by one law, then phi given theta_i by another: `p = p_theta p_phi / cos(theta_i)`."""

    def __init__(
        self, context: Context, longitudinal: LongitudinalDistribution, azimuthal: AzimuthalDistribution
    ) -> None:
        self.context, self.longitudinal, self.azimuthal = context, longitudinal, azimuthal
        self.dimension = 1 + azimuthal.dimension
        self.batch_shape = context.batch_shape

    def with_longitudinal(self, longitudinal: LongitudinalDistribution) -> ProductDistribution:
        """The same distribution with another law of theta_i."""
        return ProductDistribution(self.context, longitudinal, self.azimuthal)

    def select(self, take: Callable[[Tensor], Tensor]) -> ProductDistribution | None:
        longitudinal, azimuthal = self.longitudinal.select(take), self.azimuthal.select(take)
        if longitudinal is None or azimuthal is None:
            return None
        return ProductDistribution(self.context._map(take), longitudinal, azimuthal)

    def _log_prob(self, theta_i: Tensor, phi: Tensor) -> Tensor:
        log_theta, log_phi = self.longitudinal.log_prob(theta_i), self.azimuthal.log_prob(phi, theta_i)
        return log_theta + log_phi - torch.log(cos_inclination(theta_i))

    def sample_with_log_prob(self, u: Tensor) -> tuple[Tensor, Tensor]:
        u = check_uniforms(u, self.dimension, self.batch_shape)
        theta_i = self.longitudinal.sample(u[..., 0])
        phi = self.azimuthal.sample(u[..., 1 : self.dimension], theta_i)
        phi_i = wrap(self.context.phi_r - phi)
        return torch.stack(torch.broadcast_tensors(theta_i, phi_i), dim=-1), self._log_prob(theta_i, phi)

    def sample(self, u: Tensor) -> Tensor:
        u = check_uniforms(u, self.dimension, self.batch_shape)
        theta_i = self.longitudinal.sample(u[..., 0])
        phi_i = wrap(self.context.phi_r - self.azimuthal.sample(u[..., 1 : self.dimension], theta_i))
        return torch.stack(torch.broadcast_tensors(theta_i, phi_i), dim=-1)

    def log_prob(self, omega: Tensor) -> Tensor:
        check_directions(omega, self.batch_shape)
        return self._log_prob(omega[..., 0], wrap(self.context.phi_r - omega[..., 1]))


class Product(Proposal):
    """Proposal from a longitudinal and an azimuthal law."""

    def __init__(self, longitudinal: Longitudinal, azimuthal: Azimuthal) -> None:
        super().__init__()
        self.longitudinal, self.azimuthal = longitudinal, azimuthal

    def forward(self, context: Context) -> Distribution:
        return ProductDistribution(context, self.longitudinal(context), self.azimuthal(context))

    def log_prob_with_jacobian(self, context: Context, omega: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """As for any proposal; where the azimuth has nothing to learn, only the longitudinal law is differentiated."""
        if any(True for _ in self.azimuthal.parameters()) or len(context.batch_shape):
            return super().log_prob_with_jacobian(context, omega)
        with torch.no_grad():
            value = self(context).log_prob(omega)
        parameters = {name: x.detach() for name, x in self.longitudinal.named_parameters()}
        if not parameters:
            return value, {}

        def log_prob(values: dict[str, Tensor], theta_i: Tensor, zero: Tensor) -> Tensor:
            found = functional_call(self.longitudinal, values, (context,)).log_prob(theta_i)
            return torch.where(zero, 0.0, found)

        flat = omega[..., 0].reshape(-1), value.isinf().reshape(-1)
        slopes = vmap(grad(log_prob), in_dims=(None, 0, 0))(parameters, *flat)
        shape = omega.shape[:-1]
        return value, {f"longitudinal.{name}": x.reshape(*shape, *x.shape[1:]) for name, x in slopes.items()}
