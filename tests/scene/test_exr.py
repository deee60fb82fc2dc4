"""EXR files: round trips through OpenEXR, atomic writes, and one clear error for every kind of damage."""

from __future__ import annotations

import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import torch

from dsfit.errors import InputError
from dsfit.scene import EnvironmentLight, read_exr, write_exr


def pixels(height: int = 8, width: int = 16, channels: int = 3) -> np.ndarray:
    return np.random.default_rng(0).random((height, width, channels)).astype(np.float32)


def raw(path: Path, array: np.ndarray | None = None, compression: str = "ZIP", **header) -> bytes:
    """A file written by OpenEXR itself, and its bytes."""
    header = {"compression": getattr(OpenEXR, compression + "_COMPRESSION"), "type": OpenEXR.scanlineimage, **header}
    OpenEXR.File(header, {"RGB": pixels() if array is None else array}).write(str(path))
    return path.read_bytes()


@pytest.mark.parametrize("compression", ["NO", "RLE", "ZIPS", "ZIP", "PIZ"])
def test_reads_what_openexr_writes(tmp_path: Path, compression: str) -> None:
    array = pixels(37, 5)
    raw(tmp_path / "a.exr", array, compression, comment="hair", exposure=1.5)
    image = read_exr(tmp_path / "a.exr")
    assert image.channels == ("R", "G", "B") and image.pixels.dtype == torch.float32
    assert np.array_equal(image.pixels.numpy(), array)
    assert image.metadata == {"comment": "hair", "exposure": 1.5}


def test_reads_tiled_half_and_offset_windows(tmp_path: Path) -> None:
    tile = OpenEXR.TileDescription()
    tile.xSize, tile.ySize = 4, 4
    array = pixels().astype(np.float16)
    raw(tmp_path / "t.exr", array, type=OpenEXR.tiledimage, tiles=tile)
    assert np.array_equal(read_exr(tmp_path / "t.exr").pixels.numpy(), array.astype(np.float32))
    window = (np.array([3, -2], np.int32), np.array([18, 5], np.int32))
    raw(tmp_path / "w.exr", array, dataWindow=window)
    assert np.array_equal(read_exr(tmp_path / "w.exr").pixels.numpy(), array.astype(np.float32))


@pytest.mark.parametrize("compression", ["none", "rle", "zips", "zip", "piz"])
def test_openexr_reads_what_we_write(tmp_path: Path, compression: str) -> None:
    array = pixels()
    path = write_exr(
        tmp_path / "a.exr",
        {
            "RGB": torch.from_numpy(array),
            "variance.RGB": array.astype(np.float64),
            "n": array[..., 0].astype(np.float16),
        },
        {"samples": 64, "seconds": 1.25, "commit": "abc"},
        compression=compression,
    )
    with OpenEXR.File(str(path), separate_channels=True) as file:
        channels = {name: np.array(channel.pixels) for name, channel in file.channels().items()}
        header = dict(file.header())
    assert set(channels) == {"R", "G", "B", "variance.R", "variance.G", "variance.B", "n"}
    assert np.array_equal(channels["G"], array[..., 1]) and np.array_equal(channels["variance.B"], array[..., 2])
    assert channels["n"].dtype == np.float16 and channels["variance.R"].dtype == np.float32
    assert (header["samples"], header["seconds"], header["commit"]) == (64, 1.25, "abc")
    image = read_exr(path, ["variance.G", "R"])
    assert np.array_equal(image.pixels.numpy(), array[..., [1, 0]])
    assert image.metadata == {"samples": 64, "seconds": 1.25, "commit": "abc"}
    assert list(tmp_path.iterdir()) == [path]


def test_special_values_survive(tmp_path: Path) -> None:
    array = np.array([[np.nan, np.inf], [-1.0, 1e-45]], np.float32)
    write_exr(tmp_path / "a.exr", {"Y": array})
    assert np.array_equal(read_exr(tmp_path / "a.exr").pixels[..., 0].numpy(), array, equal_nan=True)


