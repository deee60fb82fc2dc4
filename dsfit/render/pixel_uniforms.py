"""Uniform numbers that belong to pixels: functions of (key, pixel, place in the pixel), whatever else is drawn with
them, so that a picture does not depend on its tiles.

Numbers come from SplitMix64 (Steele, Lea and Flood 2014) used as a hash: a counter run through its finaliser.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.quasirandom import SobolEngine

from dsfit.random import _BITS, _scramble, _to_open_unit

_STEP = 0x9E3779B97F4A7C15 - 2**64
_FIRST, _SECOND = 0xBF58476D1CE4E5B9 - 2**64, 0x94D049BB133111EB - 2**64


def mix(x: Tensor) -> Tensor:
    """The finaliser: a bijection of 64 bits (int64) in which every bit depends on all, modulo 2^64 throughout."""
    x = (x ^ ((x >> 30) & ((1 << 34) - 1))).mul_(_FIRST)
    x.bitwise_xor_((x >> 27).bitwise_and_((1 << 37) - 1)).mul_(_SECOND)
    return x.bitwise_xor_((x >> 31).bitwise_and_((1 << 33) - 1))


def states(key: int, *numbers: Tensor) -> Tensor:
    """One state for every entry of the numbers (int64, broadcast together)."""
    state = mix(torch.tensor(key * 2 + 1, dtype=torch.int64) * _STEP)
    for number in numbers:
        state = mix(state + number * _STEP)
    return state


def independent(state: Tensor, first: int, samples: int, dimension: int, dtype: torch.dtype) -> Tensor:
    """`[samples, *state, dimension]` numbers in (0, 1): the samples from the `first` on of every state's sequence."""
    count = torch.arange(first * dimension, (first + samples) * dimension) * _STEP
    count = count.reshape(samples, *[1] * state.ndim, dimension)
    digits = mix(state.unsqueeze(-1) + count).bitwise_and_((1 << _BITS) - 1)
    return _to_open_unit(digits, dtype)


class SobolPoints:
    """Sobol points with one random linear scrambling and digital shift for each state (`dsfit.random`).

    Args:
        state: `[P]`, one for every point set.
        points: how many points of each set will be asked for.
        dimension: numbers per point.
    """

    def __init__(self, state: Tensor, points: int, dimension: int) -> None:
        self.levels = max(1, (points - 1).bit_length())
        count = torch.arange((self.levels + 1) * dimension).reshape(self.levels + 1, 1, dimension) * _STEP
        bits = mix(state.unsqueeze(-1) + count).bitwise_and_((1 << _BITS) - 1)
        self.shift = bits[0]
        self.directions = _scramble(SobolEngine(dimension).sobolstate, bits[1:], self.levels)

    def run(self, level: int) -> Tensor:
        """The first 2^level points `[2^level, P, dimension]`, before the shift, as digits: with `start` they make any
        aligned run of that many."""
        points = torch.zeros_like(self.shift).unsqueeze(0)
        for k in range(level):
            points = torch.cat([points, points ^ self.directions[k]])
        return points

    def start(self, index: Tensor, which: Tensor) -> Tensor:
        """The shifted points number `index [H]` of the sets `which [H]`, `[H, dimension]`."""
        found = self.shift[which]
        for k in range(self.levels):
            bit = ((index >> k) & 1).unsqueeze(-1)
            if bool(bit.any()):
                found = found ^ self.directions[k][which] * bit
        return found


def to_unit(digits: Tensor, dtype: torch.dtype) -> Tensor:
    """Digits of Sobol points as numbers in (0, 1)."""
    return _to_open_unit(digits, dtype)
