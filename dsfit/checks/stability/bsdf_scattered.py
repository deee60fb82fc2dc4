"""Entries: lobes after multiple scattering (N^G, M^G), back scattering for given averages, and transmittance.

N^G is a mass between two azimuths: where the window's edge meets a caustic or an edge of the lobe's support, its
derivative in phi is as ill-conditioned as the lobe there, and points keep their distance from that.
"""

from __future__ import annotations

import math
from types import SimpleNamespace

import torch
from torch import Tensor

import dsfit
from dsfit.bsdf.azimuthal import AzimuthalModel, azimuthal_scattered
from dsfit.bsdf.backscatter import back_shift, back_width, backscatter_albedo
from dsfit.bsdf.longitudinal import lobes, scattered_lobes
from dsfit.checks.stability import exact_bsdf as exact
from dsfit.checks.stability import exact_bsdf_averages as averages
from dsfit.checks.stability import exact_bsdf_scattered as scattered
from dsfit.checks.stability.bsdf_azimuth import GLINT
from dsfit.checks.stability.bsdf_optics import EDGE, fibers, inclination_of
from dsfit.checks.stability.function import Function
from dsfit.checks.stability.points import DEG, product

_PI = math.pi


def window(p: int, model: AzimuthalModel, *columns: Tensor) -> Tensor:
    """N^G_p of the library for columns eta, sigma_a, theta_diff, phi[, caustic_width or gamma_TT]."""
    eta, sigma_a, theta_diff, phi, *width = columns
    name = "gamma_tt" if model == "simplified" else "caustic_width"
    fiber = fibers(eta, sigma_a, **GLINT, **({name: width[0]} if width else {}))
    return azimuthal_scattered(fiber, theta_diff, phi, None, model, "geometric")[..., p, 0]


def _window_trt(hair: exact.Hair, theta_diff: exact.Real, phi: exact.Real) -> exact.Real:
    return scattered.window(2, hair, theta_diff, phi, exact.Glint.of(hair, theta_diff))


def _longitudinal(theta_h: Tensor, alpha: Tensor, beta: Tensor) -> Tensor:
    fiber = dsfit.Fiber(
        alpha=alpha.unsqueeze(-1).expand(-1, 3), beta=beta.unsqueeze(-1).expand(-1, 3), dtype=theta_h.dtype
    )
    return lobes(fiber, theta_h)[..., 1]


def _scattered_longitudinal(theta_h: Tensor, alpha: Tensor, beta: Tensor, n: Tensor, beta_f: Tensor) -> Tensor:
    fiber = dsfit.Fiber(
        alpha=alpha.unsqueeze(-1).expand(-1, 3), beta=beta.unsqueeze(-1).expand(-1, 3), dtype=theta_h.dtype
    )
    return scattered_lobes(fiber, theta_h, (n * beta_f**2).unsqueeze(-1))[..., 1, 0]


def _transmittance(a_f: Tensor, n: Tensor) -> Tensor:
    bsdf = dsfit.DualScattering(dsfit.Fiber(dtype=a_f.dtype), d_f=1.0)
    return bsdf._transmittance(SimpleNamespace(a_f=a_f.unsqueeze(-1)), n)[..., 0]


def _albedo_naive(a_f: Tensor, a_b: Tensor) -> Tensor:
    gap = 1 - a_f**2
    return a_b * a_f**2 / gap + a_b**3 * a_f**2 / gap**3


def _shift_naive(a_f: Tensor, a_b: Tensor, alpha_f: Tensor, alpha_b: Tensor) -> Tensor:
    gap = 1 - a_f**2
    return alpha_b * (1 - 2 * a_b**2 / gap**2) + alpha_f * (2 * gap**2 + 4 * a_f**2 * a_b**2) / gap**3


