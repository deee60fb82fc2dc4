"""Streams of shading contexts: what an amortised proposal is trained for, and what a renderer meets."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from dsfit.context import Context
from dsfit.errors import InputError, as_number, check_choice
from dsfit.frame import HALF_PI
from dsfit.random import uniforms

RULES = ("threshold", "poisson", "mixed")


@dataclass(frozen=True)
class ContextStream:
    """A distribution of contexts (theta_r, n, v), drawn by scrambled Sobol points.

    Args:
        theta: "sphere", viewing directions uniform over the sphere, p(theta_r) = cos(theta_r) / 2, as a renderer meets
            them; "angle", uniform in theta_r, which gives grazing views more attention.
        theta_max: largest |theta_r|, radians.
        direct: share of contexts with n = 0 and v = 1.
        n_mean: mean of n elsewhere: exponential, cut at n_max.
        n_max: largest n.
        rule: v where n > 0: "threshold", 0 (the thesis's rule: a point is lit or not); "poisson", v = exp(-n); "mixed",
            a third each of 0, exp(-n) and a number uniform in [0, 1].

    Raises:
        InputError: an argument is out of range.

    Example:
        >>> import torch
        >>> import dsfit
        >>> contexts = dsfit.ContextStream(direct=0.5).draw(1024, torch.Generator().manual_seed(0))
        >>> contexts.batch_shape
        torch.Size([1024])
        >>> round(float((contexts.n == 0).double().mean()), 2)
        0.5
    """

    theta: str = "sphere"
    theta_max: float = math.radians(89.0)
    direct: float = 0.3
    n_mean: float = 8.0
    n_max: float = 30.0
    rule: str = "poisson"

    def __post_init__(self) -> None:
        check_choice("stream.theta", self.theta, ("sphere", "angle"))
        check_choice("stream.rule", self.rule, RULES)
        as_number("stream.theta_max", self.theta_max, 0.0, HALF_PI, open_low=True)
        as_number("stream.direct", self.direct, 0.0, 1.0)
        as_number("stream.n_mean", self.n_mean, 0.0, open_low=True)
        as_number("stream.n_max", self.n_max, 0.0, open_low=True)

    def draw(self, count: int, generator: torch.Generator, *, dtype: torch.dtype = torch.float64) -> Context:
        """`count` contexts, of batch shape `[count]`; equal generator states give equal contexts.

        Raises:
            InputError: count < 1.
        """
        if isinstance(count, bool) or not isinstance(count, int) or count < 1:
            raise InputError("count", count, "an integer >= 1")
        x = uniforms((count,), 5, generator=generator, kind="sobol").unbind(-1)
        if self.theta == "sphere":
            theta = torch.asin((2 * x[0] - 1) * math.sin(self.theta_max))
        else:
            theta = (2 * x[0] - 1) * self.theta_max
        reach = -math.expm1(-self.n_max / self.n_mean)
        n = torch.where(x[1] < self.direct, 0.0, -self.n_mean * torch.log1p(-x[2] * reach))
        v = torch.where(n == 0, 1.0, self._lit(n, x[3], x[4]))
        return Context(theta, 0.0, n, v).to(dtype)

    def _lit(self, n: torch.Tensor, which: torch.Tensor, share: torch.Tensor) -> torch.Tensor:
        if self.rule == "threshold":
            return torch.zeros_like(n)
        if self.rule == "poisson":
            return torch.exp(-n)
        return torch.where(which < 1 / 3, 0.0, torch.where(which < 2 / 3, torch.exp(-n), share))
