"""Entries: averages over one scattering event, and the whole F cos(theta_i).

The averages of a fibre are tabulated once, to a relative tolerance of 1e-11 of the largest of them, which is what their
limits in float64 show; all else is rounding. The fibres' numbers are exact in float32, so that both dtypes have the
same fibre; it is not differentiated here (`dsfit.checks.gradients` does).

Next to grazing, theta_diff = (theta_r - theta_i)/2 is rounded, to eps/cos(theta_diff) of its cosine, whose square
divides F: float32 keeps two digits of F at 89.999 degrees on opposite sides.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import torch
from mpmath import mp
from torch import Tensor

import dsfit
from dsfit.checks.stability import exact_bsdf_averages as averages
from dsfit.checks.stability.bsdf_azimuth import GLINT
from dsfit.checks.stability.bsdf_optics import EDGE
from dsfit.checks.stability.exact_bsdf import Hair, Real
from dsfit.checks.stability.function import Function, Point
from dsfit.checks.stability.points import DEG

_FIBER = ("eta", "sigma_a", "alpha", "beta")
_SHIFTS, _WIDTHS = (1.0, -0.5, -1.5), (1.0, 0.5, 2.0)
_D, _WIDTH, _GAMMA = 0.75, 0.25, 0.5
_HAIR = (1.5, 0.125, -0.125, 0.125)
_CLEAR = (1.5, 0.0, -0.125, 0.125)
_NEAR_ONE = (1.0078125, 0.0, -0.0078125, 0.015625)
_DENSE = (3.0, 0.125, -0.125, 0.125)
_OPAQUE = (1.5, 10000.0, -0.125, 0.125)
_DARK = (1.5, 8.0, -0.125, 0.125)
_NEEDLE = (1.5, 0.125, -0.125, 2.0**-13)
_BROAD = (1.5, 0.125, -0.125, 0.5)
_WORST = (3.0, 10000.0, -0.125, 2.0**-13)


@functools.lru_cache(maxsize=64)
def _bsdf(fiber: tuple[float, ...], model: str) -> dsfit.DualScattering:
    eta, sigma_a, alpha, beta = fiber
    made = dsfit.Fiber(
        eta=eta, sigma_a=[sigma_a], alpha=[s * alpha for s in _SHIFTS], beta=[w * beta for w in _WIDTHS],
        caustic_width=_WIDTH, gamma_tt=_GAMMA, **GLINT,
    )  # fmt: skip
    return dsfit.DualScattering(made, d_f=_D, d_b=_D, azimuthal=model)


def _coat(eta: Real, sigma_a: Real, alpha: Real, beta: Real, model: str = "marschner") -> averages.Coat:
    hair = Hair(mp.mpf(eta), mp.mpf(sigma_a), caustic_width=_WIDTH, gamma_tt=_GAMMA, **GLINT)
    shifts, widths = tuple(s * alpha for s in _SHIFTS), tuple(w * beta for w in _WIDTHS)
    return averages.Coat(hair, shifts, widths, _D, _D, model)


def by_fiber(evaluate: Callable[..., Tensor], model: str, *columns: Tensor) -> Tensor:
    """`evaluate(bsdf, *angles)` for columns eta, sigma_a, alpha, beta, *angles, one fibre at a time."""
    rows = list(zip(*(column.tolist() for column in columns[:4]), strict=True))
    angles = columns[4:]
    parts, order = [], []
    for fiber in dict.fromkeys(rows):
        which = torch.tensor([i for i, row in enumerate(rows) if row == fiber])
        parts.append(evaluate(_bsdf(fiber, model), *(x[which] for x in angles)))
        order.append(which)
    return torch.cat(parts)[torch.argsort(torch.cat(order))]


def _average(field: str, full: bool) -> Function:
    fine = {"float64": (2e-10, 1e-8), "float32": (3e-7, 1e-6)}
    regimes = {
        "ordinary": [(*_HAIR, t) for t in (0.3, -0.9)],
        "dark: sigma_a 1e4": [(*_OPAQUE, 0.3)],
        "grazing: 89.999 deg": [(*_HAIR, EDGE), (*_HAIR, -EDGE)],
        "narrow: beta 0.007 deg": [(*_NEEDLE, 0.3)],
    }
    if full:
        regimes |= {
            "clear": [(*_CLEAR, 0.1)],
            "clear: a_f near 1": [(*_NEAR_ONE, t) for t in (0.1, -1.2)],
            "dark: sigma_a 8": [(*_DARK, -0.5)],
            "wide: beta 14 to 57 deg": [(*_BROAD, t) for t in (0.3, -1.4)],
            "index: 3": [(*_DENSE, t) for t in (0.3, -1.5, EDGE)],
        }
    return Function(
        name=f"bsdf.{field}",
        arguments=(*_FIBER, "theta_in"),
        compute=lambda *columns: by_fiber(lambda b, t: getattr(b.averages(t), field)[..., 0], "marschner", *columns),
        exact=lambda *numbers: getattr(averages.averages(_coat(*numbers[:4]), numbers[4]), field),
        regimes=regimes,
        gradients=("theta_in",),
        limits=fine,
    )


def _albedo(*numbers: Real) -> Real:
    mean = averages.averages(_coat(*numbers[:4]), numbers[4])
    return averages.back_albedo(mean.a_f, mean.a_b)


_ANGLES = ("n", "v", "theta_i", "theta_r", "phi")


def _whole(name: str, model: str, regimes: dict[str, list[Point]]) -> Function:
    def compute(*columns: Tensor) -> Tensor:
        return by_fiber(
            lambda b, n, v, theta_i, theta_r, phi: b(theta_i, theta_r, phi, n, v)[..., 0], model, *columns
        )

    def exact(*numbers: Real) -> Real:
        n, v, theta_i, theta_r, phi = numbers[4:]
        return averages.scattering(_coat(*numbers[:4], model), theta_i, theta_r, phi, n, v)

    deep = {"float64": (5e-8, 1e-7), "float32": (2e-3, 1e-3)}
    opposite = {"float64": (3e-11, 1e-9), "float32": (2e-2, 2e-2)}
    return Function(
        name=name,
        arguments=(*_FIBER, *_ANGLES),
        compute=compute,
        exact=exact,
        regimes=regimes,
        gradients=_ANGLES,
        density=True,
        limits={"float64": (1e-10, 1e-9), "float32": (3e-5, 1e-4)},
        # a_f^n has n times the error of a_f, which is 1e-12 of the table, or the rounding of a_f to float32
        loose={"grazing: 89.999 deg on opposite sides": opposite, "deep n": deep},
    )


def _directions(fiber: Point, n: float, v: float, *directions: Point) -> list[Point]:
    return [(*fiber, n, v, *angles) for angles in directions]


_USUAL = ((-0.3, 0.4, -2.8), (0.5, -0.6, 1.0))
_ACROSS = ((-EDGE, EDGE, 2.5), (EDGE, -89.99 * DEG, -2.9))
_ASIDE = ((EDGE, EDGE, 0.3), (0.2, EDGE, -2.8), (-EDGE, 0.4, 2.8))


FUNCTIONS: list[Function] = [
    *(_average(field, full=True) for field in ("a_f", "a_b")),
    *(_average(field, full=False) for field in ("alpha_f", "alpha_b", "beta_f", "beta_b")),
    Function(
        name="bsdf.A_b of a fibre",
        arguments=(*_FIBER, "theta_in"),
        compute=lambda *columns: by_fiber(lambda b, t: b.averages(t).A_b[..., 0], "marschner", *columns),
        exact=_albedo,
        regimes={"ordinary": [(*_HAIR, 0.3)], "clear: a_f near 1": [(*_NEAR_ONE, t) for t in (0.1, -0.4)]},
        gradients=("theta_in",),
        # the table's 1e-12 of a_f is divided by 1 - a_f = 0.01, and its derivative by the square
        loose={"clear: a_f near 1": {"float64": (2e-9, 2e-6)}},
    ),
    _whole(
        "bsdf.F direct",
        "marschner",
        {
            "ordinary": _directions(_HAIR, 0.0, 1.0, *_USUAL),
            "clear: a_f near 1": _directions(_NEAR_ONE, 0.0, 1.0, (-0.3, 0.31, -3.1)),
            "dark: sigma_a 1e4": _directions(_OPAQUE, 0.0, 1.0, _USUAL[0]),
            "narrow: beta 0.007 deg": _directions(_NEEDLE, 0.0, 1.0, (-0.3, 0.0502, 1.0), (0.5, -0.3751, 3.0)),
            "index: 3": _directions(_DENSE, 0.0, 1.0, _USUAL[1]),
            "grazing: 89.999 deg on one side": _directions(_HAIR, 0.0, 1.0, _ASIDE[0], _ASIDE[2]),
            "grazing: 89.999 deg on opposite sides": [
                point for f in (_DENSE, _WORST) for point in _directions(f, 0.0, 1.0, _ACROSS[1])
            ],
        },
    ),
    _whole(
        "bsdf.F scattered",
        "marschner",
        {
            "ordinary": _directions(_HAIR, 2.5, 0.0, _USUAL[0]) + _directions(_HAIR, 4.0, 0.3, _USUAL[1]),
            "deep n: a_f near 1": _directions(_NEAR_ONE, 1e4, 0.0, (-0.3, 0.31, -3.1)),
            "deep n": _directions(_HAIR, 100.0, 0.0, _USUAL[1]),
            "grazing: 89.999 deg on one side": _directions(_HAIR, 1.0, 0.0, _ASIDE[1]),
            "grazing: 89.999 deg on opposite sides": [
                point for f in (_DENSE, _WORST) for point in _directions(f, 0.3, 0.0, _ACROSS[0])
            ],
        },
    ),
    _whole(
        "bsdf.F simplified",
        "simplified",
        {
            "ordinary": _directions(_HAIR, 2.5, 0.3, *_USUAL),
            "deep n": _directions(_HAIR, 1e4, 0.5, _USUAL[0]) + _directions(_NEAR_ONE, 1e4, 0.0, (-0.3, 0.31, -3.1)),
            "dark: sigma_a 1e4": _directions(_OPAQUE, 0.3, 0.3, _USUAL[0]),
            "grazing: 89.999 deg on one side": _directions(_HAIR, 0.3, 0.3, _ASIDE[2]),
            "grazing: 89.999 deg on opposite sides": [
                point for f in (_HAIR, _WORST) for point in _directions(f, 0.3, 0.3, _ACROSS[1])
            ],
        },
    ),
]
