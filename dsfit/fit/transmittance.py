"""The transmittance proposal against what it stands for: a law of the light's inclination fitted to a_f(theta)^n.

Light reaches a fibre behind n others weakened by `T_f = d_f prod_k a_f(theta^k)`, for equal inclinations
`a_f(theta)^n` (chapter eq (32)). The chapter samples it by the cosine law (33), the same for every n. This module fits
the two natural alternatives, a truncated Gaussian with and without a free centre, and says what each costs.
One-dimensional: densities are per radian of theta on [-pi/2, pi/2].

What a factor a_f(theta)^n of the integrand asks of a law depends on what else is counted: by itself, per radian of
theta, it is a_f^n; per solid angle, as d omega = cos(theta) dtheta dphi, a_f^n cos(theta); with the integrand's own
cosine (4), a_f^n cos^2(theta). `cosines` says how many.

Centres and widths stay between the bounds of `proposals.TransmittanceGaussian`, so that what is found can be given to
that law. The bounds matter where a_f^n is no hill: a_f of black hair has its least value near the normal plane and
grows towards both ends, and without bounds the best Gaussian is one of infinite width, or an exponential slope whose
centre is infinitely far away. Each fit starts from the best point of a coarse grid, because from far away the excess of
a light-tailed law is flat on a logarithmic scale and has several minima.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from dsfit.errors import InputError, as_number, check_range
from dsfit.fit.objectives import excess_residuals
from dsfit.fit.solvers import minimise
from dsfit.frame import HALF_PI
from dsfit.proposals.parameters import MEAN_BOUNDS, STD_BOUNDS, from_raw, to_raw
from dsfit.quadrature import panel_points
from dsfit.special import truncated_normal_log_prob

_INSIDE = 1 - 1e-6  # a law refuses values on its bounds
CENTRES = (MEAN_BOUNDS[0] * _INSIDE, MEAN_BOUNDS[1] * _INSIDE)
"""Bounds of a centre, radians."""
WIDTHS = (STD_BOUNDS[0] / _INSIDE, STD_BOUNDS[1] * _INSIDE)
"""Bounds of a width, radians."""
_AT_BOUND = 1e-4  # share of the (for widths logarithmic) range within which a value counts as at its bound
_REACH = 8.0  # longest step: far enough to arrive at a bound, which lies at infinity, in some ten steps


@dataclass(frozen=True)
class TransmittanceFit:
    """Laws for `P*(theta) ~ a_f(theta)^n cos(theta)^cosines` at one n; angles in radians, excess = chi-square
    divergence of P* from the law.

    Attributes:
        mean, std: moments of P*.
        centre, width: parameters of the best truncated Gaussian; `width_centred`: of the best one with centre 0.
        excess, excess_centred, excess_cosine: of these two and of the chapter's `cos(theta) / 2`.
        converged: whether both fits converged.
        at_bounds: which of centre, width and width_centred ended at a bound: the family would go on.
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
    at_bounds: tuple[str, ...] = ()


def fit_transmittance(
    bsdf: Any,
    n_values: Sequence[float] = tuple(range(1, 51)),
    *,
    solver: str = "optimistix.lm",
    panels: int = 40,
    degree: int = 16,
    cosines: float = 0.0,
) -> list[TransmittanceFit]:
    """Fit truncated Gaussians to a_f(theta)^n cos(theta)^cosines for every n.

    Args:
        bsdf: anything with `averages(theta).a_f` of shape [..., C], such as `DualScattering`; the mean over channels
            is taken.
        n_values: numbers of fibres, real, >= 0.
        solver: name of a solver for least squares.
        panels, degree: Gauss-Legendre quadrature in theta, `panels` pieces of `degree` nodes.
        cosines: power of cos(theta) beside a_f^n: 0 per radian, 1 per solid angle, 2 with the integrand's cosine.

    Raises:
        InputError: n or `cosines` is negative or not finite, or a_f is negative, not finite or zero everywhere.
    """
    cosines = as_number("cosines", cosines, 0.0)
    numbers = check_range("n_values", torch.as_tensor(n_values, dtype=torch.float64).reshape(-1), 0.0)
    theta, weight = panel_points(torch.linspace(-HALF_PI, HALF_PI, panels + 1, dtype=torch.float64), degree)
    theta, weight = theta.reshape(-1), weight.reshape(-1)
    with torch.no_grad():
        a_f = bsdf.averages(theta).a_f.to(torch.float64)
        a_f = check_range("averages.a_f", a_f.reshape(len(theta), -1), 0.0).mean(-1)
    if not float(a_f.max()) > 0:
        raise InputError("averages.a_f", 0.0, "attenuation that is not zero everywhere")
    return [_fit_one(float(n), theta, weight, a_f, cosines, solver) for n in numbers]


