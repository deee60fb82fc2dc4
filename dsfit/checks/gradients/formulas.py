"""Derivatives of the library's scalar formulas to rounding: by the complex step where they take complex numbers, by 30
digits where they do not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mpmath
import torch
from torch import Tensor

from dsfit import special
from dsfit.bsdf import snell
from dsfit.bsdf.fresnel import fresnel
from dsfit.checks.gradients.differences import complex_step


@dataclass(frozen=True)
class FormulaCheck:
    """One formula's derivative in its first argument.

    Attributes:
        name: of the formula.
        method: "complex step" or "30 digits".
        worst: largest error over |derivative| + |f|.
        refused: why not by the complex step.
    """

    name: str
    method: str
    worst: float
    refused: str = ""


def _log_window_twin(a: Any, b: Any) -> Any:
    c = max(a, mpmath.mpf(0)) + min(b, mpmath.mpf(0))
    return mpmath.log(mpmath.quad(lambda z: mpmath.exp(-(z * z - c * c) / 2), [a, b]))


def _icdf_twin(mean: Any, u: Any, std: Any, low: Any, high: Any) -> Any:
    a, b = mpmath.ncdf((low - mean) / std), mpmath.ncdf((high - mean) / std)
    target = a + u * (b - a)
    return mean + std * mpmath.sqrt(2) * mpmath.erfinv(2 * target - 1)


def _wrapped_twin(x: Any, std: Any) -> Any:
    images = sum(mpmath.exp(-0.5 * ((x + 2 * mpmath.pi * k) / std) ** 2) for k in range(-12, 13))
    return mpmath.log(images / (std * mpmath.sqrt(2 * mpmath.pi)))


Row = tuple[str, Callable[..., Tensor], Callable[..., Any] | None, tuple[tuple[float, float], ...]]
_ROWS: tuple[Row, ...] = (  # name, function of tensors, 30-digit twin, ranges of the arguments
    ("exit_trt in gamma", lambda g, k: snell.exit_trt(k, g), None, ((0.05, 1.5), (0.4, 0.65))),
    ("exit_trt in kappa", snell.exit_trt, None, ((0.4, 0.65), (0.05, 1.5))),
    ("exit_trt_slope", lambda g, k: snell.exit_trt_slope(k, g), None, ((0.05, 1.5), (0.4, 0.65))),
    ("gamma_tt", lambda phi, k: snell.gamma_tt(k, phi)[0], None, ((1.7, 3.1), (0.4, 0.65))),
    ("log_gauss in x", special.log_gauss, None, ((-3.0, 3.0), (0.05, 2.0))),
    ("log_gauss in std", lambda s, x: special.log_gauss(x, s), None, ((0.05, 2.0), (-3.0, 3.0))),
    ("fresnel", lambda c, eta: fresnel(eta, c)[0], lambda c, eta: _fresnel_twin(c, eta), ((0.02, 0.98), (1.2, 2.5))),
    (
        "log_mills",
        special.log_mills,
        lambda a: mpmath.log(mpmath.sqrt(mpmath.pi / 2) * mpmath.exp(a * a / 2) * mpmath.erfc(a / mpmath.sqrt(2))),
        ((0.1, 12.0),),
    ),
    ("log_window", special.log_window, _log_window_twin, ((-6.0, -0.3), (0.2, 6.0))),
    (
        "truncated_normal_icdf",
        lambda m, u, s, low, high: special.truncated_normal_icdf(u, m, s, low, high),
        _icdf_twin,
        ((-0.4, 0.4), (0.05, 0.95), (0.1, 1.0), (-0.8, -0.7), (0.7, 0.8)),
    ),
    ("wrapped_normal_log_prob", special.wrapped_normal_log_prob, _wrapped_twin, ((-3.0, 3.0), (0.1, 1.9))),
)


def _fresnel_twin(c: Any, eta: Any) -> Any:
    g = mpmath.sqrt(eta**2 - 1 + c**2)
    return (((c - g) / (c + g)) ** 2 + ((eta**2 * c - g) / (eta**2 * c + g)) ** 2) / 2


def check_formulas(seed: int, count: int = 5) -> list[FormulaCheck]:
    """Reverse mode against the complex step, or against 30 digits where the formula refuses complex numbers."""
    generator = torch.Generator().manual_seed(seed)
    found = []
    for name, function, twin, ranges in _ROWS:
        u = torch.rand((len(ranges), count), generator=generator, dtype=torch.float64)
        arguments = [low + (high - low) * row for row, (low, high) in zip(u, ranges, strict=True)]
        leaf = arguments[0].clone().requires_grad_()
        value = function(leaf, *arguments[1:])
        (slope,) = torch.autograd.grad(value.sum(), leaf)
        step = complex_step(lambda x, f=function, rest=arguments[1:]: f(x, *rest), arguments[0])
        exact, method = step.value, "complex step"
        if exact is None and twin is not None:
            exact, method = _by_digits(twin, arguments), "30 digits"
        if exact is None:
            found.append(FormulaCheck(name, "none", float("nan"), step.refused))
            continue
        scale = exact.abs() + value.detach().abs()
        found.append(FormulaCheck(name, method, float(((slope - exact).abs() / scale).max()), step.refused))
    return found


def _by_digits(twin: Callable[..., Any], arguments: list[Tensor]) -> Tensor:
    """d twin / d first argument at 30 digits beyond those that the differences of mpmath lose."""
    with mpmath.workdps(50):
        rows = zip(*(x.tolist() for x in arguments), strict=True)
        slopes = [float(mpmath.diff(lambda x, r=row: twin(x, *map(mpmath.mpf, r[1:])), row[0])) for row in rows]
    return torch.tensor(slopes, dtype=torch.float64)
