"""OpenEXR images: read with every kind of damage named, write atomically.

The OpenEXR library reports damage in ways that are hard to act on: `Unable to open 'x.exr' for read` whether a file is
missing, empty, truncated or text; a file with "0 parts" and lines on stdout and stderr for a truncated one;
`UnicodeDecodeError` for a damaged header. `read_exr` therefore walks the header and the chunk table itself first,
following the published file layout (https://openexr.com/en/latest/OpenEXRFileLayout.html), and hands a file to the
library only when its length and tables are sound. What can remain is a damaged compressed chunk (the library prints, we
raise) or flipped bits in pixel data: EXR has no checksum.
"""

from __future__ import annotations

import math
import os
import struct
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dsfit.errors import InputError

MAGIC = b"\x76\x2f\x31\x01"
MAX_VALUES = 1 << 29
"""Largest number of pixel values (height x width x channels) accepted from a file: 2 GiB of float32."""
_TILED, _DEEP, _MULTIPART = 0x200, 0x800, 0x1000
# Scanlines in one chunk, by the number of the compression method; others are left to the library to judge.
_CHUNK_LINES = {0: 1, 1: 1, 2: 1, 3: 16, 4: 32, 5: 16, 6: 32, 7: 32, 8: 32, 9: 256}
_RESERVED = {
    "channels", "chunkCount", "compression", "dataWindow", "displayWindow", "lineOrder", "name", "pixelAspectRatio",
    "screenWindowCenter", "screenWindowWidth", "tiles", "type", "version", "view",
}  # fmt: skip


@dataclass(frozen=True)
class ExrImage:
    """Pixels of an EXR file.

    Args:
        pixels: float32 `[H, W, C]`; row 0 is the top one.
        channels: the C channel names, R, G, B, A first and others in alphabetical order, or as asked for.
        metadata: the custom header attributes (`str`, `int`, `float`, ...), without those that describe the layout of
            the file.
        path: where it came from.
    """

    pixels: Tensor
    channels: tuple[str, ...]
    metadata: dict[str, Any] = field(default_factory=dict)
    path: Path = Path()


def _order(name: str) -> tuple[int, str]:
    rank = {"R": 0, "G": 1, "B": 2, "A": 3}
    return rank.get(name, 4), name


def _attributes(data: bytes, fail: Any) -> tuple[dict[str, bytes], int]:
    """Header attributes as raw bytes by name, and where the header ends."""
    position, found = 8, {}
    while True:
        if position >= len(data):
            fail("a header cut off by the end of the file")
        if data[position] == 0:
            return found, position + 1
        words = []
        for _ in range(2):
            end = data.find(b"\0", position, position + 256)
            if end < 0:
                fail("a damaged header (attribute without an end)")
            words.append(data[position:end])
            position = end + 1
        if position + 4 > len(data):
            fail("a header cut off by the end of the file")
        size = struct.unpack_from("<i", data, position)[0]
        position += 4
        if size < 0 or position + size > len(data):
            fail(f"a truncated or damaged header (attribute {words[0]!r} claims {size} bytes)")
        found[words[0].decode("latin-1")] = data[position : position + size]
        position += size


def _channel_list(raw: bytes, fail: Any) -> list[str]:
    names, position = [], 0
    while position < len(raw) and raw[position] != 0:
        end = raw.find(b"\0", position)
        if end < 0 or end + 17 > len(raw):
            fail("a damaged header (channel list)")
        name = raw[position:end].decode("latin-1")
        sampling = struct.unpack_from("<ii", raw, end + 9)
        if sampling != (1, 1):
            fail(f"channel {name!r} subsampled by {sampling[0]} x {sampling[1]}")
        names.append(name)
        position = end + 17
    return names