def _fit_one(n: float, theta: Tensor, weight: Tensor, a_f: Tensor, cosines: float, solver: str) -> TransmittanceFit:
    # exp(n log a_f) in logs throughout, with 0^0 = 1; the largest is scaled to 1 so that no n underflows.
    log_target = torch.where(a_f > 0, n * torch.log(torch.where(a_f > 0, a_f, 1.0)), 0.0 if n == 0 else -math.inf)
    log_target = log_target + cosines * torch.log(torch.cos(theta))
    log_target = log_target - log_target.max()
    log_best = log_target - torch.log((weight * log_target.exp()).sum())
    best = log_best.exp()
    mean = float((weight * best * theta).sum())
    std = math.sqrt(float((weight * best * (theta - mean).square()).sum()))
    free = _fit_gaussian(theta, weight, log_best, (mean, std), solver, centred=False)
    fixed = _fit_gaussian(theta, weight, log_best, (mean, std), solver, centred=True)
    cosine = excess_residuals(torch.log(torch.cos(theta) / 2), weight, log_best).square().sum()
    return TransmittanceFit(
        n=n,
        mean=mean,
        std=std,
        centre=free.centre,
        width=free.width,
        excess=free.excess,
        width_centred=fixed.width,
        excess_centred=fixed.excess,
        excess_cosine=float(cosine),
        converged=free.converged and fixed.converged,
        at_bounds=(*free.at_bounds, *(f"{name}_centred" for name in fixed.at_bounds)),
    )


@dataclass(frozen=True)
class _Gaussian:
    centre: float
    width: float
    excess: float
    converged: bool
    at_bounds: tuple[str, ...]


def _fit_gaussian(
    theta: Tensor, weight: Tensor, log_best: Tensor, moments: tuple[float, float], solver: str, centred: bool
) -> _Gaussian:
    """The truncated Gaussian of least excess between the bounds; with centre 0 if `centred`."""
    edge = torch.tensor(HALF_PI, dtype=torch.float64)

    def residuals(centre: Tensor, width: Tensor) -> Tensor:
        log_p = truncated_normal_log_prob(theta, centre[..., None], width[..., None], -edge, edge)
        return excess_residuals(log_p, weight, log_best)

    centres, widths = _grid(*moments, centred)
    best = int(residuals(centres, widths).square().sum(-1).argmin())
    start = [to_raw("width", widths[best], *WIDTHS, log=True)]
    if not centred:
        start = [to_raw("centre", centres[best], *CENTRES), *start]

    def values(y: Tensor) -> tuple[Tensor, Tensor]:
        return torch.zeros_like(y[0]) if centred else from_raw(y[0], *CENTRES), from_raw(y[-1], *WIDTHS, log=True)

    found = minimise(
        lambda y: residuals(*values(y)), torch.stack(start), solver, tolerance=1e-7, max_steps=200, reach=_REACH
    )
    centre, width = (float(value) for value in values(found.y))
    places = {"width": math.log(width / WIDTHS[0]) / math.log(WIDTHS[1] / WIDTHS[0])}
    if not centred:
        places = {"centre": (centre - CENTRES[0]) / (CENTRES[1] - CENTRES[0]), **places}
    ended = tuple(name for name, place in places.items() if not _AT_BOUND <= place <= 1 - _AT_BOUND)
    return _Gaussian(centre, width, found.value, found.converged, ended)


def _grid(mean: float, std: float, centred: bool) -> tuple[Tensor, Tensor]:
    """Centres and widths `[G]` to start from: the target's own moments, and a grid over all that it could be."""
    width = torch.logspace(-3, 1, 25, dtype=torch.float64)
    if centred:
        width = torch.cat([width, torch.tensor([math.hypot(mean, std)], dtype=torch.float64).clamp(*WIDTHS)])
        return torch.zeros_like(width), width
    centre = torch.linspace(0.99 * CENTRES[0], 0.99 * CENTRES[1], 19, dtype=torch.float64)
    both = torch.cartesian_prod(centre, width)
    moments = torch.tensor(
        [[max(min(mean, 0.99 * CENTRES[1]), 0.99 * CENTRES[0]), max(std, 1e-4)]], dtype=torch.float64
    )
    return torch.cat([moments, both]).unbind(-1)
