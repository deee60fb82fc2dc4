"""Twins in mpmath, to whatever precision is set: normal masses, quantiles, wrapped laws. They share no code with
dsfit."""

from __future__ import annotations

import functools
from collections.abc import Callable

import mpmath as mp

Number = mp.mpf


def mass(a: Number, b: Number) -> Number:
    """Phi(b) - Phi(a) by error functions, with the digits that their difference loses added first; 0 where b <= a."""
    if b <= a:
        return mp.mpf(0)
    if a + b < 0:
        a, b = -b, -a
    if a <= 0:  # the two terms have the same sign
        return (mp.erf(b / mp.sqrt(2)) + mp.erf(-a / mp.sqrt(2))) / 2
    lost = 0 if mp.isinf(b) else max(0, int(-mp.log10((b - a) * max(a, 1))) + 5)
    with mp.extradps(lost):
        return (mp.erfc(a / mp.sqrt(2)) - mp.erfc(b / mp.sqrt(2))) / 2


def log_gauss(x: Number, std: Number) -> Number:
    """Log of the normal density."""
    return -((x / std) ** 2) / 2 - mp.log(std * mp.sqrt(2 * mp.pi))


def invert(
    cdf: Callable[[Number], Number],
    pdf: Callable[[Number], Number],
    u: Number,
    x: Number,
    low: Number,
    high: Number,
) -> Number:
    """The root of cdf(x) = u in (low, high) from a guess x, for a log-concave law: Newton on log cdf, which rises to
    the root without passing it, inside a shrinking bracket.
    """
    target = mp.log(u)
    goal = mp.mpf(10) ** (-mp.mp.dps + 8)
    for _ in range(2000):
        value = cdf(x)
        error = mp.log(value) - target if value > 0 else -mp.inf
        if abs(error) < goal or high - low <= goal * max(abs(low), abs(high)):
            return x
        low, high = (x, high) if error < 0 else (low, x)
        slope = pdf(x)
        new = x - error * value / slope if mp.isfinite(error) and slope > 0 else low
        x = new if low < new < high else (low + high) / 2
    raise ArithmeticError(f"no root in {mp.nstr(low)}, {mp.nstr(high)}")


def quantile(u: Number) -> Number:
    """Phi^-1(u), by Newton on log Phi from the left."""
    if u > 0.5:
        return -quantile(1 - u)
    z = -mp.sqrt(-2 * mp.log(u))
    for _ in range(200):
        value = mp.erfc(-z / mp.sqrt(2)) / 2
        step = mp.log(value / u) * value / mp.npdf(z)
        z -= step
        if abs(step) < mp.mpf(10) ** (-mp.mp.dps + 5):
            break
    return z


def truncated_log_density(x: Number, mean: Number, std: Number, low: Number, high: Number) -> Number:
    """Log density of the normal law truncated to [low, high], by definition."""
    return log_gauss(x - mean, std) - mp.log(mass((low - mean) / std, (high - mean) / std))


def truncated_quantile(u: Number, mean: Number, std: Number, low: Number, high: Number) -> Number:
    """Inverse CDF of the truncated normal law, from the nearer end; NaN where the window is empty."""
    if u > 0.5:
        return -truncated_quantile(1 - u, -mean, std, -high, -low)
    a, b = (low - mean) / std, (high - mean) / std
    if mass(a, b) == 0:
        return mp.nan
    start = max(a, min(b, mp.mpf(0)) - 10_000)  # no u is as far out as that
    width = min(b - start, mp.mpf(20_000))
    with mp.workdps(20):
        guess = _offset_guess(float(u), float(start), float(width))
    return mean + std * (start + _offset(u, start, width, guess))


def _offset(u: Number, start: Number, width: Number, guess: Number) -> Number:
    """t such that the standard normal law on [start, start + width] has the share u below start + t."""
    whole = _mass_above(start, width)
    return invert(
        lambda t: _mass_above(start, t) / whole, lambda t: mp.npdf(start + t) / whole, u, guess, mp.mpf(0), width
    )


def _mass_above(start: Number, width: Number) -> Number:
    with mp.extradps(max(0, int(-mp.log10(width))) + 5):  # so that the sum keeps the width
        return mass(start, start + width)


@functools.lru_cache(maxsize=4096)
def _offset_guess(u: float, start: float, width: float) -> Number:
    """A start for `_offset`, shared by the steps of a difference quotient; from where a flat law would have it."""
    share, low, wide = mp.mpf(u), mp.mpf(start), mp.mpf(width)
    slope = mp.npdf(low) / _mass_above(low, wide)
    return _offset(share, low, wide, min(share / slope, wide / 2) if slope > 0 else wide / 2)


def waves(x: Number, std: Number, factor: Callable[[int], Number] = lambda k: mp.mpf(1)) -> Number:
    """Wrapped normal density at x by its Fourier series, each wave k times `factor(k)`."""
    total, k = mp.mpf(1), 1
    while True:
        size = 2 * mp.exp(-((k * std) ** 2) / 2)
        if size < mp.mpf(10) ** (-mp.mp.dps - 5):
            return total / (2 * mp.pi)
        total += size * mp.cos(k * x) * factor(k)
        k += 1


def turns(std: Number) -> range:
    """Images that matter beside the nearest one."""
    count = int(std * mp.sqrt(2 * mp.mp.dps * mp.log(10)) / (2 * mp.pi)) + 2
    return range(-count, count + 1)


def wrapped(x: Number, std: Number) -> Number:
    """Wrapped normal density per radian: images below a width of 3, waves above."""
    x = x - 2 * mp.pi * mp.nint(x / (2 * mp.pi))
    if std > 3:
        return waves(x, std)
    return mp.fsum(mp.exp(log_gauss(x + 2 * mp.pi * k, std)) for k in turns(std))


def wrapped_window(d: Number, std: Number) -> Number:
    """A wrapped normal law turned by a uniform angle in [-pi/2, pi/2], at distance d from its centre."""
    if std > 3:
        return waves(d, std, lambda k: mp.sin(k * mp.pi / 2) / (k * mp.pi / 2))
    half = mp.pi / 2
    return mp.fsum(mass((d - half + 2 * mp.pi * k) / std, (d + half + 2 * mp.pi * k) / std) for k in turns(std)) / mp.pi


def truncated_window(d: Number, std: Number) -> Number:
    """The same for a normal law truncated to [-pi, pi]."""
    half, total = mp.pi / 2, mp.mpf(0)
    for k in (-1, 0, 1):
        start, end = max(d - half + 2 * mp.pi * k, -mp.pi), min(d + half + 2 * mp.pi * k, mp.pi)
        total += mass(start / std, end / std)
    return total / mass(-mp.pi / std, mp.pi / std) / mp.pi
