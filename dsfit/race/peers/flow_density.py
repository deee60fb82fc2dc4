"""A neural circular spline flow, conditional on the context, as a proposal; zuko is imported here alone."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from dsfit.arguments import check_directions, check_uniforms
from dsfit.context import Context
from dsfit.frame import HALF_PI, cos_inclination, wrap
from dsfit.proposals.base import Distribution, Proposal
from dsfit.proposals.mixture import MixtureDistribution
from dsfit.proposals.uniform import UniformSphere

FEATURES = 7


def features(context: Context) -> Tensor:
    """What the flow is conditional on, `[*batch, 7]`: inclination, depth, what is lit."""
    theta_r, n, v = context.theta_r, context.n, context.v
    columns = [
        theta_r / HALF_PI, torch.cos(theta_r), torch.sin(2 * theta_r), torch.log1p(n) / 3, n / (n + 4), v, torch.sqrt(v)
    ]  # fmt: skip
    return torch.stack(torch.broadcast_tensors(*columns), dim=-1)


class FlowDistribution(Distribution):
    """Directions by the inverse of the flow from a uniform point of the torus.

    The flow lives on the torus x = (2 theta_i + 2 theta_r, phi) mod 2 pi, in which the lobes stay where they are when
    the view tilts: `p(omega) = 2 q(x) / cos(theta_i)`. Autoregressive, so monotone in each uniform given those before.
    """

    dimension = 2

    def __init__(self, flow: torch.nn.Module, context: Context, given: Tensor) -> None:
        self.flow, self.context, self.given = flow, context, given
        self.batch_shape = context.batch_shape

    def select(self, take: Callable[[Tensor], Tensor]) -> FlowDistribution:
        given = torch.stack([take(x) for x in self.given.unbind(-1)], dim=-1)
        return FlowDistribution(self.flow, self.context._map(take), given)

    def _transform(self, shape: torch.Size) -> torch.distributions.Transform:
        return self.flow.transform(self.given.expand(*shape, FEATURES))

    def sample_with_log_prob(self, u: Tensor) -> tuple[Tensor, Tensor]:
        omega = self.sample(u)
        return omega, self.log_prob(omega)

    def sample(self, u: Tensor) -> Tensor:
        u = check_uniforms(u, self.dimension, self.batch_shape)
        x = self._transform(u.shape[:-1]).inv(math.pi * (2 * u[..., :2] - 1))
        theta_i = (0.5 * wrap(x[..., 0] - 2 * self.context.theta_r)).clamp(-HALF_PI, HALF_PI)
        return torch.stack([theta_i, wrap(self.context.phi_r - x[..., 1])], dim=-1)

    def log_prob(self, omega: Tensor) -> Tensor:
        check_directions(omega, self.batch_shape)
        theta_i, phi_i = omega.unbind(-1)
        first, second = wrap(2 * (theta_i + self.context.theta_r)), wrap(self.context.phi_r - phi_i)
        x = torch.stack(torch.broadcast_tensors(first, second), dim=-1)
        _, slope = self._transform(x.shape[:-1]).call_and_ladj(x)
        return slope + math.log(2) - 2 * math.log(2 * math.pi) - torch.log(cos_inclination(theta_i))


class FlowProposal(Proposal):
    """A neural circular spline flow (Rezende et al. 2020; Durkan et al. 2019) with a defensive share of the sphere.

    Args:
        transforms: autoregressive spline transforms one after the other.
        bins: of every spline. hidden: sizes of the hidden layers of their networks.
        defensive: share of the uniform sphere.
        seed: of the first weights.
    """

    def __init__(self, transforms: int, bins: int, hidden: tuple[int, ...], defensive: float, seed: int) -> None:
        super().__init__()
        import zuko

        with torch.random.fork_rng(devices=[]):  # zuko draws its first weights from the global generator
            torch.manual_seed(seed)
            options = {"transforms": transforms, "bins": bins, "hidden_features": hidden}
            self.flow = zuko.flows.NCSF(2, FEATURES, **options, activation=torch.nn.SiLU)
        self.defensive, self.sphere = defensive, UniformSphere()

    def bare(self, context: Context) -> FlowDistribution:
        """The flow without the defensive share."""
        return FlowDistribution(self.flow, context, features(context))

    def forward(self, context: Context) -> MixtureDistribution:
        shares = torch.tensor([1 - self.defensive, self.defensive], dtype=context.dtype)
        return MixtureDistribution([self.bare(context), self.sphere(context)], torch.log(shares))
