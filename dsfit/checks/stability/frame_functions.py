"""Rows of the atlas: angles of the fibre frame, and lights of any concentration."""

from __future__ import annotations

import math

import mpmath as mp
import torch
from torch import Tensor

from dsfit.checks.stability.function import Function, Point
from dsfit.checks.stability.limits import FEW_ULPS, within
from dsfit.checks.stability.points import deg, product
from dsfit.context import Context
from dsfit.frame import cos_inclination, to_angles, to_vector, wrap
from dsfit.scene.lights.lobes import VonMisesFisherLights, log_normaliser

HALF_PI = math.pi / 2
AXIS = (0.3, 0.2)
"""theta, phi of the lobe's mean direction, radians."""


def _wrap_twin(x: mp.mpf) -> mp.mpf:
    return x - 2 * mp.pi * mp.nint(x / (2 * mp.pi))


_DIRECTIONS: dict[str, list[Point]] = {
    "ordinary": product(deg(-60.0, 0.4, 35.0), [-2.5, 0.3, 1.9], most=8),
    "grazing: theta to 89.99999 deg": product(deg(89.9, -89.999, 89.99999), [-2.5, 0.3, 1.9], most=8),
    "grazing: theta = 90 deg": product([HALF_PI, -HALF_PI], [-2.5, 0.3, 1.9]),
    "caustic: phi next to 0 and pi": product(deg(-60.0, 35.0), [1e-12, -1e-30, 3.141592, -3.14159]),
}


def _in_range(theta: mp.mpf, value: mp.mpf) -> mp.mpf:
    """NaN beyond 90 degrees, which float32 rounds up."""
    return value if abs(theta) <= mp.pi / 2 else mp.nan


def _whole(*_: float) -> float:
    """Derivatives there and back are 1 and 0."""
    return 1.0


def _there_and_back(theta: Tensor, phi: Tensor) -> Tensor:
    return to_angles(to_vector(torch.stack([theta, phi], dim=-1)))


def _naive_theta(theta: Tensor, phi: Tensor) -> Tensor:
    return torch.asin(to_vector(torch.stack([theta, phi], dim=-1))[..., 0])


def _naive_phi(theta: Tensor, phi: Tensor) -> Tensor:
    _, y, z = to_vector(torch.stack([theta, phi], dim=-1)).unbind(-1)
    return torch.copysign(torch.acos(y / torch.sqrt(y * y + z * z)), z)


def _log_lobe(theta: Tensor, phi: Tensor, kappa: Tensor) -> Tensor:
    light = VonMisesFisherLights([list(AXIS)] * len(theta), kappa)
    return light.log_shapes(torch.stack([theta, phi], dim=-1)).diagonal()


def _log_lobe_twin(theta: mp.mpf, phi: mp.mpf, kappa: mp.mpf) -> mp.mpf:
    mean_theta, mean_phi = (mp.mpf(x) for x in AXIS)
    half = mp.sin((theta - mean_theta) / 2) ** 2
    half += mp.cos(theta) * mp.cos(mean_theta) * mp.sin((phi - mean_phi) / 2) ** 2
    return _normaliser_twin(kappa) - 2 * kappa * half


def _normaliser_twin(kappa: mp.mpf) -> mp.mpf:
    return mp.log(kappa / (2 * mp.pi * -mp.expm1(-2 * kappa)))


def _naive_normaliser(kappa: Tensor) -> Tensor:
    return torch.log(kappa / (4 * math.pi * torch.sinh(kappa))) + kappa


def _naive_lobe(theta: Tensor, phi: Tensor, kappa: Tensor) -> Tensor:
    mean = to_vector(torch.tensor(AXIS, dtype=theta.dtype))
    angle = torch.acos(to_vector(torch.stack([theta, phi], dim=-1)) @ mean)
    return torch.log(kappa / (4 * math.pi * torch.sinh(kappa)) * torch.exp(kappa * torch.cos(angle)))


def _angle_drawn(u: Tensor, kappa: Tensor) -> Tensor:
    """Angle to the axis between a drawn direction and the axis of its lobe, theta = phi = 0."""
    found = []
    for share, k in zip(u, kappa, strict=True):
        law = VonMisesFisherLights([[0.0, 0.0]], k).proposal()(Context(torch.zeros((), dtype=u.dtype)))
        found.append(to_vector(law.sample(torch.stack([share.new_tensor(0.5), share, share.new_tensor(1e-30)]))))
    x, y, z = torch.stack(found).unbind(-1)
    return torch.atan2(torch.sqrt(x * x + z * z), y)


def _angle_drawn_twin(u: mp.mpf, kappa: mp.mpf) -> mp.mpf:
    if not 0 < u < 1:
        return mp.nan
    return 2 * mp.asin(mp.sqrt(-mp.log1p(u * mp.expm1(-2 * kappa)) / (2 * kappa)))


