"""Badly scaled, singular and ill-posed least squares with known answers.

Rosenbrock, Powell's badly scaled and singular functions and Brown's badly scaled one are problems 1, 3, 13 and 4 of
More, Garbow and Hillstrom, "Testing Unconstrained Optimization Software" (1981), with their standard starts.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from dsfit.checks.stiff_fits.cases import Case, toy_case


def _vector(*x: float) -> Tensor:
    return torch.tensor(x, dtype=torch.float64)


_UNITS = _vector(1e6, 1e-3)
_MATRIX = torch.linspace(-1, 1, 12, dtype=torch.float64)[:, None] ** torch.arange(3, dtype=torch.float64)
_DATA = torch.sin(3 * torch.linspace(-1, 1, 12, dtype=torch.float64)) + 0.3
_LEAST = float((_MATRIX @ torch.linalg.lstsq(_MATRIX, _DATA[:, None]).solution[:, 0] - _DATA).square().sum())


def rosenbrock_scaled(y: Tensor) -> Tensor:
    """Rosenbrock's valley in parameters whose units differ by 1e9; least value 0 at (1e-6, 1e3)."""
    x = _UNITS * y
    return torch.stack([10 * (x[1] - x[0] ** 2), 1 - x[0]])


def powell_singular(y: Tensor) -> Tensor:
    """Powell's singular function; the Jacobian at the least value 0, at the origin, has rank 2 of 4."""
    return torch.stack([y[0] + 10 * y[1], 5**0.5 * (y[2] - y[3]), (y[1] - 2 * y[2]) ** 2, 10**0.5 * (y[0] - y[3]) ** 2])


def powell_badly_scaled(y: Tensor) -> Tensor:
    """Powell's badly scaled function; least value 0 at (1.098e-5, 9.106)."""
    return torch.stack([1e4 * y[0] * y[1] - 1, torch.exp(-y[0]) + torch.exp(-y[1]) - 1.0001])


def brown_badly_scaled(y: Tensor) -> Tensor:
    """Brown's badly scaled function; least value 0 at (1e6, 2e-6)."""
    return torch.stack([y[0] - 1e6, y[1] - 2e-6, y[0] * y[1] - 2])


def no_effect(y: Tensor) -> Tensor:
    """A linear fit of three parameters, and a fourth without any effect."""
    return _MATRIX @ y[:3] - _DATA + 0 * y[3]


def redundant(y: Tensor) -> Tensor:
    """A linear fit where two parameters only count through their sum: the Jacobian is singular everywhere."""
    return _MATRIX @ torch.stack([y[0] + y[1], y[2], y[3]]) - _DATA


_TOYS: dict[str, tuple[Callable[[Tensor], Tensor], Tensor, float]] = {
    "rosenbrock_scaled": (rosenbrock_scaled, _vector(-1.2, 1.0) / _UNITS, 0.0),
    "powell_singular": (powell_singular, _vector(3.0, -1.0, 0.0, 1.0), 0.0),
    "powell_badly_scaled": (powell_badly_scaled, _vector(0.0, 1.0), 0.0),
    "brown_badly_scaled": (brown_badly_scaled, _vector(1.0, 1.0), 0.0),
    "no_effect": (no_effect, _vector(0.0, 0.0, 0.0, 7.0), _LEAST),
    "redundant": (redundant, _vector(4.0, -3.0, 0.0, 0.0), _LEAST),
}

TOYS: dict[str, Callable[[], list[Case]]] = {
    name: (lambda name=name, spec=spec: [toy_case(name, *spec)]) for name, spec in _TOYS.items()
}
"""Toys by name, each as a function that makes its cases."""
