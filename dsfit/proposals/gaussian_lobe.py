"""The longitudinal lobe M_X of Marschner's model as a proposal, and its Box-Muller sampler."""

from __future__ import annotations

import torch
from torch import Tensor

from dsfit.context import Context
from dsfit.errors import InputError
from dsfit.proposals.base import Longitudinal
from dsfit.proposals.inclination import TruncatedGaussianInclination, bounds, to_theta_i
from dsfit.proposals.parameters import MEAN_BOUNDS, STD_BOUNDS, Bounded
from dsfit.special import log_normal_mass, truncated_normal_icdf


class GaussianLobe(Longitudinal):
    """`theta_h ~ N(mean, std)` truncated to [L, H] = theta_r / 2 -+ pi / 4, then `theta_i = 2 theta_h - theta_r`.

    Density per radian of theta_i: `g(theta_h - mean; std) / (2 Z)`. This is chapter eqs (12), (16)-(20) corrected:
        reachable interval, normalisation Z and Jacobian 2. Sampled by inverse CDF.

    Args:
        mean: centre in theta_h, radians (alpha_X), a number or a tensor that broadcasts to the context batch.
        std: width in theta_h, radians (beta_X).
        learnable: whether `parameters()` lists them. Bijections: `parameters.Bounded`, mean linear, std logarithmic.

    Raises:
        InputError: mean or std outside its bounds.
    """

    def __init__(self, mean: float | Tensor, std: float | Tensor, *, learnable: bool = True) -> None:
        super().__init__()
        self.mean = Bounded("mean", mean, *MEAN_BOUNDS, learnable=learnable)
        self.std = Bounded("std", std, *STD_BOUNDS, log=True, learnable=learnable)

    def forward(self, context: Context) -> TruncatedGaussianInclination:
        return TruncatedGaussianInclination(context.theta_r, self.mean(context), self.std(context))


class BoxMullerInclination(TruncatedGaussianInclination):
    """The same law with a second sampler that takes a generator instead of uniforms: Box-Muller with redraw."""

    def draw(self, shape: tuple[int, ...], generator: torch.Generator, max_tries: int = 64) -> Tensor:
        """theta_i `[*shape, *batch]` by `truncated_box_muller` in theta_h; not differentiable."""
        low, high = bounds(self.variable, self.theta_r)
        t = truncated_box_muller(shape, self.mean, self.std, low, high, generator=generator, max_tries=max_tries)
        return to_theta_i(self.variable, t, self.theta_r)


class BoxMullerLobe(GaussianLobe):
    """`GaussianLobe` whose law also has `draw(shape, generator)`, chapter eqs (13), (14), (17), (18) with redraw."""

    def forward(self, context: Context) -> BoxMullerInclination:
        return BoxMullerInclination(context.theta_r, self.mean(context), self.std(context))


@torch.no_grad()
def truncated_box_muller(
    shape: tuple[int, ...],
    mean: Tensor,
    std: Tensor,
    low: Tensor,
    high: Tensor,
    *,
    generator: torch.Generator,
    max_tries: int = 64,
) -> Tensor:
    """Samples `[*shape, *batch]` of the normal law truncated to [low, high], by Box-Muller redrawn until inside.

    `x = mean + std sqrt(-2 ln u1) cos(2 pi u2)`, u1 in (0, 1] so that the logarithm is finite (chapter eq (13)). The
    expected number of tries is 1 / Z; where the mass Z inside is below 0.1, and for what is still outside after
    `max_tries`, the inverse CDF takes over, which leaves the law exactly as it is. Not differentiable, and of no use
    to quasi-Monte Carlo.

    Raises:
        InputError: max_tries < 1.
    """
    if max_tries < 1:
        raise InputError("max_tries", max_tries, "integers >= 1")
    mean, std, low, high = torch.broadcast_tensors(mean, std, low, high)
    full = (*shape, *mean.shape)
    new = {"dtype": mean.dtype, "device": mean.device, "generator": generator}
    mean, std, low, high = (t.expand(full) for t in (mean, std, low, high))
    likely = log_normal_mass((low - mean) / std, (high - mean) / std) >= torch.log(torch.tensor(0.1)).item()
    result = torch.empty(full, dtype=mean.dtype, device=mean.device)
    pending = likely.clone()
    for _ in range(max_tries):
        count = int(pending.sum())
        if count == 0:
            break
        u1, u2 = 1 - torch.rand(count, **new), torch.rand(count, **new)
        normal = torch.sqrt(-2 * torch.log(u1)) * torch.cos(2 * torch.pi * u2)
        x = mean[pending] + std[pending] * normal
        result[pending] = x
        pending = pending.clone().masked_scatter_(pending, (x < low[pending]) | (x > high[pending]))
    rest = pending | ~likely
    if bool(rest.any()):
        u = torch.rand(int(rest.sum()), **new)
        result[rest] = truncated_normal_icdf(u, mean[rest], std[rest], low[rest], high[rest])
    return result
