"""Azimuthal laws of the chapter: cos(phi/2) for R and TRT, a Gaussian about phi = pi for TT, and N^G of each."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from dsfit.context import Context
from dsfit.errors import InputError
from dsfit.frame import HALF_PI, TWO_PI, wrap
from dsfit.proposals.base import Azimuthal, AzimuthalDistribution, BatchFields
from dsfit.proposals.parameters import AZIMUTH_STD_BOUNDS, Bounded
from dsfit.special import (
    Branch,
    log_normal_mass,
    piecewise,
    truncated_normal_icdf,
    truncated_normal_log_prob,
    wrapped_normal_log_prob,
)

_LOG_PI = math.log(math.pi)


def _clamp_open(u: Tensor) -> Tensor:
    return u.clamp(torch.finfo(u.dtype).tiny, 1 - torch.finfo(u.dtype).eps / 2)


_PI_TAIL = {torch.float64: 1.2246467991473532e-16, torch.float32: -8.742277657347586e-08}
"""What pi has beyond its rounding to the dtype."""


def _from_forward(phi: Tensor) -> Tensor:
    """Distance `pi - |phi|` from the forward direction, with all digits where phi is next to pi: narrow laws need
    them."""
    return (math.pi - phi.abs()) + _PI_TAIL[phi.dtype]


@dataclass(frozen=True)
class CosineHalfLaw(BatchFields, AzimuthalDistribution):
    """`p(phi) = cos(phi / 2) / 4`; see `CosineHalf`."""

    def sample(self, u: Tensor, theta_i: Tensor) -> Tensor:
        v = u[..., 0]
        return 2 * torch.atan2(2 * v - 1, 2 * torch.sqrt(v * (1 - v)))

    def log_prob(self, phi: Tensor, theta_i: Tensor) -> Tensor:
        cosine = torch.cos(phi / 2)
        return torch.log(cosine.clamp_min(torch.finfo(cosine.dtype).eps ** 2)) - math.log(4)

    def scattered_log_prob(self, phi: Tensor, theta_i: Tensor) -> Tensor:
        """`(sqrt 2 / (2 pi)) cos(phi/2)` for |phi| <= pi/2, `1/pi - (sqrt 2 / (2 pi)) sin(|phi|/2)` beyond."""
        size = phi.abs()
        front = size > HALF_PI
        c = math.sqrt(0.5) / math.pi
        near = c * torch.cos(torch.where(front, 0.0, size) / 2)
        return torch.log(torch.where(front, 1 / math.pi - c * torch.sin(size / 2), near))


class CosineHalf(Azimuthal):
    """N_R = N_TRT of the simplified model: `p(phi) = cos(phi/2) / 4`, `phi = 2 asin(2 u - 1)`.

    Chapter eqs (25)-(31) with the inverse CDF corrected. By atan2, so that cos(phi/2), which is 2 sqrt(u (1 - u)), is
    never negative. No parameters.
    """

    def forward(self, context: Context) -> CosineHalfLaw:
        return CosineHalfLaw()


@dataclass(frozen=True)
class WrappedGaussianLaw(BatchFields, AzimuthalDistribution):
    """phi = wrap(pi - x), x ~ N(0, std) on the line; `std` `[*batch]`, radians."""

    std: Tensor

    def sample(self, u: Tensor, theta_i: Tensor) -> Tensor:
        return wrap(math.pi - self.std * torch.special.ndtri(_clamp_open(u[..., 0])))

    def log_prob(self, phi: Tensor, theta_i: Tensor) -> Tensor:
        return wrapped_normal_log_prob(_from_forward(phi), self.std)

    def scattered_log_prob(self, phi: Tensor, theta_i: Tensor) -> Tensor:
        """`(1/pi) sum_k [Phi((d + pi/2 + 2 pi k) / std) - Phi((d - pi/2 + 2 pi k) / std)]`, d = wrap(phi - pi).

        Above std = 0.9 by its Fourier series: `1 / 2 pi` times `1 + 2 sum_k e^{-k^2 std^2 / 2} cos(k d) s_k` with
        `s_k = sin(k pi/2) / (k pi/2)`.
        """
        d = _from_forward(phi).abs()
        narrow, wide = self.std < _NARROW[phi.dtype], self.std > 0.9
        branches: list[Branch] = [
            (~(narrow | wide), _scattered_by_erfc, (0.0, 0.5)),
            (narrow, _scattered_by_masses, (0.0, 0.1)),
            (wide, _scattered_by_waves, (0.0, 1.0)),
        ]
        return piecewise(branches, d, self.std)


_NARROW = {torch.float64: 0.045, torch.float32: 0.14}  # below, erfc of the far side underflows


def _scattered_by_erfc(d: Tensor, std: Tensor) -> Tensor:
    s = math.sqrt(0.5) / std
    far = torch.special.erfc((1.5 * math.pi - d) * s) + torch.special.erfc((1.5 * math.pi + d) * s)
    far = far - torch.special.erfc((2.5 * math.pi - d) * s)
    main = torch.special.erfc((d - HALF_PI) * s) - torch.special.erfc((d + HALF_PI) * s)
    return torch.log(main + far) - math.log(TWO_PI)


def _scattered_by_masses(d: Tensor, std: Tensor) -> Tensor:
    """As above but in logs, for a single pair of images: the others are beyond 1e-100."""
    image = TWO_PI - d
    near, far = (log_normal_mass((x - HALF_PI) / std, (x + HALF_PI) / std) for x in (d, image))
    return torch.logaddexp(near, far) - _LOG_PI


def _scattered_by_waves(d: Tensor, std: Tensor) -> Tensor:
    waves = 0.0
    for k in (1, 3, 5, 7, 9, 11):  # sin(k pi / 2) vanishes for even k
        sinc = (2 / (math.pi * k)) * (1 if k % 4 == 1 else -1)
        waves = waves + sinc * torch.exp(-0.5 * (k * std) ** 2) * torch.cos(k * d)
    return torch.log1p(2 * waves) - math.log(TWO_PI)


class WrappedGaussian(Azimuthal):
    """N_TT as a Gaussian about the forward direction phi = pi, wrapped on the circle (chapter eqs (21)-(24) corrected).

    Args:
        std: gamma_TT, the azimuthal width in radians (the chapter prints the longitudinal beta_TT in its place);
            learnable.

    Raises:
        InputError: std outside its bounds.
    """

    def __init__(self, std: float | Tensor, *, learnable: bool = True) -> None:
        super().__init__()
        self.std = Bounded("std", std, *AZIMUTH_STD_BOUNDS, log=True, learnable=learnable)

    def forward(self, context: Context) -> WrappedGaussianLaw:
        return WrappedGaussianLaw(self.std(context))


@dataclass(frozen=True)
class TruncatedGaussianLaw(BatchFields, AzimuthalDistribution):
    """phi = wrap(pi - x), x ~ N(0, std) truncated to [-pi, pi]; `std` `[*batch]`, radians."""

    std: Tensor

    def _ends(self) -> tuple[Tensor, Tensor, Tensor]:
        return torch.zeros_like(self.std), torch.full_like(self.std, -math.pi), torch.full_like(self.std, math.pi)

    def sample(self, u: Tensor, theta_i: Tensor) -> Tensor:
        zero, low, high = self._ends()
        return wrap(math.pi - truncated_normal_icdf(u[..., 0], zero, self.std, low, high))

    def log_prob(self, phi: Tensor, theta_i: Tensor) -> Tensor:
        zero, low, high = self._ends()
        return truncated_normal_log_prob(_from_forward(phi).clamp(-math.pi, math.pi), zero, self.std, low, high)

    def scattered_log_prob(self, phi: Tensor, theta_i: Tensor) -> Tensor:
        """The mass of x in the half circle about d = |wrap(phi - pi)|, over pi: one interval, or two once d > pi/2."""
        d, s = _from_forward(phi).abs(), self.std
        _, low, high = self._ends()
        main = log_normal_mass((d - HALF_PI) / s, torch.minimum(d + HALF_PI, high) / s)
        split = d > HALF_PI
        upper = torch.where(split, d - 1.5 * math.pi, low + 0.5 * d)  # any other end where there is no second interval
        other = torch.where(split, log_normal_mass(low / s, upper / s), -math.inf)
        return torch.logaddexp(main, other) - log_normal_mass(low / s, high / s) - _LOG_PI


class TruncatedGaussian(Azimuthal):
    """N_TT as a Gaussian about phi = pi truncated to one turn: the other correction of chapter eqs (21)-(24).

    It differs from `WrappedGaussian` by up to a factor of 2 at phi = 0: never sample one and evaluate the other.

    Args:
        std: gamma_TT, radians; learnable.

    Raises:
        InputError: std outside its bounds.
    """

    def __init__(self, std: float | Tensor, *, learnable: bool = True) -> None:
        super().__init__()
        self.std = Bounded("std", std, *AZIMUTH_STD_BOUNDS, log=True, learnable=learnable)

    def forward(self, context: Context) -> TruncatedGaussianLaw:
        return TruncatedGaussianLaw(self.std(context))


class Scatterable(Protocol):
    """An azimuthal distribution of one uniform that also knows its density after a uniform turn by up to +-pi/2."""

    dimension: int

    def sample(self, u: Tensor, theta_i: Tensor) -> Tensor: ...

    def scattered_log_prob(self, phi: Tensor, theta_i: Tensor) -> Tensor: ...


@dataclass(frozen=True)
class ScatteredLaw(BatchFields, AzimuthalDistribution):
    """The base law turned by a uniform angle in [-pi/2, pi/2]; see `Scattered`."""

    base: Scatterable
    dimension: int = 2

    def sample(self, u: Tensor, theta_i: Tensor) -> Tensor:
        return wrap(self.base.sample(u[..., :1], theta_i) + math.pi * (u[..., 1] - 0.5))

    def log_prob(self, phi: Tensor, theta_i: Tensor) -> Tensor:
        return self.base.scattered_log_prob(phi, theta_i)


class Scattered(Azimuthal):
    """N^G of a base law: `(1/pi) int_{-pi/2}^{pi/2} p(wrap(phi - phi')) dphi'`, chapter eqs (11), (37).

    Sampled exactly: phi0 from the base law, then `phi = wrap(phi0 + pi (v - 1/2))`; the density is the base law's
    closed form `scattered_log_prob`. Takes two uniforms.

    Args:
        base: `CosineHalf`, `WrappedGaussian`, `TruncatedGaussian`, a uniform law, or any law of one uniform whose
            distribution has `scattered_log_prob(phi, theta_i)`.

    Raises:
        InputError: (on use) the base law has no such density.
    """

    dimension = 2

    def __init__(self, base: Azimuthal) -> None:
        super().__init__()
        self.base = base

    def forward(self, context: Context) -> ScatteredLaw:
        law = self.base(context)
        if not hasattr(law, "scattered_log_prob") or law.dimension != 1:
            raise InputError("base", type(self.base).__name__, "azimuthal laws of one uniform with scattered_log_prob")
        return ScatteredLaw(law)
