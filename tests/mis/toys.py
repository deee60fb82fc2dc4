"""Small proposals and integrands with known integrals, independent of `dsfit.proposals`."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from dsfit.context import Context
from dsfit.frame import to_angles, to_vector
from dsfit.proposals.base import Distribution, Proposal


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def contexts(count: int, seed: int = 1, dtype: torch.dtype = torch.float64) -> Context:
    u = torch.rand(3, count, generator=generator(seed), dtype=torch.float64)
    return Context((u[0] - 0.5) * 2.8, (u[1] - 0.5) * 6, u[2] * 3).to(dtype)


class Sphere(Proposal):
    """Uniform: 1 / (4 pi)."""

    def forward(self, context: Context) -> Distribution:
        return SphereDistribution(context)


class SphereDistribution(Distribution):
    dimension = 2

    def __init__(self, context: Context) -> None:
        self.batch_shape = context.batch_shape

    def sample_with_log_prob(self, u: Tensor) -> tuple[Tensor, Tensor]:
        omega = torch.stack([torch.asin(2 * u[..., 0] - 1), 2 * math.pi * (u[..., 1] - 0.5)], dim=-1)
        return omega, self.log_prob(omega)

    def log_prob(self, omega: Tensor) -> Tensor:
        return torch.full_like(omega[..., 0], -math.log(4 * math.pi))


class Lobe(Proposal):
    """p = (k + 1) / (2 pi 2^(k+1)) (1 + mu)^k with mu the cosine to the viewing direction or, with `half`, (k + 1) / (2
    pi) mu_+^k.

    `log_scale` multiplies the reported density only, which makes it wrong.
    """

    def __init__(self, exponent: float, half: bool = False, tangent: bool = False, log_scale: float = 0.0) -> None:
        super().__init__()
        self.exponent = nn.Parameter(torch.tensor(exponent, dtype=torch.float64))
        self.half, self.tangent, self.log_scale = half, tangent, log_scale

    def forward(self, context: Context) -> Distribution:
        return LobeDistribution(self, context)


class LobeDistribution(Distribution):
    dimension = 2

    def __init__(self, lobe: Lobe, context: Context) -> None:
        self.lobe, self.batch_shape, self.k = lobe, context.batch_shape, lobe.exponent.to(context.dtype)
        self.axis = to_vector(torch.stack([context.theta_r, context.phi_r], dim=-1))
        if lobe.tangent:
            self.axis = torch.tensor([1.0, 0.0, 0.0], dtype=context.dtype).expand(self.axis.shape)
        other = torch.tensor([0.0, 0.0, 1.0], dtype=context.dtype).expand(self.axis.shape)
        other = torch.where(self.axis[..., 2:].abs() > 0.9, other.roll(1, -1), other)
        self.first = torch.nn.functional.normalize(torch.linalg.cross(self.axis, other), dim=-1)
        self.second = torch.linalg.cross(self.axis, self.first)

    def sample(self, u: Tensor) -> Tensor:
        t = u[..., 0] ** (1 / (self.k + 1))
        mu = t if self.lobe.half else 2 * t - 1
        angle, radius = 2 * math.pi * u[..., 1], torch.sqrt((1 - mu * mu).clamp_min(1e-30))
        x, y = radius * torch.cos(angle), radius * torch.sin(angle)
        return to_angles(mu[..., None] * self.axis + x[..., None] * self.first + y[..., None] * self.second)

    def sample_with_log_prob(self, u: Tensor) -> tuple[Tensor, Tensor]:
        omega = self.sample(u)
        return omega, self.log_prob(omega)

    def log_prob(self, omega: Tensor) -> Tensor:
        mu = (to_vector(omega) * self.axis).sum(dim=-1)
        base = mu if self.lobe.half else (1 + mu) / 2
        inside = base > 0
        log_base = torch.log(torch.where(inside, base, 1.0))
        norm = torch.log(self.k + 1) - math.log((2 if self.lobe.half else 4) * math.pi)
        return torch.where(inside, norm + self.k * log_base, -torch.inf) + self.lobe.log_scale


class TruncatedNormal(Proposal):
    """theta_i from a normal law cut off at +-pi/2, phi_i uniform; `jacobian=False` forgets the 1 / cos(theta_i)."""

    def __init__(self, mean: float, sigma: float, jacobian: bool = True) -> None:
        super().__init__()
        self.mean, self.sigma, self.jacobian = mean, sigma, jacobian

    def forward(self, context: Context) -> Distribution:
        return TruncatedNormalDistribution(self, context)


class TruncatedNormalDistribution(Distribution):
    dimension = 2

    def __init__(self, law: TruncatedNormal, context: Context) -> None:
        self.law, self.batch_shape = law, context.batch_shape
        edges = (torch.tensor([-math.pi / 2, math.pi / 2], dtype=context.dtype) - law.mean) / law.sigma
        self.low, self.high = torch.special.ndtr(edges).unbind()

    def sample_with_log_prob(self, u: Tensor) -> tuple[Tensor, Tensor]:
        z = torch.special.ndtri(self.low + u[..., 0] * (self.high - self.low))
        limit = math.pi / 2 - 1e-5
        theta = (self.law.mean + self.law.sigma * z).clamp(-limit, limit)
        omega = torch.stack([theta, 2 * math.pi * (u[..., 1] - 0.5)], dim=-1)
        return omega, self.log_prob(omega)

    def log_prob(self, omega: Tensor) -> Tensor:
        theta = omega[..., 0]
        z = (theta - self.law.mean) / self.law.sigma
        log_theta = -0.5 * z * z - math.log(self.law.sigma * math.sqrt(2 * math.pi)) - torch.log(self.high - self.low)
        log_p = log_theta - math.log(2 * math.pi)
        return log_p - torch.log(torch.cos(theta)) if self.law.jacobian else log_p


class TwoLobes(nn.Module):
    """F_c = a_c (1 + mu_r)^6 + b_c (1 + mu_t)^3 + d_c (1 + n), mu_r and mu_t the cosines to the viewing direction and
    to the tangent.

    ∫ (1 + mu)^m dω = 4 pi 2^m / (m + 1).
    """

    def __init__(self, dtype: torch.dtype = torch.float64) -> None:
        super().__init__()
        self.a = nn.Parameter(torch.tensor([0.02, 0.1, 0.3], dtype=dtype))
        self.b = torch.tensor([0.5, 0.4, 0.1], dtype=dtype)
        self.d = torch.tensor([0.05, 0.1, 0.2], dtype=dtype)

    def forward(self, omega: Tensor, context: Context) -> Tensor:
        direction = to_vector(omega)
        axis = to_vector(torch.stack([context.theta_r, context.phi_r], dim=-1))
        first = (1 + (direction * axis).sum(dim=-1, keepdim=True)) ** 6
        second = (1 + direction[..., :1]) ** 3
        return self.a * first + self.b * second + self.d * (1 + context.n[..., None])

    def integral(self, context: Context) -> Tensor:
        level = self.d * (1 + context.n[..., None])
        return 4 * math.pi * (self.a * 2**6 / 7 + self.b * 2**3 / 4 + level)


def sphere_nodes(count: int) -> tuple[Tensor, Tensor]:
    """Gauss-Legendre in sin(theta) times equispaced phi: omega `[Q, 2]`, weight `[Q]`; exact for polynomials."""
    from numpy.polynomial.legendre import leggauss

    x, w = (torch.from_numpy(a) for a in leggauss(count))
    phi = (torch.arange(2 * count, dtype=torch.float64) + 0.5) / (2 * count) * 2 * math.pi - math.pi
    theta, azimuth = torch.meshgrid(torch.asin(x), phi, indexing="ij")
    weight = (w * math.pi / count).repeat_interleave(2 * count)
    return torch.stack([theta, azimuth], dim=-1).reshape(-1, 2), weight