def test_a_failed_write_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_exr(tmp_path / "a.exr", {"RGB": pixels()})
    before = path.read_bytes()

    class Failing:
        def __init__(self, *args: object) -> None:
            pass

        def write(self, name: str) -> None:
            Path(name).write_bytes(b"half a fi")
            raise OSError("disk full")

    monkeypatch.setattr(OpenEXR, "File", Failing)
    with pytest.raises(OSError, match="disk full"):
        write_exr(path, {"RGB": pixels(4, 4)})
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("channels", "options", "field"),
    [
        ({}, {}, "channels"),
        ({"Y": pixels()}, {}, "channels['Y']"),
        ({"RGB": pixels()[..., 0]}, {}, "channels['RGB']"),
        ({"Y": np.zeros((0, 4))}, {}, "channels['Y']"),
        ({"Y": np.zeros((2, 2), complex)}, {}, "channels['Y']"),
        ({"Y": np.zeros((2, 2)), "Z": np.zeros((2, 3))}, {}, "channels"),
        ({"Y": np.zeros((2, 2))}, {"metadata": {"a": [1, 2]}}, "metadata['a']"),
        ({"Y": np.zeros((2, 2))}, {"metadata": {"a": 2**40}}, "metadata['a']"),
        ({"Y": np.zeros((2, 2))}, {"metadata": {"dataWindow": 1}}, "metadata['dataWindow']"),
        ({"Y": np.zeros((2, 2))}, {"compression": "jpeg"}, "compression"),
    ],
)
def test_bad_arguments_of_write(tmp_path: Path, channels, options, field: str) -> None:
    with pytest.raises(InputError) as caught:
        write_exr(tmp_path / "a.exr", channels, **options)
    assert caught.value.field == field and list(tmp_path.iterdir()) == []


