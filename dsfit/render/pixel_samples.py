"""Places within pixels: an Owen-scrambled (0,2)-sequence for every pixel, the same in whatever order pixels come."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor


@np.errstate(over="ignore")
def pixel_samples(row: Tensor, column: Tensor, samples: int, seed: int) -> Tensor:
    """Points `[*batch, samples, 2]` in (0, 1)^2, float64: for every pixel the first points of Sobol's (0,2)-sequence
    with its own nested scrambling, a function of row, column and seed alone.

    Any aligned run of 2^k points of a pixel has one point in each elementary interval of area 2^-k; every point by
    itself is uniform over the pixel, so averages are unbiased. Scrambling by hashing: Burley 2020, "Practical
    hash-based Owen scrambling", JCGT 9(4).
    """
    state = _mix(np.uint32(seed & 0xFFFFFFFF) ^ np.uint32(0x9E3779B9))
    state = _mix(state + np.uint32((seed >> 32) & 0xFFFFFFFF))
    state = _mix(state + row.numpy().astype(np.uint32))
    state = _mix(state * np.uint32(0x85EBCA6B) + column.numpy().astype(np.uint32))[..., None]
    index = np.arange(samples, dtype=np.uint32)
    # `index` is the first coordinate with its digits reversed, the form in which nested scrambling is a multiplication
    first = _reverse(_scramble(index, _mix(state ^ np.uint32(0xA511E9B3))))
    second = _reverse(_scramble(_reverse(_sobol(index)), _mix(state ^ np.uint32(0x63D83595))))
    both = np.stack([first, second], axis=-1)
    return torch.from_numpy((both.astype(np.float64) + 0.5) * 2.0**-32)


def _mix(x: np.ndarray) -> np.ndarray:
    """A bijection of 32 bits in which every bit of the result depends on every bit given (Wellons' lowbias32)."""
    x = (x ^ (x >> np.uint32(16))) * np.uint32(0x7FEB352D)
    x = (x ^ (x >> np.uint32(15))) * np.uint32(0x846CA68B)
    return x ^ (x >> np.uint32(16))


def _scramble(x: np.ndarray, seed: np.ndarray) -> np.ndarray:
    """Hash in which a bit depends on the lower bits alone (Laine and Karras 2011, constants by Vegdahl)."""
    x = x ^ (x * np.uint32(0x3D20ADEA))
    x = (x + seed) * ((seed >> np.uint32(16)) | np.uint32(1))
    x = x ^ (x * np.uint32(0x05526C56))
    return x ^ (x * np.uint32(0x53A22864))


def _sobol(index: np.ndarray) -> np.ndarray:
    """Second coordinate of Sobol's sequence, as 32 binary digits."""
    value, direction = np.zeros_like(index), np.uint32(1 << 31)
    for k in range(32):
        value = value ^ np.where((index >> np.uint32(k)) & np.uint32(1), direction, np.uint32(0))
        direction = direction ^ (direction >> np.uint32(1))
    return value


def _reverse(x: np.ndarray) -> np.ndarray:
    """The 32 bits in reverse order."""
    for shift, mask in ((1, 0x55555555), (2, 0x33333333), (4, 0x0F0F0F0F), (8, 0x00FF00FF)):
        low = np.uint32(mask)
        x = ((x >> np.uint32(shift)) & low) | ((x & low) << np.uint32(shift))
    return (x >> np.uint32(16)) | (x << np.uint32(16))