def _width_naive(a_f: Tensor, a_b: Tensor, beta_f: Tensor, beta_b: Tensor, d_b: Tensor) -> Tensor:
    f2, b2 = beta_f**2, beta_b**2
    top = a_b * torch.sqrt(2 * f2 + b2) + a_b**3 * torch.sqrt(2 * f2 + 3 * b2)
    return (1 + d_b * a_f**2) * top / (a_b + a_b**3 * (2 * beta_f + 3 * beta_b))


_MASS = {"float64": (1e-12, 3e-12), "float32": (3e-5, 1e-3)}
_WINDOW = {
    "ordinary": product((1.5,), (0.125,), (0.3, -0.9), (0.5, -1.3, 2.6), most=3),
    "grazing: theta_diff 89.999 deg": product((1.0078125, 1.5, 3.0), (0.0, 0.125), (EDGE, -EDGE), (0.6, -2.5), most=3),
    "index: 1.01": product((1.01,), (0.0, 0.125), (0.2, 1.1), (0.6, -2.5), most=2),
    "index: 3": product((3.0,), (0.125,), (0.2,), (0.6, 2.5)),
    "clear": product((1.5,), (0.0, 1e-12), (0.3,), (0.6,)),
    "dark": product((1.5,), (10.0, 100.0, 1e4), (0.3,), (-2.5,)),
    "caustic: phi at 0, pi/2 and pi": product((1.5,), (0.125,), (0.3,), (0.0, _PI / 2, _PI)),
}


def _windows(p: int) -> Function:
    # next to an index of 1 what absorption leaves comes from offsets next to 1 alone, where the rule over all offsets
    # has few nodes: 5e-7 of a lobe that carries 1e-10 of the light, 5e-5 of one that carries 1e-17
    put_out = {"float64": (2e-6, 2e-6), "float32": (2e-4, 1e-3)}
    return Function(
        name=f"bsdf.N^G_{('R', 'TT')[p]}",
        arguments=("eta", "sigma_a", "theta_diff", "phi"),
        compute=lambda *columns: window(p, "raw", *columns),
        exact=lambda eta, sigma_a, theta_diff, phi: scattered.window(p, exact.Hair(eta, sigma_a), theta_diff, phi),
        regimes=_WINDOW | {"dark: index 1.01, sigma_a 20 and 50": [(1.01, s, 0.3, -2.5) for s in (20.0, 50.0)]},
        density=True,
        limits=_MASS,
        loose={"dark: index 1.01, sigma_a 20 and 50": put_out},
    )


_GAPS = (2.0**-10, 1e-7, 2.0**-23, 1e-12, 2.0**-52)
_BETAS = (0.01 * DEG, 7.5 * DEG, 60 * DEG)