def _inspect(data: bytes, fail: Any) -> tuple[int, int, list[str]]:
    """Height, width and channel names of a sound single-part file; `fail(what)` raises for any other."""
    if len(data) == 0:
        fail("an empty file")
    if data[:4] != MAGIC[: len(data[:4])] or len(data) < 8:
        fail(f"a file of {len(data)} bytes that starts with {data[:4]!r}, not with the EXR magic number")
    flags = struct.unpack_from("<I", data, 4)[0]
    if flags & 0xFF != 2:
        fail(f"EXR format version {flags & 0xFF}")
    if flags & (_DEEP | _MULTIPART):
        fail("a deep or multi-part file")
    header, end = _attributes(data, fail)
    for name, size in (("channels", 1), ("compression", 1), ("dataWindow", 16), ("displayWindow", 16)):
        if len(header.get(name, b"")) < size:
            fail(f"a header without a valid {name!r}")
    x0, y0, x1, y1 = struct.unpack("<4i", header["dataWindow"][:16])
    width, height = x1 - x0 + 1, y1 - y0 + 1
    if width < 1 or height < 1:
        fail(f"an image of zero size ({width} x {height} pixels)")
    names = _channel_list(header["channels"], fail)
    if not names:
        fail("an image without channels")
    if height * width * len(names) > MAX_VALUES:
        fail(f"{width} x {height} pixels x {len(names)} channels, more than {MAX_VALUES} values")
    lines = None if flags & _TILED else _CHUNK_LINES.get(header["compression"][0])
    if lines is not None:
        _check_chunks(data, end, math.ceil(height / lines), fail)
    return height, width, names


def _check_chunks(data: bytes, table: int, count: int, fail: Any) -> None:
    """Every scanline chunk lies inside the file: a truncated file is told from a whole one without decoding it."""
    start = table + 8 * count
    if start > len(data):
        fail(f"a truncated file ({len(data)} bytes, the table of {count} chunks alone ends at {start})")
    for offset in struct.unpack_from(f"<{count}Q", data, table):
        if offset < start:
            fail(f"an incomplete or damaged file (a chunk starts at byte {offset}, inside the header)")
        if offset + 8 > len(data) or (size := struct.unpack_from("<i", data, offset + 4)[0]) < 0:
            fail(f"a truncated or damaged file ({len(data)} bytes, a chunk starts at {offset})")
        if offset + 8 + size > len(data):
            fail(f"a truncated file ({len(data)} bytes, a chunk ends at {offset + 8 + size})")


def read_exr(path: str | os.PathLike[str], channels: Sequence[str] | None = None) -> ExrImage:
    """Read a single-part, flat EXR image (scanline or tiled, any compression) as float32.

    Args:
        path: the file.
        channels: names to read, in this order; left out, all of them (R, G, B, A first, then alphabetical).

    Returns:
        The image. NaN, infinite and negative values are returned as they are: what they mean is the caller's business.

    Raises:
        InputError: the file is missing, no file, not EXR, of zero size, truncated, damaged, deep, multi-part,
            subsampled, larger than `MAX_VALUES`, or lacks a channel asked for. It names the file and what is wrong.
    """
    path = Path(path)

    def fail(what: str, allowed: str = "a complete single-part OpenEXR image") -> None:
        raise InputError(f"EXR file {str(path)!r}", what, allowed)

    if not path.exists():
        fail("no such file")
    if not path.is_file():
        fail("a directory or special file")
    try:
        data = path.read_bytes()
    except OSError as error:
        fail(f"unreadable ({error.strerror})")
    height, width, names = _inspect(data, fail)
    wanted = tuple(sorted(names, key=_order)) if channels is None else tuple(channels)
    missing = [name for name in wanted if name not in names]
    if missing:
        fail(f"channels {names}, without {missing}", f"an image with channels {list(wanted)}")

    import OpenEXR  # here, so that importing dsfit does not load it

    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            planes = {name: np.array(channel.pixels, np.float32) for name, channel in file.channels().items()}
            header = dict(file.header())
    except (
        Exception
    ) as error:  # RuntimeError, ValueError ("0 parts"), KeyError, UnicodeDecodeError: all mean damage here
        fail(f"damaged, OpenEXR says {type(error).__name__}: {str(error)[:60]}")
    if any(name not in planes or planes[name].shape != (height, width) for name in wanted):
        fail("damaged: decoded channels do not have the size the header states")
    pixels = torch.from_numpy(np.stack([planes[name] for name in wanted], axis=-1))
    metadata = {key: value for key, value in header.items() if key not in _RESERVED}
    return ExrImage(pixels, wanted, metadata, path)


