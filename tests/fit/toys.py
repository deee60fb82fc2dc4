"""A small proposal of our own and its nodes: a mixture over (theta, phi) with density in plain torch."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor, nn

from dsfit.context import Context

HALF_PI = math.pi / 2


class ToyDistribution:
    def __init__(self, log_share: Tensor, centre: Tensor, width: Tensor, phi: Tensor, spread: Tensor, defensive: float):
        self.args = log_share, centre, width, phi, spread
        self.defensive = defensive

    def log_prob(self, omega: Tensor) -> Tensor:
        log_share, centre, width, phi0, spread = self.args
        theta, phi = omega[..., 0, None], omega[..., 1, None]
        z = torch.special.ndtr((HALF_PI - centre) / width) - torch.special.ndtr((-HALF_PI - centre) / width)
        log_theta = -0.5 * ((theta - centre) / width) ** 2 - torch.log(width * z) - 0.5 * math.log(2 * math.pi)
        shift = 2 * math.pi * torch.arange(-3, 4, dtype=omega.dtype)
        images = ((phi - phi0)[..., None] + shift) / spread[..., None]
        log_phi = torch.logsumexp(-0.5 * images**2, -1) - torch.log(spread) - 0.5 * math.log(2 * math.pi)
        lobes = torch.logsumexp(log_share + log_theta + log_phi, -1) - torch.log(torch.cos(omega[..., 0]))
        if not self.defensive:
            return lobes
        sphere = torch.full_like(lobes, math.log(self.defensive / (4 * math.pi)))
        return torch.logaddexp(math.log1p(-self.defensive) + lobes, sphere)


class Toy(nn.Module):
    """K lobes, 5 K parameters; the centre of a lobe moves with theta_r, so that contexts differ."""

    def __init__(self, centres: list[float], defensive: float = 0.05, learn_shares: bool = True) -> None:
        super().__init__()
        k = len(centres)
        new = torch.float64
        self.logits = nn.Parameter(torch.zeros(k, dtype=new), requires_grad=learn_shares)
        self.centre = nn.Parameter(torch.tensor(centres, dtype=new))
        self.log_width = nn.Parameter(torch.full((k,), math.log(0.5), dtype=new))
        self.phi = nn.Parameter(torch.linspace(-1.0, 1.0, k + 2, dtype=new)[1:-1].clone())
        self.log_spread = nn.Parameter(torch.full((k,), math.log(0.8), dtype=new))
        self.defensive = defensive

    def forward(self, context: Context) -> ToyDistribution:
        moved = self.centre - 0.2 * context.theta_r[..., None]
        log_share = torch.log_softmax(self.logits, -1)
        return ToyDistribution(log_share, moved, self.log_width.exp(), self.phi, self.log_spread.exp(), self.defensive)

    def constrained(self) -> dict:
        return {"width": (self.log_width.exp(), 1e-3, 10.0), "phi": (self.phi, -math.pi, math.pi)}


def nodes(count: int = 40) -> tuple[Tensor, Tensor]:
    """Gauss-Legendre in theta times equidistant in phi: omega [Q, 2] and solid-angle weights [Q]."""
    x, w = (torch.from_numpy(a) * HALF_PI for a in np.polynomial.legendre.leggauss(count))
    phi = 2 * math.pi * (torch.arange(count, dtype=torch.float64) + 0.5) / count - math.pi
    omega = torch.stack(torch.meshgrid(x, phi, indexing="ij"), -1).reshape(-1, 2)
    weight = (w * torch.cos(x))[:, None].expand(count, count) * (2 * math.pi / count)
    return omega, weight.reshape(-1)


@torch.no_grad()
def truth(toy: Toy) -> Toy:
    """Other parameters to be found again."""
    toy.centre += torch.linspace(0.2, -0.1, len(toy.centre), dtype=torch.float64)
    toy.log_width += torch.linspace(-0.5, 0.3, len(toy.centre), dtype=torch.float64)
    toy.phi += 0.3
    toy.log_spread -= 0.4
    toy.logits += torch.linspace(0.0, 0.7, len(toy.centre), dtype=torch.float64)
    return toy


@torch.no_grad()
def nodes_of(toy: Toy, context: Context, count: int = 40, scale: float = 3.0) -> tuple[Tensor, Tensor, Tensor]:
    """Nodes whose integrand is `scale` times the density of `toy`."""
    omega, weight = nodes(count)
    value = scale * toy(context).log_prob(omega).exp()
    return omega, weight, value[:, None]
