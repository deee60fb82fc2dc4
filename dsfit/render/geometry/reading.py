"""What the readers of hair files share: files opened carefully, arrays checked strand by strand."""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch

from dsfit.errors import InputError
from dsfit.render.strands import Strands

THINNEST = 0.01
"""Radius given to points of thickness 0, as a share of the thickest of their strand: tips may be drawn as points."""
_LARGEST = 1e30
"""Largest coordinate or thickness: squares of it are still numbers."""


def open_file(path: str | Path, allowed: str) -> tuple[BinaryIO, int]:
    """A regular file, opened for reading, and its size in bytes; `InputError` with the reason where there is none."""
    try:
        mode = os.stat(path).st_mode
        if not stat.S_ISREG(mode):
            raise InputError(str(path), "a folder or a device", allowed)
        file = open(path, "rb")
        return file, os.fstat(file.fileno()).st_size
    except (OSError, ValueError, TypeError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(str(path), getattr(error, "strerror", None) or str(error), allowed) from None


def strands_of_file(path: str | Path, points: np.ndarray, first: np.ndarray, thickness: np.ndarray) -> Strands:
    """Strands of the arrays of a file, float64.

    Args:
        path: for messages.
        points: `[P, 3]`.
        first: `[S + 1]`, first point of every strand.
        thickness: `[P]`, diameters >= 0. A point of thickness 0 gets 1 percent of the greatest of its strand.

    Raises:
        InputError: naming file and strand: coordinates or thicknesses that are not numbers or beyond 1e30, a negative
            thickness, a strand that has none, a strand of one point or of length 0.
    """
    points, thickness = points.astype(np.float64), thickness.astype(np.float64)
    count = np.diff(first)
    _refuse(path, count < 2, "points", count, "two or more points")
    with np.errstate(invalid="ignore", over="ignore"):
        wrong = ~(np.abs(points) <= _LARGEST).all(-1)
        _refuse_point(path, wrong, first, "point", points, "three finite numbers, at most 1e30")
        wrong = ~((thickness >= 0) & (thickness <= _LARGEST))
        _refuse_point(path, wrong, first, "thickness of point", thickness, "a finite number >= 0, at most 1e30")
    most = np.maximum.reduceat(thickness, first[:-1])
    _refuse(path, most <= 0, "thickness", most, "a thickness > 0 at some point")
    spread = np.maximum.reduceat(points, first[:-1]) - np.minimum.reduceat(points, first[:-1])
    _refuse(path, ~(spread.max(-1) > 0), "length", spread.max(-1), "points that are not all the same")
    least = THINNEST * np.repeat(most, count)
    radius = 0.5 * np.where(thickness > 0, thickness, least)
    if not bool((radius > 0).all()):
        raise InputError(f"{path}: thickness", float(thickness[thickness > 0].min()), "diameters above 1e-300")
    return Strands(torch.from_numpy(points), torch.from_numpy(first.astype(np.int64)), torch.from_numpy(radius))


def _refuse(path: str | Path, wrong: np.ndarray, what: str, values: np.ndarray, allowed: str) -> None:
    """Raise `InputError` for the first strand that is wrong, if any."""
    if wrong.any():
        strand = int(np.argmax(wrong))
        raise InputError(f"{path}: {what} of strand {strand}", values[strand].tolist(), allowed)


def _refuse_point(
    path: str | Path, wrong: np.ndarray, first: np.ndarray, what: str, values: np.ndarray, allowed: str
) -> None:
    """Raise `InputError` for the first point that is wrong, if any."""
    if wrong.any():
        point = int(np.argmax(wrong))
        strand = int(np.searchsorted(first, point, side="right")) - 1
        place = f"{what} {point - int(first[strand])} of strand {strand}"
        raise InputError(f"{path}: {place}", values[point].tolist(), allowed)