FUNCTIONS: list[Function] = [
    _windows(0),
    _windows(1),
    Function(
        name="bsdf.N^G_TRT",
        arguments=("eta", "sigma_a", "theta_diff", "phi", "caustic_width"),
        compute=lambda *columns: window(2, "marschner", *columns),
        exact=lambda eta, sigma_a, theta_diff, phi, width: _window_trt(
            exact.Hair(eta, sigma_a, caustic_width=width, **GLINT), theta_diff, phi
        ),
        regimes={
            **{
                name: [(*point, 0.25) for point in points if point[3] != _PI]
                for name, points in _WINDOW.items()
                if name != "clear"
            },
            "narrow: glints of 0.1 to 1.5 deg": product((1.5,), (0.125,), (0.6,), (0.6,), (0.002, 0.026)),
            "wide: glints of 60 deg": product((1.5,), (0.125,), (0.3,), (0.6,), (1.0,)),
            "switch: eta' = 2 -+ 1e-8 to 0.01": [
                (1.5, 0.125, inclination_of(1.5, 2 + s * d), 0.6, 0.25) for d, s in ((1e-8, 1), (1e-2, -1))
            ],
        },
        density=True,
        limits=_MASS,
    ),
    Function(
        name="bsdf.N^G_TT simplified",
        arguments=("sigma_a", "theta_diff", "phi", "gamma_tt"),
        compute=lambda sigma_a, *columns: window(1, "simplified", torch.full_like(sigma_a, 1.5), sigma_a, *columns),
        exact=lambda sigma_a, theta_diff, phi, gamma: scattered.window_simplified(
            1, exact.Hair(1.5, sigma_a, gamma_tt=gamma), theta_diff, phi
        ),
        regimes={
            "ordinary": product((0.125,), (0.3,), (2.5, -1.7, 0.5), (0.5,)),
            "narrow: 0.001 rad": product((0.125,), (0.3,), (_PI, 1.6, -1.572, 1.5695), (1e-3,)),
            "wide: 3 to 50 rad": product((0.125,), (0.3,), (3.0, -0.1), (3.0, 8.0, 50.0)),
            "switch: gamma_TT = 2": product((0.125,), (0.3,), (3.0, 0.1), (2 - 1e-6, 2 + 1e-6)),
            "tail": product((0.125,), (0.3,), (0.0, 0.7), (0.125, 0.3)),
        },
        density=True,
        limits=_MASS,
        loose={"narrow": {"float64": (3e-12, 3e-12), "float32": (1e-3, 1e-3)}},  # angles are rounded to a part of it
    ),
    Function(
        name="bsdf.N^G_R simplified",
        arguments=("sigma_a", "theta_diff", "phi"),
        compute=lambda sigma_a, *columns: window(0, "simplified", torch.full_like(sigma_a, 1.5), sigma_a, *columns),
        exact=lambda sigma_a, theta_diff, phi: scattered.window_simplified(
            0, exact.Hair(1.5, sigma_a), theta_diff, phi
        ),
        regimes={
            "ordinary": product((0.125,), (0.3,), (2.5, -1.7, 0.5)),
            "caustic: phi at 0, pi/2 and pi": product((0.125,), (0.3,), (0.0, _PI / 2, -_PI / 2, _PI)),
        },
        density=True,
        limits=_MASS,
    ),
    Function(
        name="bsdf.M",
        arguments=("theta_h", "alpha", "beta"),
        compute=_longitudinal,
        exact=lambda theta_h, alpha, beta: exact.normal(theta_h - alpha, beta),
        regimes={
            "ordinary": product((0.1, -0.4), (-0.13, 0.07), (0.065, 0.26)),
            "narrow: beta 0.01 deg": [
                (a + k * 0.01 * DEG, a, 0.01 * DEG) for a in (-0.13, 0.07) for k in (0, 1, -4, 9)
            ],
            "wide: beta 60 deg": product((0.1, -1.5, 1.5), (-0.13, 0.2), (60 * DEG,)),
            "tail": product((1.5, -1.5), (0.1,), (0.13, 0.3)),
        },
        density=True,
        limits={"float64": (5e-14, 5e-14), "float32": (3e-5, 3e-5)},
    ),
    Function(
        name="bsdf.M^G",
        arguments=("theta_h", "alpha", "beta", "n", "beta_f"),
        compute=_scattered_longitudinal,
        exact=lambda theta_h, alpha, beta, n, beta_f: exact.normal(
            theta_h - alpha, (beta**2 + n * beta_f**2) ** 0.5
        ),
        regimes={
            "ordinary": product((0.1, -0.4), (0.07,), (0.065,), (1.0, 4.0), (0.1, 0.2)),
            "deep n": product((0.1, -1.5), (0.07,), _BETAS, (0.0, 1e-6, 0.3, 100.0, 1e4), (0.1,), most=16),
            "narrow: beta 0.01 deg": product((0.0701,), (0.07,), (0.01 * DEG,), (0.0, 1.0, 1e4), (0.01 * DEG,)),
        },
        density=True,
        limits={"float64": (5e-14, 5e-14), "float32": (3e-5, 3e-5)},
    ),
    Function(
        name="bsdf.A_b",
        arguments=("a_f", "a_b"),
        compute=lambda a_f, a_b: backscatter_albedo(a_f, a_b),  # looked up when called: faults are planted there
        exact=averages.back_albedo,
        regimes={
            "ordinary": product((0.5, 0.77), (0.05, 0.2)),
            "clear: a_f + a_b = 1, a_f near 1": [(1 - gap, gap) for gap in _GAPS],
            "clear: a_f near 1, a_b less": [(1 - gap, gap * 1e-3) for gap in _GAPS],
            "clear: a_b to 0": product((0.5, 0.999), (1e-30, 1e-12, 0.0)),
            "dark: a_f to 0": product((1e-20, 1e-12, 1e-6), (0.0, 0.03, 0.9)),
        },
        naive=_albedo_naive,
        density=True,
        limits={"float64": (1e-14, 1e-13), "float32": (2e-6, 1e-5)},
    ),
    Function(
        name="bsdf.Delta_b",
        arguments=("a_f", "a_b", "alpha_f", "alpha_b"),
        compute=back_shift,
        exact=averages.back_shift,
        regimes={
            "ordinary": product((0.5, 0.77), (0.05, 0.2), (0.05,), (-0.1,)),
            "clear: a_f + a_b = 1, a_f near 1": [(1 - gap, gap, 0.05, -0.1) for gap in _GAPS],
            "clear: a_b to 0": product((0.5, 0.999), (1e-30, 1e-12, 0.0), (0.05, 0.0), (-0.1,)),
            "dark: a_f to 0": product((1e-20, 1e-12, 1e-6), (0.0, 0.03, 0.9), (-0.13,), (-0.13,)),
        },
        naive=_shift_naive,
        scale=lambda a_f, a_b, alpha_f, alpha_b, value: abs(alpha_f) + abs(alpha_b),  # two shifts may cancel
        limits={"float64": (1e-14, 1e-13), "float32": (2e-6, 1e-5)},
    ),
    Function(
        name="bsdf.sigma_b",
        arguments=("a_f", "a_b", "beta_f", "beta_b", "d_b"),
        compute=back_width,
        exact=averages.back_width,
        regimes={
            "ordinary": product((0.5, 0.77), (0.05, 0.2), (0.1,), (0.2,), (0.7,)),
            "clear: a_f near 1": [(1 - gap, gap, 0.1, 0.2, 0.7) for gap in _GAPS],
            "clear: a_b to 0": product((0.5, 0.999), (1e-30, 1e-12, 0.0), (0.1,), (0.2,), (0.0, 1.0)),
            "dark: a_f to 0": product((1e-20, 1e-6), (0.0, 0.03, 0.9), (0.1,), (0.2,), (0.0, 1.0)),
            "narrow: beta 0.01 deg": product((0.5,), (0.1,), (0.01 * DEG, 0.1), (0.01 * DEG,), (0.7,)),
        },
        naive=_width_naive,
        density=True,
        limits={"float64": (1e-14, 1e-13), "float32": (2e-6, 1e-5)},
    ),
    Function(
        name="bsdf.a_f^n",
        arguments=("a_f", "n"),
        compute=_transmittance,
        exact=lambda a_f, n: a_f**n,
        regimes={
            "ordinary": product((0.3, 0.77), (1.0, 3.0, 7.0)),
            "deep n": product((0.3, 0.77, 0.999), (0.0, 0.3, 2.5, 100.0, 1e4), most=15),
            "clear: a_f near 1": product((1 - 1e-7, 1 - 2.0**-50, 1.0), (0.5, 1e4)),
            "dark: a_f to 0": product((1e-30, 1e-12, 1e-6), (0.0, 0.3, 1.0, 2.5)),
        },
        naive=lambda a_f, n: torch.exp(n * torch.log(a_f)),
        density=True,
        limits={"float64": (1e-14, 1e-13), "float32": (2e-6, 1e-5)},
    ),
]
