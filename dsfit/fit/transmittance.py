"""The transmittance proposal against what it stands for: a law of the light's inclination fitted to a_f(theta)^n.

Light reaches a fibre behind n others weakened by `T_f = d_f prod_k a_f(theta^k)`, for equal inclinations
`a_f(theta)^n` (chapter eq (32)). The chapter samples it by the cosine law (33), the same for every n. This module fits
the two natural alternatives, a truncated Gaussian with and without a free centre, and says what each costs.
One-dimensional: densities are per radian of theta on [-pi/2, pi/2].
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from dsfit.errors import InputError, check_range
from dsfit.fit.objectives import excess_residuals
from dsfit.fit.solvers import minimise
from dsfit.frame import HALF_PI
from dsfit.quadrature import panel_points
from dsfit.special import truncated_normal_log_prob


@dataclass(frozen=True)
class TransmittanceFit:
    """Laws for `P*(theta) ~ a_f(theta)^n` at one n; angles in radians, excess = chi-square divergence of P* from the
    law.

    Attributes:
        mean, std: moments of P*.
        centre, width: parameters of the best truncated Gaussian; `width_centred`: of the best one with centre 0.
        excess, excess_centred, excess_cosine: of these two and of the chapter's `cos(theta) / 2`.
        converged: whether both fits converged.
    """

    n: float
    mean: float
    std: float
    centre: float
    width: float
    excess: float
    width_centred: float
    excess_centred: float
    excess_cosine: float
    converged: bool


def fit_transmittance(
    bsdf: Any,
    n_values: Sequence[float] = tuple(range(1, 51)),
    *,
    solver: str = "optimistix.lm",
    panels: int = 40,
    degree: int = 16,
) -> list[TransmittanceFit]:
    """Fit truncated Gaussians to a_f(theta)^n for every n.

    Args:
        bsdf: anything with `averages(theta).a_f` of shape [..., C], such as `DualScattering`; the mean over channels
            is taken.
        n_values: numbers of fibres, real, >= 0.
        solver: name of a solver for least squares.
        panels, degree: Gauss-Legendre quadrature in theta, `panels` pieces of `degree` nodes.

    Raises:
        InputError: n is negative or not finite, or a_f is negative, not finite or zero everywhere.
    """
    numbers = check_range("n_values", torch.as_tensor(n_values, dtype=torch.float64).reshape(-1), 0.0)
    theta, weight = panel_points(torch.linspace(-HALF_PI, HALF_PI, panels + 1, dtype=torch.float64), degree)
    theta, weight = theta.reshape(-1), weight.reshape(-1)
    with torch.no_grad():
        a_f = bsdf.averages(theta).a_f.to(torch.float64)
        a_f = check_range("averages.a_f", a_f.reshape(len(theta), -1), 0.0).mean(-1)
    if not float(a_f.max()) > 0:
        raise InputError("averages.a_f", 0.0, "attenuation that is not zero everywhere")
    return [_fit_one(float(n), theta, weight, a_f, solver) for n in numbers]


def _fit_one(n: float, theta: Tensor, weight: Tensor, a_f: Tensor, solver: str) -> TransmittanceFit:
    # exp(n log a_f) in logs throughout, with 0^0 = 1; the largest is scaled to 1 so that no n underflows.
    log_target = torch.where(a_f > 0, n * torch.log(torch.where(a_f > 0, a_f, 1.0)), 0.0 if n == 0 else -math.inf)
    log_target = log_target - log_target.max()
    log_best = log_target - torch.log((weight * log_target.exp()).sum())
    best = log_best.exp()
    mean = float((weight * best * theta).sum())
    std = math.sqrt(float((weight * best * (theta - mean).square()).sum()))
    edge = torch.tensor(HALF_PI, dtype=torch.float64)

    def log_p(centre: Tensor, log_width: Tensor) -> Tensor:
        return truncated_normal_log_prob(theta, centre, log_width.exp(), -edge, edge)

    def residuals(y: Tensor) -> Tensor:
        return excess_residuals(log_p(y[0], y[1]), weight, log_best)

    def centred(y: Tensor) -> Tensor:
        return excess_residuals(log_p(torch.zeros_like(y[0]), y[0]), weight, log_best)

    options = {"tolerance": 1e-8, "max_steps": 200}
    free = minimise(residuals, torch.tensor([mean, math.log(std)], dtype=torch.float64), solver, **options)
    fixed = minimise(centred, torch.tensor([math.log(math.hypot(mean, std))], dtype=torch.float64), solver, **options)
    cosine = excess_residuals(torch.log(torch.cos(theta) / 2), weight, log_best).square().sum()
    return TransmittanceFit(
        n=n,
        mean=mean,
        std=std,
        centre=float(free.y[0]),
        width=math.exp(float(free.y[1])),
        excess=free.value,
        width_centred=math.exp(float(fixed.y[0])),
        excess_centred=fixed.value,
        excess_cosine=float(cosine),
        converged=free.converged and fixed.converged,
    )
