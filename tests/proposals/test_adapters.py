"""Adapters: changes of variables, module distributions, flows, and what they refuse."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor, nn
from torch.distributions import Independent, Normal, TransformedDistribution, Uniform, VonMises
from torch.distributions.transforms import AffineTransform, TanhTransform

from dsfit.context import Context
from dsfit.errors import InputError
from dsfit.proposals import FromDensity, TorchDistribution
from dsfit.proposals.adapters import SPACES, from_omega, to_omega


def uniforms(*shape: int) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(4), dtype=torch.float64).clamp(1e-6, 1 - 1e-6)


@pytest.mark.parametrize("space", SPACES)
def test_spaces_round_trip(space: str) -> None:
    omega = torch.stack([(uniforms(50) - 0.5) * 3.1, (uniforms(50) - 0.5) * 6.2], dim=-1)
    phi_r = torch.tensor(2.0, dtype=torch.float64)
    point, _ = from_omega(space, omega, phi_r)
    torch.testing.assert_close(to_omega(space, point, phi_r), omega, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("space", ["square", "plane"])
def test_uniform_square_is_the_uniform_sphere(space: str) -> None:
    if space == "square":
        base = Independent(Uniform(torch.zeros(2).double(), torch.ones(2).double()), 1)
    else:  # the logistic law
        base = TransformedDistribution(
            Uniform(torch.zeros(2).double(), torch.ones(2).double()),
            torch.distributions.transforms.SigmoidTransform().inv,
        )
        base = Independent(base, 1)
    proposal = TorchDistribution(base, space)
    omega, log_prob = proposal(Context(0.3, 0.5)).sample_with_log_prob(uniforms(100, 2))
    torch.testing.assert_close(log_prob, torch.full_like(log_prob, -math.log(4 * math.pi)), rtol=1e-9, atol=1e-9)
    assert omega.shape == (100, 2)


class ByContext(nn.Module):
    """A learnable distribution of the context: a Gaussian in the plane whose mean follows theta_r."""

    def __init__(self) -> None:
        super().__init__()
        self.gain = nn.Parameter(torch.tensor(0.5, dtype=torch.float64))

    def forward(self, context: Context) -> Independent:
        mean = torch.stack([-self.gain * context.theta_r, torch.zeros_like(context.theta_r)], dim=-1)
        return Independent(Normal(mean, torch.ones_like(mean)), 1)


def test_module_distribution_is_learned_and_depends_on_the_context() -> None:
    proposal = TorchDistribution(ByContext(), "plane")
    assert [name for name, _ in proposal.named_parameters()] == ["distribution.gain"]
    context = Context([0.0, 1.0])
    distribution = proposal(context)
    omega, log_prob = distribution.sample_with_log_prob(uniforms(30, 2, 2))
    (gradient,) = torch.autograd.grad(log_prob.sum(), proposal.distribution.gain)
    assert gradient.isfinite()
    assert float(omega[:, 1, 0].detach().mean()) < float(omega[:, 0, 0].detach().mean())


class Flow:
    """The shape of a zuko flow: `base`, `transform` (from data to base) and `log_prob`."""

    def __init__(self) -> None:
        self.base = Independent(Normal(torch.zeros(2).double(), torch.ones(2).double()), 1)
        self.transform = AffineTransform(0.3, 2.0)

    def log_prob(self, x: Tensor) -> Tensor:
        return self.base.log_prob(self.transform(x)) + 2 * math.log(2)


def test_flow_with_base_and_transform() -> None:
    same = Independent(Normal(torch.full((2,), -0.15).double(), torch.full((2,), 0.5).double()), 1)
    u = uniforms(40, 2)
    got, expected = (TorchDistribution(d, "plane")(Context(0.1)).sample_with_log_prob(u) for d in (Flow(), same))
    for a, b in zip(got, expected, strict=True):
        torch.testing.assert_close(a, b)


def test_transformed_distribution_over_angles() -> None:
    scale = torch.tensor([math.pi / 2, math.pi], dtype=torch.float64)
    squashed = TransformedDistribution(
        Normal(torch.zeros(2).double(), torch.ones(2).double()), [TanhTransform(), AffineTransform(0.0, scale)]
    )
    distribution = TorchDistribution(Independent(squashed, 1))(Context(0.2, 1.0))
    omega, log_prob = distribution.sample_with_log_prob(uniforms(100, 2))
    torch.testing.assert_close(distribution.log_prob(omega), log_prob)
    assert log_prob.isfinite().all()


def test_refusals() -> None:
    with pytest.raises(InputError, match="space"):
        TorchDistribution(Flow(), "disk")
    with pytest.raises(InputError, match="dimension"):
        FromDensity(lambda c, x: x[..., 0], lambda c, u: u, dimension=0)
    no_inverse = Independent(VonMises(torch.zeros(2).double(), torch.ones(2).double()), 1)
    proposal = TorchDistribution(no_inverse)
    assert proposal(Context(0.0)).log_prob(torch.zeros(2).double()).isfinite()
    with pytest.raises(InputError, match="icdf"):
        proposal(Context(0.0)).sample(uniforms(3, 2))
