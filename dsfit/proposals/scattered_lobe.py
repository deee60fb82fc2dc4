"""Longitudinal lobes whose widths come from multiple scattering: M^G and the back-scatter lobe."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from dsfit.context import Context
from dsfit.proposals.base import Longitudinal
from dsfit.proposals.inclination import TruncatedGaussianInclination
from dsfit.proposals.parameters import MEAN_BOUNDS, STD_BOUNDS, Bounded, Given

Value = float | Tensor | Callable[[Context], Tensor]
"""A number, a tensor that broadcasts to the context batch, or a function of the context; never learned, detached."""


class ScatteredLobe(Longitudinal):
    """M^G of chapter eq (10): a Gaussian lobe widened by n forward scattering events.

    `theta_h ~ N(mean, sqrt(std^2 + n beta_f^2))` truncated to [L, H]; n is the context's hint.

    Args:
        mean, std: alpha_X and beta_X of the lobe, radians in theta_h; learnable.
        beta_f: average forward scattering width, radians, e.g. that of `DualScattering.averages` at the specular
            guess. It is the same number in `sample` and `log_prob`, so the density is exact whatever it is.

    Raises:
        InputError: mean or std outside its bounds.
    """

    def __init__(self, mean: float | Tensor, std: float | Tensor, beta_f: Value, *, learnable: bool = True) -> None:
        super().__init__()
        self.mean = Bounded("mean", mean, *MEAN_BOUNDS, learnable=learnable)
        self.std = Bounded("std", std, *STD_BOUNDS, log=True, learnable=learnable)
        self.beta_f = Given("beta_f", beta_f)

    def forward(self, context: Context) -> TruncatedGaussianInclination:
        std = torch.sqrt(self.std(context) ** 2 + context.n * self.beta_f(context) ** 2)
        return TruncatedGaussianInclination(context.theta_r, self.mean(context), std)


class BackScatterLobe(Longitudinal):
    """The longitudinal part of f_back, chapter eq (7): `theta_h ~ N(Delta_b, sigma)` truncated to [L, H].

    `sigma = scale sqrt(sigma_b^2 + n beta_f^2)` and the centre is `delta_b + shift`; scale = 1 and shift = 0 to start
    with.

    Args:
        delta_b, sigma_b: average longitudinal shift and standard deviation of back scattering, radians in theta_h,
            frozen at the specular guess theta_i = -theta_r.
        beta_f: forward scattering width; left at 0, the lobe is that of directly lit hair.
        learnable: whether shift and scale are learned.
    """

    def __init__(self, delta_b: Value, sigma_b: Value, beta_f: Value = 0.0, *, learnable: bool = True) -> None:
        super().__init__()
        self.delta_b, self.sigma_b = Given("delta_b", delta_b), Given("sigma_b", sigma_b)
        self.beta_f = Given("beta_f", beta_f)
        self.shift = Bounded("shift", 0.0, *MEAN_BOUNDS, learnable=learnable)
        self.scale = Bounded("scale", 1.0, 1e-2, 1e2, log=True, learnable=learnable)

    def forward(self, context: Context) -> TruncatedGaussianInclination:
        variance = self.sigma_b(context) ** 2 + context.n * self.beta_f(context) ** 2
        std = self.scale(context) * torch.sqrt(variance.clamp_min(STD_BOUNDS[0] ** 2))
        return TruncatedGaussianInclination(context.theta_r, self.delta_b(context) + self.shift(context), std)
