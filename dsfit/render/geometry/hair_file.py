"""Cem Yuksel's `.hair` files (http://www.cemyuksel.com/research/hairmodels/): read and written.

A header of 128 bytes, little endian: the letters HAIR, numbers of strands and points, bits that say which arrays
follow, defaults for arrays that do not, and 88 bytes of text. Then the arrays: segments per strand (uint16), points (3
float32 each), thickness (float32 per point), transparency (float32 per point), colour (3 float32 per point).
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import BinaryIO

import numpy as np

from dsfit.errors import InputError
from dsfit.render.geometry.reading import open_file, strands_of_file
from dsfit.render.geometry.transform import turned_up
from dsfit.render.strands import Strands

_HEADER = struct.Struct("<4sIIIIff3f88s")
_SEGMENTS, _POINTS, _THICKNESS, _TRANSPARENCY, _COLOUR = (1 << bit for bit in range(5))
_MOST_SEGMENTS = 2**16 - 1
_MOST_POINTS = 200_000_000
"""Largest file that is read: 2.4 GB of points, which become 6.4 GB of float64."""
_ALLOWED = "a .hair file"


def read_hair(path: str | Path, *, up: str = "y") -> Strands:
    """The strands of a `.hair` file, float64, in the file's unit of length.

    The file's thickness is taken as the diameter of the fibre; points of thickness 0 get 1 percent of the greatest
    thickness of their strand. Transparency and colour are not used.

    Args:
        path: of the file.
        up: the axis that points up in the file, "x", "y", "z", "-x", "-y" or "-z"; strands are rotated to y up.
            Yuksel's own models have "z".

    Raises:
        InputError: naming the file, the place and what is allowed: no such file; not a `.hair` file; sizes that do not
            agree with each other or with the length of the file (nothing is allocated for them); strands of one point
            or of length 0; coordinates that are not finite; a thickness that is negative or not finite.
    """
    file, size = open_file(path, _ALLOWED)
    with file:
        return turned_up(_read(path, file, size), up)


def _read(path: str | Path, file: BinaryIO, size: int) -> Strands:
    if size < _HEADER.size:
        raise InputError(f"{path}: header", f"a file of {size} bytes", "128 bytes of header")
    fields = _HEADER.unpack(_take(path, file, _HEADER.size))
    magic, strands, points, arrays, segments, thickness = fields[:6]
    if magic != b"HAIR":
        raise InputError(f"{path}: bytes 0 to 3", magic, "the letters HAIR")
    if not arrays & _POINTS or arrays >> 5:
        raise InputError(f"{path}: bit array", bin(arrays), "bits 0 to 4, bit 1 (points) set")
    if strands < 1:
        raise InputError(f"{path}: number of strands", strands, "at least 1")
    if points > _MOST_POINTS:
        raise InputError(f"{path}: number of points", points, f"at most {_MOST_POINTS}")
    listed = bool(arrays & _SEGMENTS)
    if not listed and not 1 <= segments <= points:
        raise InputError(f"{path}: default number of segments", segments, "1 or more, where strands do not list theirs")
    per_point = 4 * (3 + bool(arrays & _THICKNESS) + bool(arrays & _TRANSPARENCY) + 3 * bool(arrays & _COLOUR))
    needed = _HEADER.size + 2 * strands * listed + per_point * points
    if size != needed:
        said = f"{needed} bytes, which {strands} strands and {points} points with the arrays {bin(arrays)} take"
        raise InputError(f"{path}: length of the file", f"{size} bytes", said)
    counts = None
    if listed:
        counts = np.frombuffer(_take(path, file, 2 * strands), dtype="<u2").astype(np.int64) + 1
    total = strands * (segments + 1) if counts is None else int(counts.sum())
    if total != points:
        raise InputError(f"{path}: number of points", points, f"{total}, which the strands have by their segments")
    if counts is None:  # only now: these numbers agree with the length of the file
        counts = np.full(strands, segments + 1, dtype=np.int64)
    place = np.frombuffer(_take(path, file, 12 * points), dtype="<f4").reshape(points, 3)
    if arrays & _THICKNESS:
        width = np.frombuffer(_take(path, file, 4 * points), dtype="<f4")
    elif not 0 < thickness < np.inf:
        allowed = "a finite number > 0, where points do not list theirs"
        raise InputError(f"{path}: default thickness", thickness, allowed)
    else:
        width = np.full(points, thickness, dtype=np.float64)
    return strands_of_file(path, place, np.concatenate([[0], counts.cumsum()]), width)


def _take(path: str | Path, file: BinaryIO, size: int) -> bytes:
    """The next bytes of a file whose length was checked: it may have been cut short meanwhile."""
    data = file.read(size)
    if len(data) != size:
        raise InputError(f"{path}: length of the file", "cut short while it was read", _ALLOWED)
    return data


def write_hair(strands: Strands, path: str | Path, *, info: str = "") -> None:
    """Write strands as a `.hair` file, in their own axes and unit; read back, they are the same to float32.

    The array of segments is left out where all strands have as many, that of thicknesses where all are equal.

    Args:
        strands: to write, at most 65,535 segments each.
        path: of the file, written under a temporary name and renamed.
        info: text for the header, at most 88 bytes of ASCII.

    Raises:
        InputError: a strand of too many segments, a text too long, numbers beyond float32.
    """
    from dsfit.experiment.files import write_bytes  # here: its package loads all proposals

    text = info.encode("ascii", errors="replace")
    if len(text) > 88:
        raise InputError("write_hair.info", info, "at most 88 characters")
    segments = strands.first.diff().numpy() - 1
    if segments.max() > _MOST_SEGMENTS:
        raise InputError("write_hair.strands", int(segments.max()), f"at most {_MOST_SEGMENTS} segments per strand")
    with np.errstate(over="ignore", under="ignore"):
        points = strands.points.detach().numpy().astype("<f4")
        width = (2.0 * strands.radius.detach().double().numpy()).astype("<f4")
    if not np.isfinite(points).all() or not np.isfinite(width).all() or not (width > 0).all():
        raise InputError("write_hair.strands", "numbers beyond float32", "coordinates and radii that float32 can hold")
    even, thick = bool((segments == segments[0]).all()), bool((width == width[0]).all())
    arrays = _POINTS | (0 if even else _SEGMENTS) | (0 if thick else _THICKNESS)
    header = _HEADER.pack(
        b"HAIR", len(segments), len(points), arrays, int(segments[0]), float(width[0]), 0.0, 1.0, 1.0, 1.0, text
    )
    parts = [header, b"" if even else segments.astype("<u2").tobytes(), points.tobytes()]
    write_bytes(path, b"".join([*parts, b"" if thick else width.tobytes()]))
