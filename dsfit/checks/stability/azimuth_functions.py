"""Rows of the atlas: azimuthal laws as functions of scalars, densities and samplers."""

from __future__ import annotations

import math
from collections.abc import Callable

import mpmath as mp
import torch
from torch import Tensor

from dsfit.checks.stability import twins
from dsfit.checks.stability.function import Function, Point
from dsfit.checks.stability.limits import FEW_ULPS, within
from dsfit.checks.stability.points import product
from dsfit.proposals.azimuth import CosineHalfLaw, TruncatedGaussianLaw, WrappedGaussianLaw
from dsfit.proposals.uniform import UniformArcLaw

ENDS = (1e-30, 2e-38, 1e-7, 1 - 2**-24, 1 - 2**-53)
MIDDLES = (0.03, 0.31, 0.64, 0.97)
BEFORE_PI = math.pi - 1e-6

_AROUND = (-2.9, -1.2, 0.4, 1.9, 3.1)

DENSITIES: dict[str, list[Point]] = {
    "ordinary: gamma 10 to 60 deg": product(_AROUND, [0.2, 0.5, 1.0], most=12),
    "narrow: 0.06 and 0.006 deg": [(math.pi - k * s, s) for s in (1e-3, 1e-4) for k in (0.7, 1.2, 3.0, 12.0)],
    "wide: to 50 rad": product(_AROUND, [3.0, 10.0, 50.0], most=10),
    "tail: the back of a narrow law": product([-0.5, 0.1, 1.0], [0.01, 0.05, 0.1], most=9),
    "caustic: the seam at 0 and pi": product([1e-9, -1e-5, 3.1415, -BEFORE_PI], [0.3, 1.0], most=8),
}
_EDGES = tuple(math.pi / 2 + x for x in (-2e-3, 1e-3, 0.05))
WINDOWS: dict[str, list[Point]] = {
    **{name: rows for name, rows in DENSITIES.items() if not name.startswith("narrow")},
    "narrow: 0.06 and 0.006 deg": product([0.2, 1.4, 3.0], [1e-3, 1e-4])
    + [(math.pi / 2 + k * s, s) for s in (1e-3, 1e-4) for k in (-3.1, -0.6, 1.3, 4.0)],
    "switch: widths next to 0.045, 0.14 and 0.9": product([*_EDGES, 2.2], [0.0449, 0.0451, 0.139, 0.141, 0.899, 0.901]),
}


def _phi(law: Callable[[Tensor], object]) -> Callable[..., Tensor]:
    """The density of an azimuthal law as a function of phi and its width."""
    return lambda phi, std: law(std).log_prob(phi, torch.zeros_like(phi))


def _turned(law: Callable[[Tensor], object]) -> Callable[..., Tensor]:
    return lambda phi, std: law(std).scattered_log_prob(phi, torch.zeros_like(phi))


def _drawn(law: Callable[[Tensor], object]) -> Callable[..., Tensor]:
    return lambda u, std: law(std).sample(u.unsqueeze(-1), torch.zeros_like(u))


def _wrap(x: mp.mpf) -> mp.mpf:
    return x - 2 * mp.pi * mp.nint(x / (2 * mp.pi))


def _on_circle(twin: Callable[..., mp.mpf]) -> Callable[..., mp.mpf]:
    """NaN beyond pi, which float32 rounds up."""
    return lambda phi, *rest: twin(phi, *rest) if abs(phi) <= mp.pi else mp.nan


def _open(twin: Callable[..., mp.mpf]) -> Callable[..., mp.mpf]:
    return lambda u, *rest: twin(u, *rest) if 0 < u < 1 else mp.nan


def _truncated_density(phi: mp.mpf, std: mp.mpf) -> mp.mpf:
    return twins.truncated_log_density(_wrap(mp.pi - phi), mp.mpf(0), std, -mp.pi, mp.pi)


def _distance(phi: mp.mpf) -> mp.mpf:
    return abs(_wrap(phi - mp.pi))


