"""EXR files: whatever is in them, an image or one `InputError` that names the file, in a bounded amount of memory."""

from __future__ import annotations

import os
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dsfit.errors import InputError
from dsfit.scene import read_exr, write_exr
from dsfit.scene.exr import MAGIC, MAX_VALUES
from tests.fuzz.common import fuzz, listing

PARENT = """
import resource, sys
from pathlib import Path
from tests.fuzz.test_exr import hammer
used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + (3 << 30),) * 2)
resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
hammer(Path(sys.argv[1]))
"""


def sources(folder: Path) -> list[bytes]:
    """Files by OpenEXR itself: every kind of compression, half floats, tiles, windows off the origin, odd names."""
    found = []
    pixels = np.random.default_rng(0).random((9, 14, 3)).astype("f")
    tile = OpenEXR.TileDescription()
    tile.xSize, tile.ySize = 4, 4
    window = (np.array([3, -2], np.int32), np.array([16, 6], np.int32))
    for options, channels in [
        *(
            ({"compression": getattr(OpenEXR, f"{c}_COMPRESSION")}, {"RGB": pixels})
            for c in ("NO", "ZIP", "PIZ", "B44")
        ),
        ({"type": OpenEXR.tiledimage, "tiles": tile}, {"RGB": pixels.astype(np.float16)}),
        ({"dataWindow": window, "comment": "x" * 300}, {"Y": pixels[..., 0], "ü.long name" * 3: pixels[..., 1]}),
    ]:
        header = {"compression": OpenEXR.ZIPS_COMPRESSION, "type": OpenEXR.scanlineimage, **options}
        OpenEXR.File(header, channels).write(str(folder / "source.exr"))
        found.append((folder / "source.exr").read_bytes())
    return found


def header(*attributes: tuple[bytes, bytes, int | None, bytes], flags: int = 2) -> bytes:
    """A header of these (name, type, size or None for the true one, value)."""
    parts = [MAGIC, struct.pack("<I", flags)]
    for name, kind, size, value in attributes:
        parts += [name, b"\0", kind, b"\0", struct.pack("<i", len(value) if size is None else size), value]
    return b"".join([*parts, b"\0"])


def channel(name: bytes, kind: int = 2, sampling: tuple[int, int] = (1, 1)) -> bytes:
    return name + b"\0" + struct.pack("<iB3xii", kind, 0, *sampling)


sizes = st.sampled_from([0, 1, 7, 2**15, 2**24, 2**31 - 1, -1, -(2**31)]) | st.integers(-4, 40)
names = st.sampled_from([b"R", b"G", b"B", b"Y", b"A", b"", b"\xff\xfe", b"n" * 254, b"n" * 300, b"a.b.R"]) | st.binary(
    max_size=5
)


@st.composite
def forged(draw: st.DrawFn) -> bytes:
    """Files from a grammar of headers: any window, channels, compression, sizes that lie, chunk offsets that lie."""
    channels = b"".join(
        channel(
            name, draw(st.sampled_from([0, 1, 2, 2, 2, 3, -1])), draw(st.sampled_from([(1, 1)] * 4 + [(0, 0), (2, 1)]))
        )
        for name in draw(st.lists(names, max_size=4))
    ) + draw(st.sampled_from([b"\0", b"\0", b"\0", b""]))
    window = struct.pack("<4i", *(draw(sizes) for _ in range(4)))
    lie = draw(st.sampled_from([None] * 6 + [0, 2**31 - 1, -1]))
    attributes = [
        (b"channels", b"chlist", lie, channels),
        (b"compression", b"compression", None, bytes([draw(st.integers(0, 12))])),
        (b"dataWindow", b"box2i", None, window),
        (b"displayWindow", b"box2i", None, draw(st.sampled_from([window, bytes(16), b""]))),
        (b"lineOrder", b"lineOrder", None, bytes([draw(st.integers(0, 3))])),
        (b"pixelAspectRatio", b"float", None, struct.pack("<f", draw(st.floats(width=32)))),
        (b"screenWindowCenter", b"v2f", None, struct.pack("<2f", 0, 0)),
        (b"screenWindowWidth", b"float", None, struct.pack("<f", 1)),
    ]
    dropped = draw(st.sets(st.integers(0, 7), max_size=1))
    start = header(
        *(a for k, a in enumerate(attributes) if k not in dropped),
        flags=draw(st.sampled_from([2] * 5 + [0x202, 3, 0x402])),
    )
    table = b"".join(
        struct.pack("<q", x)
        for x in draw(
            st.lists(
                st.sampled_from([0, len(start), len(start) + 8, 2**40, -1]) | st.integers(0, len(start) + 200),
                max_size=4,
            )
        )
    )
    return start + table + draw(st.binary(max_size=60))