def test_write_into_a_missing_directory(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such directory"):
        write_exr(tmp_path / "none" / "a.exr", {"Y": np.zeros((2, 2))})


def patched(data: bytes, attribute: bytes, offset: int, new: bytes) -> bytes:
    """The file with bytes of a header attribute's value replaced."""
    start = data.index(attribute + b"\0") + len(attribute) + 1
    start = data.index(b"\0", start) + 1 + 4 + offset
    return data[:start] + new + data[start + len(new) :]


DAMAGE = {
    "empty": (lambda d: b"", "empty file"),
    "text": (lambda d: b"P6 16 8 255 not an exr file", "magic"),
    "three bytes": (lambda d: d[:3], "magic"),
    "seven bytes": (lambda d: d[:7], "magic"),
    "version 1": (lambda d: d[:4] + b"\x01" + d[5:], "version"),
    "deep": (lambda d: d[:5] + b"\x08" + d[6:], "deep"),
    "multi-part": (lambda d: d[:5] + b"\x10" + d[6:], "multi-part"),
    "half a header": (lambda d: d[:150], "truncated|cut off|damaged header"),
    "no chunk table": (lambda d: d[: d.index(b"scanlineimage") + 14], "truncated"),
    "half the pixels": (lambda d: d[: len(d) * 2 // 3], "truncated"),
    "one byte short": (lambda d: d[:-1], "truncated"),
    "zero width": (lambda d: patched(d, b"dataWindow", 8, struct.pack("<i", -1)), "zero size"),
    "zero height": (lambda d: patched(d, b"dataWindow", 12, struct.pack("<i", -1)), "zero size"),
    "absurd size": (lambda d: patched(d, b"dataWindow", 8, struct.pack("<2i", 2**30, 2**30)), "more than"),
    "too tall": (lambda d: patched(d, b"dataWindow", 12, struct.pack("<i", 10**6)), "truncated"),
    "too wide": (lambda d: patched(d, b"dataWindow", 8, struct.pack("<i", 10**5)), "damaged"),
    "subsampled": (lambda d: patched(d, b"channels", 10, struct.pack("<2i", 2, 2)), "subsampled"),
    "no channels": (lambda d: patched(d, b"channels", 0, b"\0"), "without channels"),
    "no window": (lambda d: d.replace(b"dataWindow", b"dataWindov"), "dataWindow"),
    "aborted writer": (
        lambda d: d.replace(struct.pack("<Q", d.index(b"scanlineimage") + 14 + 8), bytes(8)),
        "incomplete",
    ),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_damage_is_one_error_that_names_file_and_fault(tmp_path: Path, name: str, capfd: pytest.CaptureFixture) -> None:
    change, words = DAMAGE[name]
    path = tmp_path / "sky.exr"
    data = raw(path)
    path.write_bytes(change(data))
    assert path.read_bytes() != data
    for read in (read_exr, EnvironmentLight.from_file):
        with pytest.raises(InputError, match=words) as caught:
            read(path)
        assert "sky.exr" in str(caught.value)
    if name != "too wide":  # only a chunk that does not decode reaches OpenEXR, which prints
        assert capfd.readouterr() == ("", "")


def test_missing_file_and_directory(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.exr.*no such file"):
        read_exr(tmp_path / "none.exr")
    with pytest.raises(InputError, match="directory"):
        EnvironmentLight.from_file(tmp_path)


def test_channels_of_an_environment(tmp_path: Path) -> None:
    array = pixels()
    path = tmp_path / "sky.exr"
    write_exr(path, {"RGB": array, "A": array[..., 0], "depth": array[..., 1]})
    assert torch.equal(EnvironmentLight.from_file(path).image, torch.from_numpy(array))
    write_exr(path, {"Y": array[..., 0], "A": array[..., 1]})
    assert torch.equal(EnvironmentLight.from_file(path).image, torch.from_numpy(array[..., :1]))
    write_exr(path, {"R": array[..., 0], "G": array[..., 1]})
    with pytest.raises(InputError, match=r"sky\.exr.*channels R, G, B"):
        EnvironmentLight.from_file(path)
    with pytest.raises(InputError, match=r"sky\.exr.*without \['Z'\]"):
        read_exr(path, ["Z"])


@pytest.mark.parametrize(
    ("value", "words"),
    [(np.nan, "1 NaN values, the first in row 3, column 5, channel 1"), (np.inf, "infinite"), (-1e-3, "negative")],
)
def test_pixels_that_are_no_radiance(tmp_path: Path, value: float, words: str) -> None:
    array = pixels()
    array[3, 5, 1] = value
    path = write_exr(tmp_path / "sky.exr", {"RGB": array})
    with pytest.raises(InputError, match=words) as caught:
        EnvironmentLight.from_file(path)
    assert "sky.exr" in str(caught.value)


def test_a_black_environment_is_refused(tmp_path: Path) -> None:
    path = write_exr(tmp_path / "sky.exr", {"RGB": np.zeros((4, 8, 3))})
    with pytest.raises(InputError, match=r"sky\.exr.*black"):
        EnvironmentLight.from_file(path)


FUZZ = """
import os, resource, sys
from pathlib import Path
import numpy as np
import OpenEXR
from hypothesis import HealthCheck, given, settings, strategies as st
from dsfit.errors import InputError
from dsfit.scene import EnvironmentLight, read_exr

folder = Path(sys.argv[1])
sources = []
for name in ("NO", "RLE", "ZIP", "PIZ", "PXR24", "B44", "DWAA"):
    header = {"compression": getattr(OpenEXR, name + "_COMPRESSION"), "type": OpenEXR.scanlineimage, "comment": "fuzz"}
    OpenEXR.File(header, {"RGB": np.random.default_rng(0).random((9, 14, 3)).astype("f")}).write(str(folder / "s.exr"))
    sources.append((folder / "s.exr").read_bytes())
tile = OpenEXR.TileDescription()
tile.xSize, tile.ySize = 4, 4
header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.tiledimage, "tiles": tile}
OpenEXR.File(header, {"RGB": np.ones((9, 14, 3), "f")}).write(str(folder / "s.exr"))
sources.append((folder / "s.exr").read_bytes())

used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + (3 << 30),) * 2)  # a header that makes us allocate everything must not
resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
count = {"error": 0, "read": 0}

@settings(max_examples=400, deadline=None, database=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(
    st.sampled_from(sources),
    st.lists(st.tuples(st.floats(0, 1), st.sampled_from([0, 1, 127, 128, 255]) | st.integers(0, 255)), max_size=6),
    st.booleans(),
    st.one_of(st.just(1.0), st.floats(0, 1)),
)
def fuzz(source, edits, in_header, keep):
    data = bytearray(source)
    for where, value in edits:
        data[int(where * (min(450, len(data)) - 1 if in_header else len(data) - 1))] = value
    data = data[: int(keep * len(data))]
    path = folder / "fuzz.exr"
    path.write_bytes(data)
    for read in (read_exr, EnvironmentLight.from_file):
        try:
            found = read(path)
        except InputError as error:
            assert "fuzz.exr" in str(error)
            count["error"] += 1
        else:
            image = found.pixels if read is read_exr else found.image
            assert image.dim() == 3 and image.numel() > 0
            count["read"] += 1

fuzz()
sys.stderr.write(f"counts {count['error']} {count['read']}\\n")
"""


def test_fuzzed_bytes_never_do_worse_than_an_input_error(tmp_path: Path) -> None:
    """In a process of its own: a crash of the decoder is a failed test, not a dead test run; memory is limited."""
    done = subprocess.run(
        [sys.executable, "-c", FUZZ, str(tmp_path)],
        cwd=Path(__file__).parents[2],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    errors, read = map(int, done.stderr.rsplit("counts ", 1)[1].split())
    assert errors > 100 and read > 20  # both sides were exercised
