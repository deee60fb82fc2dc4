"""Marschner's fibre parameters as tensors."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

from dsfit.errors import InputError, as_real, check_broadcast, check_choice, check_range, common_dtype
from dsfit.special import is_differentiated

_DEG = math.pi / 180

_PRESET_SIGMA_A: dict[str, tuple[float, float, float]] = {
    "nonabsorbing": (0.0, 0.0, 0.0),
    "blond": (0.03, 0.07, 0.15),
    "brown": (0.432, 0.612, 0.98),
    "black": (3.35, 5.58, 10.96),
}

_DEFAULTS: dict[str, Any] = {
    "sigma_a": (0.0, 0.0, 0.0),
    "eta": 1.55,
    "alpha": tuple(-7.5 * _DEG * k for k in (1.0, -0.5, -1.5)),
    "beta": tuple(7.5 * _DEG * k for k in (1.0, 0.5, 2.0)),
    "eccentricity": 1.0,
    "caustic_width": 15 * _DEG,
    "glint_scale": 0.8,
    "caustic_fade": 0.3,
    "caustic_max_offset": 0.5,
    "gamma_tt": 30 * _DEG,
}

# field: (low, high, low excluded); every field must also be finite
_RANGES: dict[str, tuple[float, float, bool]] = {
    "sigma_a": (0.0, math.inf, False),
    "eta": (1.0, math.inf, True),
    "alpha": (-math.pi / 2, math.pi / 2, False),
    "beta": (0.0, math.inf, True),
    "eccentricity": (math.sqrt(0.5), math.sqrt(2.0), True),
    "caustic_width": (0.0, math.pi, True),
    "glint_scale": (0.0, math.inf, False),
    "caustic_fade": (0.0, math.inf, True),
    "caustic_max_offset": (0.0, 1.0, False),
    "gamma_tt": (0.0, math.inf, True),
}


@dataclass(frozen=True, init=False)
class Fiber:
    """A hair fibre (Marschner et al. 2003), or a batch of them; differentiable in every field.

    Args (angles in radians, lobes in the order R, TT, TRT):
        sigma_a: absorption per fibre radius and channel, `[*batch, C]`, >= 0.
        eta: refractive index `[*batch]`, > 1.
        alpha: longitudinal shifts of the lobes in theta_h, `[*batch, 3]`.
        beta: longitudinal standard deviations of the lobes in theta_h, `[*batch, 3]`, > 0.
        eccentricity: ratio of the axes of the section; changes the index that TRT sees. Between sqrt(1/2) and sqrt(2),
            where the index of either axis would fall to 1.
        caustic_width: standard deviation w_c of the glints' azimuth.
        glint_scale: energy factor k_G of the glints.
        caustic_fade: range of eta' above 2 over which the glint fades out.
        caustic_max_offset: largest range of offsets that a glint gathers.
        gamma_tt: azimuthal standard deviation of TT in the simplified azimuths, eq (21).
        dtype: dtype of all fields; left out, that of the first tensor given, else float64.

    A batch of fibres broadcasts against directions from the right like any tensor: give shape `[B, 1]` to evaluate
        `[B, Q]` directions.

    Raises:
        InputError: a field is unknown, not finite, of the wrong shape, or out of range.

    Example:
        >>> import dsfit
        >>> fiber = dsfit.Fiber.preset("blond", eccentricity=0.9)
        >>> [round(x, 2) for x in fiber.sigma_a.tolist()]
        [0.03, 0.07, 0.15]
        >>> fiber.is_round, fiber.channels
        (False, 3)
    """

    sigma_a: Tensor
    eta: Tensor
    alpha: Tensor
    beta: Tensor
    eccentricity: Tensor
    caustic_width: Tensor
    glint_scale: Tensor
    caustic_fade: Tensor
    caustic_max_offset: Tensor
    gamma_tt: Tensor

    def __init__(self, *, dtype: torch.dtype | None = None, **parameters: Any) -> None:
        for name in parameters:
            check_choice("fiber field", name, tuple(_DEFAULTS))
        dtype, device = common_dtype("fiber.dtype", dtype, tuple(parameters.values()))
        for name, default in _DEFAULTS.items():
            value = as_real(f"fiber.{name}", parameters.get(name, default), dtype, device)
            if name in ("alpha", "beta") and (value.ndim == 0 or value.shape[-1] != 3):
                raise InputError(f"fiber.{name}", tuple(value.shape), "a last dimension of 3: R, TT, TRT")
            if name == "sigma_a" and (value.ndim == 0 or value.shape[-1] == 0):
                raise InputError("fiber.sigma_a", tuple(value.shape), "a last dimension of channels, at least one")
            low, high, open_low = _RANGES[name]
            check_range(f"fiber.{name}", value, low, high, open_low=open_low, open_high=name == "eccentricity")
            object.__setattr__(self, name, value)
        batches = {k: x[..., 0] if k in ("sigma_a", "alpha", "beta") else x for k, x in self.parameters().items()}
        check_broadcast(**batches)

    @classmethod
    def preset(cls, name: str, **overrides: Any) -> Fiber:
        """The fibre `nonabsorbing`, `blond`, `brown` or `black`, with fields replaced by keyword."""
        check_choice("fiber.preset", name, tuple(_PRESET_SIGMA_A))
        return cls(**{"sigma_a": _PRESET_SIGMA_A[name], **overrides})

    @staticmethod
    def presets() -> tuple[str, ...]:
        """Names of the presets."""
        return tuple(_PRESET_SIGMA_A)

    def parameters(self) -> dict[str, Tensor]:
        """All fields by name."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def replace(self, **overrides: Any) -> Fiber:
        """The fibre with fields replaced."""
        return Fiber(dtype=self.dtype, **{**self.parameters(), **overrides})

    def to(self, *args: Any, **kwargs: Any) -> Fiber:
        """The fibre in another dtype or on another device (arguments of `Tensor.to`)."""
        return Fiber(**{name: value.to(*args, **kwargs) for name, value in self.parameters().items()})

    @property
    def dtype(self) -> torch.dtype:
        """dtype of every field."""
        return self.eta.dtype

    @property
    def device(self) -> torch.device:
        """Device of every field."""
        return self.eta.device

    @property
    def channels(self) -> int:
        """Number of absorption channels C."""
        return self.sigma_a.shape[-1]

    @functools.cached_property
    def batch_shape(self) -> torch.Size:
        """Shape of the fibre batch."""
        shapes = [getattr(self, name).shape for name in _DEFAULTS if name not in ("sigma_a", "alpha", "beta")]
        return torch.broadcast_shapes(self.sigma_a.shape[:-1], self.alpha.shape[:-1], self.beta.shape[:-1], *shapes)

    @property
    def requires_grad(self) -> bool:
        """Whether any field is tracked by autograd, in reverse or in forward mode."""
        return any(is_differentiated(value) for value in self.parameters().values())

    @property
    def is_round(self) -> bool:
        """Whether the section is a circle, so that nothing depends on absolute azimuth."""
        return not is_differentiated(self.eccentricity) and bool((self.eccentricity == 1).all())

    def eta_trt(self, phi_h: Tensor | None) -> Tensor:
        """Index that TRT sees: eta* = [(eta1 + eta2) + cos(2 phi_h) (eta1 - eta2)] / 2 (Marschner et al. 2003,
        section 5.2.3).

        eta1 = 2 (eta - 1) a^2 - eta + 2, eta2 = 2 (eta - 1) a^-2 - eta + 2, a = eccentricity; equals eta for a = 1.
        `phi_h = (phi_i + phi_r)/2` is measured from the major axis of the section; left out, it is 0.
        """
        if self.is_round:
            return self.eta
        a2 = self.eccentricity**2
        eta1 = 2 * (self.eta - 1) * a2 - self.eta + 2
        eta2 = 2 * (self.eta - 1) / a2 - self.eta + 2
        cos2 = torch.ones_like(self.eta) if phi_h is None else torch.cos(2 * phi_h)
        return ((eta1 + eta2) + cos2 * (eta1 - eta2)) / 2