def _cosine_window(phi: mp.mpf) -> mp.mpf:
    """(1/pi) int cos(x/2) / 4 over the half circle about phi, by its antiderivative on each piece."""
    start, end = abs(phi) - mp.pi / 2, abs(phi) + mp.pi / 2
    total = mp.sin(min(end, mp.pi) / 2) - mp.sin(start / 2)
    if end > mp.pi:
        total += mp.sin((end - 2 * mp.pi) / 2) + 1
    return total / (2 * mp.pi)


def _naive_images(x: Tensor, std: Tensor) -> Tensor:
    images = [torch.exp(-0.5 * ((x + 2 * math.pi * k) / std) ** 2) for k in (-1, 0, 1)]
    return torch.log(sum(images) / (std * math.sqrt(2 * math.pi)))


def _naive_window(phi: Tensor, std: Tensor) -> Tensor:
    total = torch.zeros_like(phi)
    for k in (-1, 0, 1):
        d = phi - math.pi + 2 * math.pi * (k + (phi < 0).to(phi.dtype))
        total = total + torch.special.ndtr((d + math.pi / 2) / std) - torch.special.ndtr((d - math.pi / 2) / std)
    return torch.log(total / math.pi)


def _naive_truncated(phi: Tensor, std: Tensor) -> Tensor:
    x = torch.remainder(math.pi - phi + math.pi, 2 * math.pi) - math.pi
    mass = torch.special.ndtr(math.pi / std) - torch.special.ndtr(-math.pi / std)
    return torch.log(torch.exp(-0.5 * (x / std) ** 2) / (std * math.sqrt(2 * math.pi) * mass))


def _naive_drawn(u: Tensor, std: Tensor) -> Tensor:
    x = math.pi - std * math.sqrt(2) * torch.erfinv(2 * u - 1)
    return torch.remainder(x + math.pi, 2 * math.pi) - math.pi


_COSINE = {
    "ordinary": [(x,) for x in (-2.0, -0.4, 0.01, 1.3)],
    "caustic: the seam at pi": [(x,) for x in (3.14, -3.1415, BEFORE_PI, math.nextafter(math.pi, 0))],
}
_TURNED = {
    "ordinary": [(x,) for x in (-2.0, -0.4, 0.01, 1.3, 2.6)],
    "caustic: the seam at pi": [(x,) for x in (3.14, -3.1415, BEFORE_PI)],
    "switch: at 90 deg": [(x,) for x in (1.5707, 1.5709, -1.57079, -1.5708)],
}
_SAMPLES = {
    "ordinary: gamma 10 to 60 deg": product(MIDDLES, [0.2, 0.5, 1.0]),
    "narrow: 0.06 and 0.006 deg": product(MIDDLES, [1e-3, 1e-4]),
    "wide: to 50 rad": product(MIDDLES, [3.0, 10.0, 50.0]),
    "ends of u": product(ENDS, [1e-3, 0.3], most=10),
}


def _one(*_: float) -> float:
    """Angles on the circle: an error counts against a radian."""
    return 1.0


