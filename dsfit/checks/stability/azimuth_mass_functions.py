"""Rows of the atlas: int N_p dphi over (1/2) int A dh, which is 1, for R, TT and TRT without treatment of its caustic.

The caustic's integrable singularity is approached to 5e-10 radians, which leaves 1e-6 of the energy out. Marschner's
treatment of the caustic is left out: it is meant to take energy away (k_G < 1).
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from dsfit.bsdf.attenuation import lobe_energies
from dsfit.bsdf.azimuthal import azimuthal, refractions, support_edges
from dsfit.bsdf.fiber import Fiber
from dsfit.checks.stability.function import Function, Point
from dsfit.checks.stability.limits import FEW_ULPS, within
from dsfit.checks.stability.mass_functions import integral, one, panels
from dsfit.checks.stability.points import deg, product

_CLOSEST = 1e-9


def _share(p: int) -> Callable[..., Tensor]:
    """int N_p dphi over the lobe's energy, of theta_diff, sigma_a and eta."""

    def compute(theta_diff: Tensor, sigma_a: Tensor, eta: Tensor) -> Tensor:
        fiber = Fiber(eta=eta, sigma_a=sigma_a.unsqueeze(-1))
        with torch.no_grad():
            places = support_edges(fiber, theta_diff).unbind(-1)
        edges = panels(0.0, math.pi, *((place, torch.full_like(place, _CLOSEST)) for place in places))

        def density(phi: Tensor) -> Tensor:
            return azimuthal(fiber, theta_diff, phi, None, "raw", "geometric")[..., p, 0]

        energy = lobe_energies(refractions(fiber, theta_diff, None), fiber.sigma_a, "geometric")[..., p, 0]
        return 2 * integral(density, edges, theta_diff.dtype, logarithm=False) / energy

    return compute


_REGIMES: dict[str, list[Point]] = {
    "ordinary": product(deg(0.0, 20.0, 45.0), [0.1, 0.6], [1.55], most=4),
    "grazing: theta_diff to 89.9 deg": product(deg(80.0, 89.9), [0.1], [1.55]),
    "clear": product(deg(0.0, 45.0), [0.0, 1e-9], [1.55]),
    "dark: sigma_a = 5": product(deg(0.0, 45.0), [5.0], [1.55]),
    "index: 1.01 and 3": product(deg(0.0, 45.0), [0.1], [1.01, 3.0]),
}
_ARGUMENTS = ("theta_diff", "sigma_a", "eta")

FUNCTIONS: list[Function] = [
    Function(
        f"mass.N_{name}",
        _ARGUMENTS,
        _share(p),
        one,
        _REGIMES,
        gradients=("sigma_a",),
        limits=FEW_ULPS,
        loose={"index": within(1e-10, 1e-10, 2e-6, 1e-5)},  # the two quadratures, where Fresnel's edge is sharp
    )
    for p, name in enumerate(("R", "TT"))
] + [
    Function(
        "mass.N_TRT",
        _ARGUMENTS,
        _share(2),
        one,
        _REGIMES,
        gradients=("sigma_a",),
        limits=within(1e-5, 1e-5, 1e-2, 1e-2),  # see the module text; in float32 angles themselves end at 2e-7
    )
]