def _plane(name: str, value: Any) -> np.ndarray:
    array = value.detach().cpu().numpy() if isinstance(value, Tensor) else np.asarray(value)
    if array.dtype not in (np.float16, np.float32, np.uint32):
        if array.dtype.kind not in "fiub":
            raise InputError(f"channels[{name!r}]", array.dtype, "real numbers")
        array = array.astype(np.float32)
    return np.ascontiguousarray(array)


def write_exr(
    path: str | os.PathLike[str],
    channels: Mapping[str, Any],
    metadata: Mapping[str, str | int | float] | None = None,
    *,
    compression: str = "zip",
) -> Path:
    """Write an EXR image so that `path` holds either what was there before or the whole new image, never a part.

    Args:
        path: the file; its directory must exist.
        channels: tensors or arrays by channel name, all `[H, W]`; the names "RGB" and "RGBA" (or "layer.RGB") take `[H,
            W, 3]` and `[H, W, 4]`. float16, float32 and uint32 are stored as they are, every other dtype as float32.
            NaN and inf are kept.
        metadata: custom header attributes: `str`, `float`, and `int` of 32 bits.
        compression: one of none, rle, zips, zip, piz (all lossless).

    Returns:
        The path.

    Raises:
        InputError: no channels, shapes that differ or are of zero size, metadata of another type or with a reserved
            name, an unknown compression, or a directory that cannot be written to.
    """
    import OpenEXR

    path = Path(path)
    methods = {"none": "NO", "rle": "RLE", "zips": "ZIPS", "zip": "ZIP", "piz": "PIZ"}
    if compression not in methods:
        raise InputError("compression", compression, "one of " + ", ".join(methods))
    planes: dict[str, np.ndarray] = {}
    for name, value in channels.items():
        array, last = _plane(name, value), name.rsplit(".", 1)[-1]
        width = len(last) if last in ("RGB", "RGBA") else 0
        if array.ndim != (3 if width else 2) or array.size == 0 or (width and array.shape[2] != width):
            raise InputError(
                f"channels[{name!r}]", array.shape, f"shape [H, W{f', {width}' if width else ''}], not empty"
            )
        for index, letter in enumerate(last if width else [last]):
            planes[name[: len(name) - len(last)] + letter] = np.ascontiguousarray(array[..., index] if width else array)
    if len({array.shape for array in planes.values()}) != 1:
        raise InputError("channels", {k: v.shape for k, v in planes.items()}, "at least one channel, all of one shape")
    header: dict[str, Any] = {
        "compression": getattr(OpenEXR, methods[compression] + "_COMPRESSION"),
        "type": OpenEXR.scanlineimage,
    }
    for key, value in (metadata or {}).items():
        ok = isinstance(value, str | float) or (isinstance(value, int) and abs(value) < 2**31)
        if key in _RESERVED or not ok or not 0 < len(key) < 256:
            raise InputError(
                f"metadata[{key!r}]", value, "str, float or 32-bit int under a name the format does not reserve"
            )
        # float() and int(): the library rejects numpy scalars and writes bool as int anyway.
        header[key] = value if isinstance(value, str) else float(value) if isinstance(value, float) else int(value)
    if not path.parent.is_dir():
        raise InputError(f"EXR file {str(path)!r}", "no such directory", "a path in an existing directory")
    try:
        handle, temporary = tempfile.mkstemp(suffix=".exr", prefix=f".{path.name}.", dir=path.parent)
        os.close(handle)
    except OSError as error:
        raise InputError(f"EXR file {str(path)!r}", error.strerror, "a path in a writable directory") from error
    try:
        OpenEXR.File(header, planes).write(temporary)
        umask = os.umask(0)
        os.umask(umask)
        os.chmod(temporary, 0o666 & ~umask)  # mkstemp makes files private
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise
    return path