damage = st.tuples(
    st.integers(0, 5),
    st.lists(st.tuples(st.floats(0, 1), st.sampled_from([0, 1, 127, 128, 255]) | st.integers(0, 255)), max_size=5),
    st.booleans(),
    st.just(1.0) | st.floats(0, 1),
    st.binary(max_size=4),
)


def hammer(folder: Path) -> None:
    """Read forged and damaged files; run in a process of its own, because a decoder may crash."""
    whole = sources(folder)
    count = {"error": 0, "read": 0}

    def read(data: bytes) -> None:
        path = folder / "fuzz.exr"
        path.write_bytes(data)
        try:
            image = read_exr(path)
        except InputError as error:
            assert "fuzz.exr" in str(error)
            count["error"] += 1
        else:
            assert image.pixels.ndim == 3 and 0 < image.pixels.numel() <= MAX_VALUES
            assert image.pixels.dtype == torch.float32 and image.pixels.shape[2] == len(image.channels)
            count["read"] += 1

    @fuzz(200)
    @given(forged())
    def headers(data: bytes) -> None:
        read(data)

    @fuzz(200)
    @given(damage)
    def bytes_(how: tuple) -> None:
        number, edits, in_header, keep, tail = how
        data = bytearray(whole[number])
        for where, value in edits:
            data[int(where * (min(450, len(data)) - 1 if in_header else len(data) - 1))] = value
        read(bytes(data[: int(keep * len(data))]) + tail)

    @fuzz(100)
    @given(st.binary(max_size=80), st.booleans())
    def noise(data: bytes, magic: bool) -> None:
        read(MAGIC + b"\2\0\0\0" + data if magic else data)

    for test in (headers, bytes_, noise):
        test()
    for data in whole:
        for length in range(0, len(data), max(1, len(data) // 60)):
            read(data[:length])
    print("counts", count["error"], count["read"])


def test_any_file_is_an_image_or_an_input_error(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", PARENT, str(tmp_path)],
        cwd=Path(__file__).parents[2],
        capture_output=True,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        timeout=1800,
        errors="replace",
    )
    assert done.returncode == 0, done.stderr[-3000:]
    errors, read = map(int, done.stdout.rsplit("counts ", 1)[1].split())
    assert errors > 200 and read > 20


def test_a_header_that_promises_a_huge_image_takes_no_memory(tmp_path: Path) -> None:
    """Sizes just below the limit, but no pixels behind them."""
    for compression in range(10):
        window = struct.pack("<4i", 0, 0, 2**14 - 1, 2**13 - 1)
        data = header(
            (b"channels", b"chlist", None, channel(b"B") + channel(b"G") + channel(b"R") + b"\0"),
            (b"compression", b"compression", None, bytes([compression])),
            (b"dataWindow", b"box2i", None, window),
            (b"displayWindow", b"box2i", None, window),
        )
        (tmp_path / "big.exr").write_bytes(data + bytes(100))
        with pytest.raises(InputError, match=r"big\.exr.*truncated"):
            read_exr(tmp_path / "big.exr")


planes = st.dictionaries(
    st.sampled_from(["R", "Y", "RGB", "RGBA", "x.RGB", "ü", "n" * 300, ""]) | st.text(max_size=4),
    st.tuples(st.lists(st.integers(0, 3), max_size=4), st.sampled_from(["f", "d", "e", "u4", "i8", "?", "c8", "U3"])),
    max_size=3,
)
metadata = st.dictionaries(
    st.text(max_size=5) | st.sampled_from(["dataWindow", "channels", "a" * 300, "type"]),
    st.text(max_size=5) | st.floats() | st.integers() | st.none() | st.just([1]),
    max_size=2,
)


@fuzz(150)
@given(planes, metadata, st.sampled_from(["zip", "none", "piz", "jpeg", None]))
def test_any_image_is_written_whole_or_not_at_all(
    tmp_path_factory: pytest.TempPathFactory, channels: dict, extra: dict, compression: str | None
) -> None:
    folder = tmp_path_factory.mktemp("exr")
    arrays = {name: np.ones(shape, dtype) for name, (shape, dtype) in channels.items()}
    try:
        path = write_exr(folder / "a.exr", arrays, extra, compression=compression)
    except InputError:
        assert listing(folder) == {}
    else:
        assert list(listing(folder)) == ["a.exr"]
        assert read_exr(path).pixels.numel() > 0
