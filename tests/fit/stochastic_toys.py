"""A mixture of two lobes, a light that it can nearly match, and fine nodes to judge by."""

from __future__ import annotations

import torch

from dsfit.context import Context
from dsfit.proposals import Mixture, Product, UniformAzimuth
from dsfit.proposals.split_lobe import SplitGaussianLobe
from tests.fit.toys import nodes

ONE = Context(0.4)


def lobes(shift: float = 0.03, width: float = 0.12, weights: tuple[float, float] = (1.0, 1.0)) -> Mixture:
    """Two lobes in theta_h and a defensive share: 8 parameters."""
    parts = [Product(SplitGaussianLobe(m + shift, width, 1.3 * width), UniformAzimuth()) for m in (-0.3, 0.3)]
    return Mixture(parts, weights, 0.02)


TRUTH = lobes(0.0, 0.1, (2.0, 1.0))


def light(omega: torch.Tensor, context: Context) -> torch.Tensor:
    """Three channels; |F| is 7 times the density of `TRUTH`."""
    density = TRUTH(context).log_prob(omega).exp().detach()
    return 7 * density[..., None] * torch.tensor([2.0, 2.0, 1.0], dtype=omega.dtype) / 3


OMEGA, WEIGHT = nodes(160)


@torch.no_grad()
def excess_of(proposal: torch.nn.Module, context: Context = ONE, factor: torch.Tensor | float = 1.0) -> float:
    """M / N^2 - 1 for sqrt(factor) |F|, by quadrature."""
    length = light(OMEGA, context).norm(dim=-1) * factor**0.5
    density = proposal(context).log_prob(OMEGA).exp()
    return float((WEIGHT * length.square() / density).sum() / (WEIGHT * length).sum().square()) - 1