def _naive_angle(u: Tensor, kappa: Tensor) -> Tensor:
    """v log(e^(1/v) - 2 u sinh(1/v)), v = 1 / kappa, as in d'Eon et al. (2011) before it was made stable."""
    return torch.acos(torch.log(torch.exp(kappa) - 2 * u * torch.sinh(kappa)) / kappa)


def _near_axis(kappas: list[float]) -> list[Point]:
    offsets = ((0.0, 0.7), (-1.1, 0.4), (2.0, -2.5), (0.3, 6.0))
    return [(AXIS[0] + a / math.sqrt(k), AXIS[1] + b / math.sqrt(k), k) for k in kappas for a, b in offsets]


FUNCTIONS: list[Function] = [
    Function(
        "frame.wrap",
        ("angle",),
        wrap,
        _wrap_twin,
        {
            "ordinary: a few turns": [(x,) for x in (-9.0, -3.0, 0.4, 2.0, 5.0, 14.0)],
            "wide: thousands of turns": [(x,) for x in (1e3 + 0.5, -1e4, 1e5)],
            "caustic: next to the seam": [(x,) for x in (3.14159, 3.1416, -9.4247, 9.4248)],
        },
        naive=lambda x: torch.atan2(torch.sin(x), torch.cos(x)),
        scale=lambda x, value: 1.0,
        limits=FEW_ULPS,
        loose={
            "wide": within(5e-12, 1e-14, 7e-3, 1e-5),
        },
    ),
    Function(
        "frame.cos_inclination",
        ("theta",),
        cos_inclination,
        lambda theta: _in_range(theta, mp.cos(theta)),
        {
            "ordinary": [(x,) for x in deg(-60.0, 0.4, 35.0)],
            "grazing: theta to 90 deg": [(x,) for x in (*deg(89.9, -89.999, 89.99999), HALF_PI)],
        },
        density=True,
        limits=FEW_ULPS,
    ),
    Function(
        "frame.theta_there_and_back",
        ("theta", "phi"),
        lambda theta, phi: _there_and_back(theta, phi)[..., 0],
        lambda theta, phi: _in_range(theta, theta),
        _DIRECTIONS,
        naive=_naive_theta,
        gradient_scale=_whole,
        limits=FEW_ULPS,
    ),
    Function(
        "frame.phi_there_and_back",
        ("theta", "phi"),
        lambda theta, phi: _there_and_back(theta, phi)[..., 1],
        lambda theta, phi: _in_range(theta, phi),
        _DIRECTIONS,
        naive=_naive_phi,
        gradient_scale=_whole,
        limits=FEW_ULPS,
        loose={
            "grazing": within(2e-15, 5.0, 2e-6, 1.0),
        },
    ),
    Function(
        "light.log_normaliser",
        ("kappa",),
        log_normaliser,
        _normaliser_twin,
        {
            "ordinary": [(x,) for x in (0.5, 3.0, 20.0)],
            "wide: kappa to 1e-6": [(x,) for x in (1e-6, 1e-3)],
            "narrow: kappa to 1e12": [(x,) for x in (800.0, 1e4, 1e8, 1e12)],
            "switch: next to 0.01": [(0.00999,), (0.01001,)],
        },
        naive=_naive_normaliser,
        logarithm=True,
        limits=FEW_ULPS,
        loose={
            "switch": within(2e-15, 1e-14, 2e-6, 3e-5),
        },
    ),
    Function(
        "light.log_density",
        ("theta", "phi", "kappa"),
        _log_lobe,
        _log_lobe_twin,
        {
            "ordinary": _near_axis([3.0, 40.0]),
            "wide: kappa to 1e-3": [(-1.0, 2.0, 1e-3), (0.9, -3.0, 1e-3), (-0.2, 0.5, 0.2)],
            "narrow: kappa 1e4 and 1e6": _near_axis([1e4, 1e6]),
            "tail: far from a narrow lobe": [(-1.0, 2.0, 1e3), (0.9, -3.0, 1e6), (-0.2, 0.5, 1e4)],
        },
        naive=_naive_lobe,
        logarithm=True,
        limits=FEW_ULPS,
        loose={
            "ordinary": within(2e-15, 1e-14, 2e-6, 6e-5),
            "narrow": within(5e-14, 2e-10, 2e-5, 4e-1),
        },
    ),
    Function(
        "light.sample",
        ("u", "kappa"),
        _angle_drawn,
        _angle_drawn_twin,
        {
            "ordinary": product([0.03, 0.4, 0.8], [3.0, 40.0]),
            "wide: kappa to 1e-3": product([0.03, 0.4, 0.45], [1e-3, 0.1]),
            "narrow: kappa to 1e6": product([0.03, 0.4, 0.97], [800.0, 1e4, 1e6]),
            "ends of u": product([1e-30, 1e-10, 1 - 2**-24, 1 - 2**-53], [20.0, 1e4]),
        },
        naive=_naive_angle,
        gradients=(),
        limits=FEW_ULPS,
    ),
]
