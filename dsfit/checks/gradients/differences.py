"""Numerical derivatives that know their own error: extrapolated differences, and the complex step."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

LEVELS, RATIO = 11, 2.0
SAFETY = 20.0
"""What the error estimate of `derivative` is multiplied by to be a bound. On analytic functions, smooth, steep and
noisy, the true error was never more than 8.3 of the estimates in 2e5 points
(tests/checks/test_gradients_differences.py)."""
_NOISE_REACH = 5  # points on either side that the noise is estimated from
_NOISE_STEP = 1e-8


@dataclass(frozen=True)
class Difference:
    """A derivative by extrapolated differences, elementwise.

    Attributes:
        value: the derivative; NaN where no step gave finite values.
        error: estimate of its error, >= 0, inf where `value` is NaN. Large at kinks and jumps.
        noise: standard deviation of the rounding noise of the function itself, as measured.
        scale: |f| at the point.
    """

    value: Tensor
    error: Tensor
    noise: Tensor
    scale: Tensor


def derivative(
    along: Callable[[Tensor], Tensor],
    step: float | Tensor,
    *,
    levels: int = LEVELS,
    ratio: float = RATIO,
    at_once: bool = False,
) -> Difference:
    """d along(t) / dt at t = 0 by Ridders' extrapolation of central differences, with its own error estimate.

    Steps h_k = step / ratio^k; `D_k0 = (f(h_k) - f(-h_k)) / 2 h_k` has an expansion in even powers of h, which
    `D_km = (ratio^2m D_k,m-1 - D_k-1,m-1) / (ratio^2m - 1)` removes term by term (Ridders 1982, Adv. Eng. Software 4).
    The error estimate of an entry is the largest of

    - its distance to both entries that it is made of;
    - the jump of slope that it leaves: the second difference `(f(h) - 2 f(0) + f(-h)) / h`, extrapolated to h = 0 in
      odd powers, vanishes where f has a derivative and tends to the jump of slope at a kink, which central differences
      alone cannot see;
    - its share of the function's rounding noise, which is measured from differences of order 4 to 6 over a tiny grid
      (Hamming; More and Wild 2011, SIAM J. Sci. Comput. 33).

    The entry with the least estimate that entries of smaller steps do not contradict is taken, for each element by
    itself.

    Args:
        along: maps t, of the shape of `step`, to values `[*step.shape, ...]` (any shape if `step` is a number).
        step: largest step; a tensor gives every element its own.
        levels: number of steps; `2 levels + 11` evaluations in all.
        at_once: `along` takes all of them in one call, t `[evaluations, *step.shape]` to `[evaluations, ...]`.
    """
    step = torch.as_tensor(step, dtype=torch.float64)
    reach = [_NOISE_STEP * j for j in range(-_NOISE_REACH, _NOISE_REACH + 1)]
    factors = [*reach, *(side / ratio**k for k in range(levels) for side in (1, -1))]
    if at_once:
        found = along(torch.stack([step * f for f in factors])).detach()
    else:
        found = torch.stack([along(step * f).detach() for f in factors])
    near, far = found[: len(reach)], found[len(reach) :]
    h = step.reshape(step.shape + (1,) * (near.dim() - 1 - step.dim())) if step.dim() else step
    return _extrapolated(near, far[0::2], far[1::2], h, ratio)


def _extrapolated(near: Tensor, highs: Tensor, lows: Tensor, step: Tensor, ratio: float) -> Difference:
    """From values over the tiny grid, and at the steps on either side, each `[levels, ...]`."""
    center = near[_NOISE_REACH]
    noise, relative = _noise(near)
    rows: list[tuple[Tensor, Tensor]] = []  # the best entry of each row, and its estimate
    slopes: list[Tensor] = []  # the last row of the tableau, and of that of the jump of slope
    bends: list[Tensor] = []
    amplified = _amplification(len(highs), ratio)
    for k, (high, low) in enumerate(zip(highs, lows, strict=True)):
        h = step / ratio**k
        # where f(0) is near a zero of f, the noise is that of its neighbours
        rough = torch.maximum(noise, relative * torch.maximum(high.abs(), low.abs()).nan_to_num())
        best, least = torch.full_like(center, math.nan), torch.full_like(center, math.inf)
        slope_row, bend_row = [(high - low) / (2 * h)], [((high - center) + (low - center)) / h]
        for m in range(1, k + 1):
            slope_row.append(slope_row[-1] + (slope_row[-1] - slopes[m - 1]) / (ratio ** (2 * m) - 1))
            bend_row.append(bend_row[-1] + (bend_row[-1] - bends[m - 1]) / (ratio ** (2 * m - 1) - 1))
            apart = torch.maximum((slope_row[m] - slope_row[m - 1]).abs(), (slope_row[m] - slopes[m - 1]).abs())
            error = torch.maximum(torch.maximum(apart, bend_row[m].abs()), amplified[m] * rough / h)
            better = error < least  # never true for NaN
            best, least = torch.where(better, slope_row[m], best), torch.where(better, error, least)
        slopes, bends = slope_row, bend_row
        rows.append((best, least))
    return Difference(*_corroborated(rows), noise, center.abs())


def _corroborated(rows: list[tuple[Tensor, Tensor]]) -> tuple[Tensor, Tensor]:
    """The entry with the least estimate, once each is raised to what rows of smaller steps, as far as they can tell,
    find wrong with it: where f is only piecewise smooth, entries of large steps may agree by chance."""
    best, least = torch.full_like(rows[0][0], math.nan), torch.full_like(rows[0][0], math.inf)
    for k, (value, error) in enumerate(rows):
        for finer, known in rows[k + 1 :]:
            error = torch.maximum(error, ((value - finer).abs() - known).nan_to_num(nan=0.0, neginf=0.0))
        better = error < least
        best, least = torch.where(better, value, best), torch.where(better, error, least)
    return best, least


def _amplification(levels: int, ratio: float) -> list[float]:
    """Standard deviation of D_km in units of noise / h_k, for white noise."""
    result, weights = [], [1.0]  # weights of D_k0, D_k-1,0, ...
    for m in range(levels):
        result.append(math.sqrt(sum((w / ratio**j) ** 2 for j, w in enumerate(weights)) / 2))
        up = ratio ** (2 * (m + 1))
        longer = [*(up * w for w in weights), 0.0]
        weights = [(w - (weights[j - 1] if j else 0.0)) / (up - 1) for j, w in enumerate(longer)]
    return result


def _noise(rows: Tensor) -> tuple[Tensor, float]:
    """Standard deviation of the rounding noise of each element, and the typical one relative to |f|; both at least that
    of rounding the result. From values `[points, ...]` on an even grid that is too small for f itself to bend."""
    center = rows[len(rows) // 2]
    variance = torch.zeros_like(center)
    orders = (4, 5, 6)
    for order in range(1, orders[-1] + 1):
        rows = rows[1:] - rows[:-1]
        if order in orders:
            variance = torch.maximum(variance, rows.square().mean(0) / math.comb(2 * order, order))
    found = torch.sqrt(variance).nan_to_num(nan=math.inf, posinf=math.inf)
    relative = (found / center.abs())[center.isfinite() & (center != 0) & found.isfinite()]
    typical = max(float(relative.median()) if relative.numel() else 0.0, torch.finfo(center.dtype).eps / 2)
    # a few equal roundings in a row look like no noise at all
    return torch.maximum(found, center.abs().nan_to_num() * typical), typical


@dataclass(frozen=True)
class ComplexStep:
    """`value`: the derivative to rounding, or None where the function does not take complex tensors: `refused` says
    why."""

    value: Tensor | None
    refused: str = ""


def complex_step(function: Callable[[Tensor], Tensor], x: Tensor, *, step: float = 1e-30) -> ComplexStep:
    """d f / d x elementwise as `Im f(x + i h) / h`, free of cancellation (Squire and Trapp 1998, SIAM Rev. 40).

    Only for functions that are analytic as written: `abs`, `clamp`, `maximum`, comparisons, `atan2`, `erfc`, `ndtri`
    refuse complex tensors, and those are reported, not worked around. A function that silently drops the imaginary part
    is reported as well.

    Args:
        function: elementwise, `[N] -> [N, ...]`.
        x: real points `[N]`.
    """
    try:
        with torch.no_grad():
            found = function(torch.complex(x, torch.full_like(x, step)))
    except (RuntimeError, NotImplementedError, TypeError, ValueError) as error:
        return ComplexStep(None, str(error).strip().split("\n")[0][:120])
    if not found.is_complex():
        return ComplexStep(None, "the result is real")
    return ComplexStep(found.imag / step)
