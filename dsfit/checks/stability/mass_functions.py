"""Rows of the atlas: what is lost of a density's normalisation. The function is its integral over the domain, and the
twin is 1, whose derivative in every parameter is 0.

The integral is a sum over Gauss-Legendre panels that shrink geometrically towards the mode and both ends, done in
float64 whatever the dtype of the density.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import mpmath as mp
import torch
from torch import Tensor

from dsfit.checks.stability.function import Function, Point
from dsfit.checks.stability.limits import FEW_ULPS, within
from dsfit.checks.stability.lobe_points import lobe_laws
from dsfit.checks.stability.points import deg
from dsfit.proposals.azimuth import CosineHalfLaw, TruncatedGaussianLaw, WrappedGaussianLaw
from dsfit.proposals.cauchy_lobe import CauchyInclination
from dsfit.proposals.inclination import TruncatedGaussianInclination
from dsfit.proposals.split_lobe import SplitGaussianInclination
from dsfit.proposals.transmittance import TransmittanceCosineInclination
from dsfit.proposals.uniform import UniformInclinationLaw
from dsfit.quadrature import gauss_legendre

HALF_PI = math.pi / 2
_NODES = 16
_STEPS = 2.0 ** torch.arange(-1, 30, dtype=torch.float64)


def integral(
    density: Callable[[Tensor], Tensor], edges: Tensor, dtype: torch.dtype, *, logarithm: bool = True
) -> Tensor:
    """Integral of a density, given as its log unless said otherwise, over panels between `edges [K, E]`, `[K]`;
    `density` maps `[M, K]` to `[M, K]`.
    """
    x, weight = gauss_legendre(_NODES)
    middle, half = (edges[:, 1:] + edges[:, :-1]) / 2, (edges[:, 1:] - edges[:, :-1]) / 2
    nodes = (middle.unsqueeze(-1) + half.unsqueeze(-1) * x).flatten(1).T.to(dtype)
    weights = (half.unsqueeze(-1) * weight).flatten(1).T
    value = density(nodes)
    value = torch.exp(value) if logarithm else value
    return (value.to(torch.float64) * weights).sum(0).to(dtype)


def panels(low: float, high: float, *scales: tuple[Tensor, Tensor]) -> Tensor:
    """Edges `[K, E]` in [low, high] that double in width away from each (centre, width) `[K]`, and cover the rest."""
    edges = [torch.linspace(low, high, 9, dtype=torch.float64).expand(len(scales[0][0]), 9)]
    for centre, width in scales:
        steps = width.detach().to(torch.float64).unsqueeze(-1) * _STEPS
        middle = centre.detach().to(torch.float64).unsqueeze(-1)
        edges += [middle - steps, middle, middle + steps]
    return torch.cat(edges, dim=-1).clamp(low, high).sort(dim=-1).values


def _inclinations(mean: Tensor, std: Tensor, theta_r: Tensor) -> Tensor:
    """Edges in theta_i of a law of theta_h: around its mode, and where a far mode makes it steep at an end."""
    ends = [torch.full_like(mean, end) for end in (-HALF_PI, HALF_PI)]
    steep = [2 * std**2 / ((end + theta_r) / 2 - mean).abs().clamp_min(1e-12) for end in ends]
    steep = [torch.minimum(width, std).clamp_max(1.0) for width in steep]
    centre = (2 * mean - theta_r).clamp(-HALF_PI, HALF_PI)
    return panels(-HALF_PI, HALF_PI, (centre, 2 * std), *zip(ends, steep, strict=True))


def _lobe(law: Callable[..., object]) -> Callable[..., Tensor]:
    def compute(mean: Tensor, std: Tensor, theta_r: Tensor) -> Tensor:
        return integral(law(theta_r, mean, std).log_prob, _inclinations(mean, std, theta_r), mean.dtype)

    return compute


def _circle(law: Callable[..., object], turned: bool = False) -> Callable[..., Tensor]:
    """Over phi, whose laws here have their mode at pi and, turned by a quarter, their edges at pi / 2."""

    def compute(std: Tensor) -> Tensor:
        found = law(std)
        density = found.scattered_log_prob if turned else found.log_prob
        places = (-HALF_PI, HALF_PI) if turned else (-math.pi, math.pi)
        edges = panels(-math.pi, math.pi, *((torch.full_like(std, place), std) for place in places))
        return integral(lambda phi: density(phi, torch.zeros_like(phi)), edges, std.dtype)

    return compute


def _cosine_transmittance(theta_r: Tensor) -> Tensor:
    edges = panels(-HALF_PI, HALF_PI, (theta_r, torch.ones_like(theta_r)))
    return integral(TransmittanceCosineInclination(theta_r).log_prob, edges, theta_r.dtype)


def _fixed(log_density: Callable[[Tensor], Tensor], low: float, high: float) -> Callable[[Tensor], Tensor]:
    """A law without parameters; the argument stands for where the panels are put, which must not matter."""

    def compute(place: Tensor) -> Tensor:
        return integral(log_density, panels(low, high, (place, torch.ones_like(place))), place.dtype)

    return compute


def one(*_: mp.mpf) -> mp.mpf:
    """What every density integrates to."""
    return mp.mpf(1)


def _per_width(mean: float, width: float, *_: float) -> float:
    """What a derivative of the mass is compared with: the density falls by that much per radian."""
    return 1 / width


_WIDTHS: dict[str, list[Point]] = {
    "ordinary: gamma 10 to 60 deg": [(0.2,), (0.5,), (1.0,)],
    "narrow: 0.06 and 0.006 deg": [(1e-3,), (1e-4,)],
    "wide: to 50 rad": [(3.0,), (10.0,), (50.0,)],
    "switch": [(s,) for s in (0.0449, 0.0451, 0.139, 0.141, 0.899, 0.901, 1.999, 2.001)],
}
_PLACES = {"ordinary": [(-0.4,), (1.1,)]}

FUNCTIONS: list[Function] = [
    Function(
        "mass.gaussian_lobe",
        ("alpha", "beta", "theta_r"),
        _lobe(TruncatedGaussianInclination),
        one,
        lobe_laws(),
        gradient_scale=_per_width,
        limits=FEW_ULPS,
        loose={
            "narrow": within(1e-11, 7e-12, 7e-4, 3e-3),
            "grazing": within(9e-14, 3e-13, 9e-5, 2e-4),
            "tail": within(2e-12, 2e-12, 5e-3, 9e-3),
        },
    ),
    Function(
        "mass.cauchy_lobe",
        ("alpha", "scale", "theta_r"),
        _lobe(CauchyInclination),
        one,
        lobe_laws(),
        gradient_scale=_per_width,
        limits=FEW_ULPS,
        loose={
            "narrow": within(9e-12, 7e-12, 7e-4, 2e-3),
        },
    ),
    Function(
        "mass.split_lobe",
        ("mode", "above", "theta_r"),
        _lobe(lambda theta_r, mode, std: SplitGaussianInclination(theta_r, mode, 0.6 * std, std)),
        one,
        lobe_laws(),
        gradient_scale=_per_width,
        limits=FEW_ULPS,
        loose={
            "narrow": within(2e-11, 2e-11, 2e-3, 4e-3),
            "grazing": within(4e-13, 2e-12, 3e-4, 2e-3),
            "tail": within(2e-12, 5e-12, 5e-3, 2e-2),
        },
    ),
    Function(
        "mass.transmittance_cosine",
        ("theta_r",),
        _cosine_transmittance,
        one,
        {
            "ordinary": [(x,) for x in deg(-60.0, 0.7, 35.0)],
            "grazing": [(x,) for x in (*deg(89.9, -89.999), HALF_PI, -HALF_PI)],
        },
        limits=FEW_ULPS,
    ),
    Function(
        "mass.uniform_inclination",
        ("place",),
        _fixed(lambda theta: UniformInclinationLaw().log_prob(theta), -HALF_PI, HALF_PI),
        one,
        _PLACES,
        gradients=(),
        limits=FEW_ULPS,
    ),
    Function(
        "mass.cosine_azimuth",
        ("place",),
        _fixed(lambda phi: CosineHalfLaw().log_prob(phi, phi), -math.pi, math.pi),
        one,
        _PLACES,
        gradients=(),
        limits=FEW_ULPS,
    ),
    Function(
        "mass.cosine_azimuth_scattered",
        ("place",),
        _fixed(lambda phi: CosineHalfLaw().scattered_log_prob(phi, phi), -math.pi, math.pi),
        one,
        _PLACES,
        gradients=(),
        limits=FEW_ULPS,
    ),
    Function(
        "mass.wrapped_azimuth",
        ("gamma",),
        _circle(WrappedGaussianLaw),
        one,
        _WIDTHS,
        limits=FEW_ULPS,
        loose={
            "narrow": within(4e-12, 4e-11, 5e-4, 3e-2),
            "switch": within(3e-14, 3e-14, 2e-6, 1e-5),
        },
    ),
    Function(
        "mass.wrapped_azimuth_scattered",
        ("gamma",),
        _circle(WrappedGaussianLaw, True),
        one,
        _WIDTHS,
        limits=FEW_ULPS,
    ),
    Function(
        "mass.truncated_azimuth",
        ("gamma",),
        _circle(TruncatedGaussianLaw),
        one,
        _WIDTHS,
        limits=FEW_ULPS,
        loose={
            "narrow": within(4e-12, 4e-11, 5e-4, 3e-2),
            "switch": within(3e-14, 3e-14, 2e-6, 1e-5),
        },
    ),
    Function(
        "mass.truncated_azimuth_scattered",
        ("gamma",),
        _circle(TruncatedGaussianLaw, True),
        one,
        _WIDTHS,
        limits=FEW_ULPS,
        loose={
            "wide": within(9e-15, 1e-14, 2e-6, 1e-5),
        },
    ),
]
