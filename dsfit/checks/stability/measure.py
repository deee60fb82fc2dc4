"""Errors of a function of the library against its 50-digit twin, regime by regime, in float64 and float32."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import mpmath as mp
import torch
from torch import Tensor

from dsfit.checks.stability.function import Function, Point

DTYPES = {"float64": torch.float64, "float32": torch.float32}
FLOOR = 1e-3
"""A derivative that is smaller than this part of another, per relative change of its argument, counts as zero."""
UNIT = 1e-3
"""Arguments smaller than this have this size when derivatives are compared."""


@dataclass(frozen=True)
class Exact:
    """Value and derivatives of the twin at a point, as mpmath numbers."""

    value: mp.mpf
    slopes: tuple[mp.mpf, ...]


@dataclass(frozen=True)
class Errors:
    """Errors over the points of a regime.

    Attributes:
        worst, median: relative errors (see `Function`); inf where a number is missing.
        worst_ulps, median_ulps: the same in units in the last place of the exact number, or of the scale.
        point: the arguments of the worst error; None without points.
        got, exact: the two numbers there.
        argument: for derivatives, in which argument.
        nan, infinite, zero, negative: how often the code gave NaN; an infinity where the exact number is one that the
            dtype has; 0 where the exact number is normal; a density below 0.
    """

    worst: float
    median: float
    worst_ulps: float
    median_ulps: float
    point: Point | None = None
    got: float = math.nan
    exact: float = math.nan
    argument: str = ""
    nan: int = 0
    infinite: int = 0
    zero: int = 0
    negative: int = 0


@dataclass(frozen=True)
class Measurement:
    """What `measure` finds for one regime and dtype.

    Attributes:
        points: how many were measured; points that rounding put outside the domain are left out.
        value: of the library's function. `naive`: of the naive formula, None if there is none.
        gradient: of reverse mode, None if no derivative is asked for; `forward`: of forward mode, None also where the
            function has none.
        naive_gradient: reverse mode through the naive formula.
    """

    function: str
    regime: str
    dtype: str
    points: int
    value: Errors
    gradient: Errors | None
    forward: Errors | None
    naive: Errors | None
    naive_gradient: Errors | None


def measure(function: Function, regime: str, dtype: str, digits: int = 50) -> Measurement:
    """Errors of value and derivatives over the points of `regime`.

    Arguments are rounded to `dtype` and handed to the twin as they are. The twin works with `digits` digits; its
    derivatives are central differences with half as many more.

    Args:
        function: the entry.
        regime: one of its regimes.
        dtype: "float64" or "float32".
        digits: of the reference arithmetic.

    Raises:
        KeyError: no such regime or dtype.
    """
    wanted = function.arguments if function.gradients is None else function.gradients
    points = rounded(function.regimes[regime], DTYPES[dtype])
    with mp.workdps(digits + digits // 2):
        found = [exact_at(function, point, wanted, digits) for point in points]
        keep = [i for i, exact in enumerate(found) if mp.isfinite(exact.value)]
        points, truth = [points[i] for i in keep], [found[i] for i in keep]
        value, slopes = evaluate(function.compute, function.arguments, wanted, points, DTYPES[dtype])
        forward = forward_slopes(function.compute, function.arguments, wanted, points, DTYPES[dtype])
        naive = naive_gradient = None
        if function.naive is not None:
            rough, rough_slopes = evaluate(function.naive, function.arguments, wanted, points, DTYPES[dtype])
            naive = value_errors(function, points, truth, rough, dtype)
            naive_gradient = slope_errors(function, wanted, points, truth, rough_slopes, dtype) if wanted else None
        return Measurement(
            function=function.name,
            regime=regime,
            dtype=dtype,
            points=len(points),
            value=value_errors(function, points, truth, value, dtype),
            gradient=slope_errors(function, wanted, points, truth, slopes, dtype) if wanted else None,
            forward=slope_errors(function, wanted, points, truth, forward, dtype) if wanted and forward else None,
            naive=naive,
            naive_gradient=naive_gradient,
        )


def rounded(points: Sequence[Point], dtype: torch.dtype) -> list[Point]:
    """The points in that dtype, without those that overflow in it."""
    kept = []
    for point in points:
        new = tuple(torch.tensor(point, dtype=torch.float64).to(dtype).tolist())
        if all(math.isfinite(x) or x == y for x, y in zip(new, point, strict=True)):
            kept.append(new)
    return kept


def exact_at(function: Function, point: Point, wanted: Sequence[str], digits: int) -> Exact:
    """The twin's value and its derivatives in the `wanted` arguments by central differences.

    The step is `10^(-digits / 2)` of the argument: its square is the error, and the working precision leaves as many
    digits to the difference.
    """
    args = [mp.mpf(x) for x in point]
    value = mp.mpf(function.exact(*args))
    if not mp.isfinite(value):
        return Exact(value, ())
    smallest = min((abs(x) for x in args if x != 0 and mp.isfinite(x)), default=mp.mpf(1))
    slopes = []
    for name in wanted:
        k = function.arguments.index(name)
        if not mp.isfinite(args[k]):  # an end at infinity: nothing moves there
            slopes.append(mp.mpf(0))
            continue
        step = (abs(args[k]) if args[k] != 0 else min(smallest, 1)) * mp.mpf(10) ** (-(digits // 2))
        with mp.extradps(max(0, int(-mp.log10(step)) - digits // 2)):  # next to 1, a tiny step needs them
            above, below = (function.exact(*args[:k], args[k] + h, *args[k + 1 :]) for h in (step, -step))
            slopes.append((above - below) / (2 * step))
    return Exact(value, tuple(slopes))


def evaluate(
    compute: Callable[..., Tensor],
    arguments: Sequence[str],
    wanted: Sequence[str],
    points: Sequence[Point],
    dtype: torch.dtype,
) -> tuple[list[float], list[list[float]]]:
    """Values, and derivatives in the `wanted` arguments in reverse mode, one list per argument."""
    if not points:
        return [], [[] for _ in wanted]
    args = [x.clone() for x in torch.tensor(points, dtype=dtype).unbind(-1)]
    leaves = [args[arguments.index(name)].requires_grad_() for name in wanted]
    value = compute(*args)
    if not leaves or not value.requires_grad:
        return value.tolist(), [[0.0] * len(points) for _ in wanted]
    slopes = torch.autograd.grad(value.sum(), leaves, allow_unused=True)
    return value.tolist(), [[0.0] * len(points) if s is None else s.tolist() for s in slopes]


def forward_slopes(
    compute: Callable[..., Tensor],
    arguments: Sequence[str],
    wanted: Sequence[str],
    points: Sequence[Point],
    dtype: torch.dtype,
) -> list[list[float]] | None:
    """Derivatives in the `wanted` arguments in forward mode; None where the function does not support it."""
    if not points:
        return None
    args = list(torch.tensor(points, dtype=dtype).unbind(-1))
    slopes = []
    for name in wanted:
        k = arguments.index(name)

        def along(x: Tensor, k: int = k) -> Tensor:
            return compute(*args[:k], x, *args[k + 1 :])

        try:
            slopes.append(torch.func.jvp(along, (args[k],), (torch.ones_like(args[k]),))[1].tolist())
        except (NotImplementedError, RuntimeError):
            return None
    return slopes


def value_errors(
    function: Function, points: Sequence[Point], truth: Sequence[Exact], got: Sequence[float], dtype: str
) -> Errors:
    """Errors of values."""
    tally = _Tally(dtype, function.density)
    for point, exact, x in zip(points, truth, got, strict=True):
        scale = function.scale(*point, float(exact.value)) if function.scale else 0.0
        tally.add(x, exact.value, mp.mpf(max(scale, 1.0 if function.logarithm else 0.0)), point)
    return tally.errors()


def slope_errors(
    function: Function,
    wanted: Sequence[str],
    points: Sequence[Point],
    truth: Sequence[Exact],
    got: Sequence[Sequence[float]],
    dtype: str,
) -> Errors:
    """Errors of derivatives."""
    tally = _Tally(dtype)
    places = [function.arguments.index(name) for name in wanted]
    for i, (point, exact) in enumerate(zip(points, truth, strict=True)):
        units = [max(abs(point[k]), UNIT) if math.isfinite(point[k]) else 1.0 for k in places]
        sizes = [abs(s) * u for s, u in zip(exact.slopes, units, strict=True) if mp.isfinite(s)]
        largest = max(sizes, default=mp.mpf(0))
        scale = mp.mpf(function.gradient_scale(*point, float(exact.value)) if function.gradient_scale else 0.0)
        if largest == 0:  # a constant: the derivative counts by what it does to the value
            largest = max(abs(exact.value), mp.mpf(function.logarithm)) / FLOOR
        for name, unit, slope, row in zip(wanted, units, exact.slopes, got, strict=True):
            if mp.isfinite(slope):  # the twin's step may leave the domain at its very edge
                tally.add(row[i], slope, max(scale, FLOOR * largest / unit), point, name)
    return tally.errors()


class _Tally:
    """Collects errors; every number is compared in mpmath."""

    def __init__(self, dtype: str, density: bool = False) -> None:
        info = torch.finfo(DTYPES[dtype])
        self.eps, self.tiny, self.huge = info.eps, mp.mpf(info.tiny), mp.mpf(info.max)
        self.density = density
        self.rows: list[tuple[float, float, Point, float, mp.mpf, str]] = []
        self.counts = {"nan": 0, "infinite": 0, "zero": 0, "negative": 0}

    def add(self, got: float, exact: mp.mpf, scale: mp.mpf, point: Point, argument: str = "") -> None:
        size = max(abs(exact), scale, self.tiny)
        error = self._error(got, exact, size)
        self.counts["nan"] += math.isnan(got)
        self.counts["infinite"] += math.isinf(got) and abs(exact) <= self.huge
        self.counts["zero"] += got == 0 and abs(exact) >= max(self.tiny, scale)
        if self.density and got < 0:
            self.counts["negative"] += 1
            error = math.inf
        ulp = mp.ldexp(self.eps, int(mp.frexp(min(size, self.huge))[1]) - 1)
        self.rows.append((error, error * float(min(size, self.huge) / ulp), point, got, exact, argument))

    def _error(self, got: float, exact: mp.mpf, size: mp.mpf) -> float:
        if math.isnan(got):
            return math.inf
        if abs(exact) > self.huge:
            return 0.0 if got == math.copysign(math.inf, exact) or abs(got) > 0.99 * self.huge else math.inf
        if math.isinf(got):
            return math.inf
        gap = abs(mp.mpf(got) - exact)
        if abs(exact) < self.tiny:  # it may be flushed to zero
            gap = max(gap - self.tiny, mp.mpf(0))
        return float(gap / size)

    def errors(self) -> Errors:
        if not self.rows:
            return Errors(0.0, 0.0, 0.0, 0.0)
        worst = max(self.rows, key=lambda row: row[0])
        return Errors(
            worst=worst[0],
            median=statistics.median(row[0] for row in self.rows),
            worst_ulps=max(row[1] for row in self.rows),
            median_ulps=statistics.median(row[1] for row in self.rows),
            point=worst[2],
            got=worst[3],
            exact=float(worst[4]),
            argument=worst[5],
            **self.counts,
        )