FUNCTIONS: list[Function] = [
    Function(
        "cosine_azimuth.log_prob",
        ("phi",),
        lambda phi: CosineHalfLaw().log_prob(phi, phi),
        _on_circle(lambda phi: mp.log(mp.cos(phi / 2) / 4)),
        _COSINE,
        logarithm=True,
        limits=FEW_ULPS,
    ),
    Function(
        "cosine_azimuth.sample",
        ("u",),
        lambda u: CosineHalfLaw().sample(u.unsqueeze(-1), u),
        _open(lambda u: 2 * mp.asin(2 * u - 1)),
        {"ordinary": [(u,) for u in MIDDLES], "ends of u": [(u,) for u in (1e-300, *ENDS)]},
        naive=lambda u: 2 * torch.asin(2 * u - 1),
        scale=_one,
        limits=FEW_ULPS,
    ),
    Function(
        "cosine_azimuth.scattered",
        ("phi",),
        lambda phi: CosineHalfLaw().scattered_log_prob(phi, phi),
        _on_circle(lambda phi: mp.log(_cosine_window(phi))),
        _TURNED,
        logarithm=True,
        limits=FEW_ULPS,
    ),
    Function(
        "wrapped_azimuth.log_prob",
        ("phi", "gamma"),
        _phi(WrappedGaussianLaw),
        _on_circle(lambda phi, std: mp.log(twins.wrapped(mp.pi - phi, std))),
        DENSITIES,
        naive=lambda phi, std: _naive_images(math.pi - phi, std),
        logarithm=True,
        limits=FEW_ULPS,
    ),
    Function(
        "wrapped_azimuth.sample",
        ("u", "gamma"),
        _drawn(WrappedGaussianLaw),
        _open(lambda u, std: _wrap(mp.pi - std * twins.quantile(u))),
        _SAMPLES | {"ends of u: 1e-300": [(1e-300, 1e-3), (1e-300, 0.05)]},
        naive=_naive_drawn,
        scale=_one,
        limits=FEW_ULPS,
        loose={
            "wide": within(4e-14, 1e-14, 3e-5, 1e-5),
            "ends of u": within(2e-15, 6e-13, 2e-6, 5e-5),
        },
    ),
    Function(
        "wrapped_azimuth.scattered",
        ("phi", "gamma"),
        _turned(WrappedGaussianLaw),
        _on_circle(lambda phi, std: mp.log(twins.wrapped_window(_distance(phi), std))),
        WINDOWS,
        naive=_naive_window,
        logarithm=True,
        limits=FEW_ULPS,
        loose={
            "ordinary": within(4e-15, 4e-14, 2e-6, 2e-5),
            "tail": within(3e-15, 2e-13, 2e-6, 1e-5),
            "caustic": within(2e-15, 3e-11, 2e-6, 7e-3),
            "narrow": within(5e-12, 4e-11, 2e-3, 2e-2),
            "switch": within(8e-15, 2e-9, 5e-6, 5e-4),
        },
    ),
    Function(
        "truncated_azimuth.log_prob",
        ("phi", "gamma"),
        _phi(TruncatedGaussianLaw),
        _on_circle(_truncated_density),
        {name: rows for name, rows in DENSITIES.items() if "seam" not in name}
        | {"caustic: the seam at pi": product([3.1415, -3.14159, -BEFORE_PI], [0.3, 1.0])},
        naive=_naive_truncated,
        logarithm=True,
        limits=FEW_ULPS,
        loose={
            "wide": within(2e-15, 3e-11, 2e-6, 4e-3),
        },
    ),
    Function(
        "truncated_azimuth.sample",
        ("u", "gamma"),
        _drawn(TruncatedGaussianLaw),
        _open(lambda u, std: _wrap(mp.pi - twins.truncated_quantile(u, mp.mpf(0), std, -mp.pi, mp.pi))),
        _SAMPLES,
        scale=_one,
        limits=FEW_ULPS,
        loose={
            "wide": within(2e-14, 2e-11, 8e-6, 6e-3),
            "ends of u": within(5e-15, 2e-13, 2e-6, 6e-5),
        },
    ),
    Function(
        "truncated_azimuth.scattered",
        ("phi", "gamma"),
        _turned(TruncatedGaussianLaw),
        _on_circle(lambda phi, std: mp.log(twins.truncated_window(_distance(phi), std))),
        {name: rows for name, rows in WINDOWS.items() if "seam" not in name},
        logarithm=True,
        limits=FEW_ULPS,
        loose={
            "wide": within(7e-15, 1e-11, 2e-6, 3e-3),
            "narrow": within(5e-12, 4e-11, 2e-3, 2e-2),
            "switch": within(8e-15, 2e-9, 5e-6, 7e-4),
        },
    ),
    Function(
        "front_half.scattered",
        ("phi",),
        lambda phi: UniformArcLaw("front").scattered_log_prob(phi, phi),
        _on_circle(lambda phi: mp.log(abs(phi) / mp.pi**2)),
        {"ordinary": [(x,) for x in (-2.0, 0.4, 1.3, 3.0)], "tail: to 0": [(1e-3,), (-1e-10,), (1e-30,)]},
        logarithm=True,
        limits=FEW_ULPS,
    ),
]
