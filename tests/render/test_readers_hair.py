""".hair files: round trip, the format byte by byte, and damage of every kind."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dsfit.errors import InputError
from dsfit.render import Strands
from dsfit.render.geometry import curly_wisp, read_hair, write_hair

FUZZ = settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def two_strands() -> Strands:
    points = torch.tensor([[0, 0, 0], [0, 1, 0], [0, 2, 0.5], [1, 0, 0], [1, 3, 0]], dtype=torch.float64)
    radius = torch.tensor([0.5, 0.25, 0.125, 1.0, 2.0], dtype=torch.float64)
    return Strands(points, torch.tensor([0, 3, 5]), radius)


def raw(
    strands: int = 2,
    points: int = 5,
    arrays: int = 0b00111,
    segments: int = 0,
    thickness: float = 1.0,
    *,
    magic: bytes = b"HAIR",
    listed: tuple[int, ...] = (2, 1),
    place: Any = None,
    width: Any = (1.0, 0.5, 0.25, 2.0, 4.0),
    tail: bytes = b"",
) -> bytes:
    """A file written here by hand, from the description of the format."""
    header = struct.pack("<4sIIIIff3f", magic, strands, points, arrays, segments, thickness, 0.3, 1, 1, 1).ljust(128)
    place = two_strands().points.numpy() if place is None else place
    data = struct.pack(f"<{len(listed)}H", *listed) if arrays & 1 else b""
    data += np.asarray(place, dtype="<f4").tobytes()
    data += np.asarray(width, dtype="<f4").tobytes() if arrays & 4 else b""
    data += np.zeros(points if arrays & 8 else 0, dtype="<f4").tobytes()
    data += np.ones(3 * points if arrays & 16 else 0, dtype="<f4").tobytes()
    return header + data + tail


def read(path: Path, content: bytes, **options: Any) -> Strands:
    path.write_bytes(content)
    return read_hair(path, **options)


def same(a: Strands, b: Strands) -> bool:
    return torch.equal(a.points, b.points) and torch.equal(a.first, b.first) and torch.equal(a.radius, b.radius)


@pytest.mark.parametrize("extra", [0, 8, 16, 24])
def test_reads_the_format(tmp_path: Path, extra: int) -> None:
    """Thickness is a diameter; arrays that are not used are stepped over."""
    hair = read(tmp_path / "a.hair", raw(arrays=0b00111 | extra))
    assert same(hair, two_strands())
    assert hair.points.dtype == hair.radius.dtype == torch.float64


def test_defaults_stand_for_arrays_left_out(tmp_path: Path) -> None:
    place = np.arange(18).reshape(6, 3)
    hair = read(tmp_path / "a.hair", raw(3, 6, 0b00010, 1, 0.5, place=place))
    assert hair.first.tolist() == [0, 2, 4, 6]
    assert torch.equal(hair.radius, torch.full((6,), 0.25, dtype=torch.float64))
    assert torch.equal(hair.points, torch.arange(18, dtype=torch.float64).reshape(6, 3))


@pytest.mark.parametrize(
    ("up", "axis"), [("x", (1, 0, 0)), ("y", (0, 1, 0)), ("z", (0, 0, 1)), ("-x", (-1, 0, 0)), ("-y", (0, -1, 0)),
                     ("-z", (0, 0, -1))],
)  # fmt: skip
def test_up_axis_becomes_y_by_a_rotation(tmp_path: Path, up: str, axis: tuple[int, ...]) -> None:
    place = np.array([[0, 0, 0], axis, [1, 2, 3], [0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    hair = read(tmp_path / "a.hair", raw(1, 7, 0b00010, 6, place=place), up=up)
    assert hair.points[1].tolist() == [0, 1, 0]
    turned = hair.points[4:]  # images of the axes, as rows
    assert torch.equal(turned @ turned.T, torch.eye(3, dtype=torch.float64))
    assert float(torch.linalg.det(turned)) == pytest.approx(1.0)  # right-handed worlds stay right-handed


def test_round_trip_is_exact_to_float32(tmp_path: Path) -> None:
    for hair in (two_strands(), curly_wisp(strands=50, points=30)):
        write_hair(hair, tmp_path / "a.hair", info="a test")
        back = read_hair(tmp_path / "a.hair")
        assert torch.equal(back.points, hair.points.float().double())
        assert torch.equal(back.first, hair.first)
        assert torch.equal(back.radius, (2 * hair.radius).float().double() / 2)
        assert (tmp_path / "a.hair").read_bytes()[40:46] == b"a test"
    assert [p.name for p in tmp_path.iterdir()] == ["a.hair"]


def test_what_all_share_is_written_once(tmp_path: Path) -> None:
    hair = Strands(torch.randn(6, 3), torch.tensor([0, 3, 6]), torch.full((6,), 0.5))
    write_hair(hair, tmp_path / "a.hair")
    assert (tmp_path / "a.hair").stat().st_size == 128 + 6 * 12
    assert same(read_hair(tmp_path / "a.hair"), Strands(hair.points.double(), hair.first, hair.radius.double()))


def test_points_of_thickness_zero_get_one_percent(tmp_path: Path) -> None:
    hair = read(tmp_path / "a.hair", raw(width=(1.0, 0.5, 0.0, 2.0, 0.0)))
    assert hair.radius.tolist() == [0.5, 0.25, 0.005, 1.0, 0.01]


def at(point: int, value: float) -> np.ndarray:
    place = two_strands().points.numpy().copy()
    place[point, 1] = value
    return place


@pytest.mark.parametrize(
    ("content", "names"),
    [
        (b"", "header.*128 bytes"),
        (raw()[:127], "header.*128 bytes"),
        (raw(magic=b"HARE"), "bytes 0 to 3.*HAIR"),
        (raw(arrays=0b00101, place=()), "bit array.*points"),
        (raw(arrays=0b100111), "bit array"),
        (raw(strands=0), "number of strands.*at least 1"),
        (raw()[:-1], "length of the file: got '211 bytes'.*212 bytes"),
        (raw(tail=b"x"), "length of the file"),
        (raw(points=2**32 - 1)[:400], "number of points: got 4294967295; allowed: at most 200000000"),
        (raw(points=200_000_000)[:400], "length of the file"),
        (raw(strands=2**32 - 1)[:400], "length of the file"),
        (raw(arrays=0b00110, segments=2**32 - 1), "default number of segments"),
        (raw(strands=2**31, arrays=0b00110, segments=2), "number of points.*6442450944"),
        (raw(arrays=0b00110, segments=0), "default number of segments"),
        (raw(listed=(2, 2)), "number of points: got 5; allowed: 6"),
        (raw(listed=(3, 0)), "points of strand 1: got 1; allowed: two or more"),
        (raw(place=at(3, np.nan)), "point 0 of strand 1"),
        (raw(place=at(2, np.inf)), "point 2 of strand 0"),
        (raw(place=at(2, -2e30)), "point 2 of strand 0"),
        (raw(width=(1, 1, 1, 1, -1)), "thickness of point 1 of strand 1: got -1.0"),
        (raw(width=(1, np.nan, 1, 1, 1)), "thickness of point 1 of strand 0: got nan"),
        (raw(width=(1, np.inf, 1, 1, 1)), "thickness of point 1 of strand 0: got inf"),
        (raw(width=(1, 1, 1, 0, 0)), "thickness of strand 1"),
        (raw(place=np.ones((5, 3))), "length of strand 0"),
        (raw(arrays=0b00011, thickness=0.0), "default thickness: got 0.0"),
        (raw(arrays=0b00011, thickness=-1.0), "default thickness: got -1.0"),
        (raw(arrays=0b00011, thickness=np.nan), "default thickness: got nan"),
        (raw(arrays=0b00011, thickness=np.inf), "default thickness: got inf"),
    ],
)
def test_damage_is_named(tmp_path: Path, content: bytes, names: str) -> None:
    with pytest.raises(InputError, match=names) as caught:
        read(tmp_path / "bad.hair", content)
    assert "bad.hair" in caught.value.field


def test_lies_about_size_allocate_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """2^32 - 1 points would be 51 GB: no array is made, and no more than the header is read."""
    for name in ("full", "frombuffer", "repeat", "concatenate"):
        monkeypatch.setattr(np, name, lambda *a, **k: pytest.fail("an array was made"))
    content = raw(points=5, arrays=0b00110, segments=4)
    for lie in ({"strands": 2**32 - 1}, {"points": 2**32 - 1}, {"strands": 2**32 - 1, "points": 2**32 - 1}):
        fields = {"strands": 1, "points": 5, **lie}
        with pytest.raises(InputError, match="number of points|length of the file"):
            read(tmp_path / "a.hair", content[:4] + struct.pack("<II", *fields.values()) + content[12:])


def test_no_file_a_folder_and_bad_axes(tmp_path: Path) -> None:
    for path in (tmp_path / "none.hair", tmp_path, "a\0b", tmp_path / "none" / "x"):
        with pytest.raises(InputError, match="a .hair file"):
            read_hair(path)
    for up in ("w", "", "yy", 1, None):
        with pytest.raises(InputError, match="up"):
            read(tmp_path / "a.hair", raw(), up=up)


def test_what_cannot_be_written(tmp_path: Path) -> None:
    line = torch.tensor([[0, 0, 0], [0, 1, 0]], dtype=torch.float64)
    first, radius = torch.tensor([0, 2]), torch.ones(2, dtype=torch.float64)
    long = Strands(torch.randn(70_000, 3), torch.tensor([0, 70_000]), torch.ones(70_000))
    for hair, words in (
        (long, "65535 segments"),
        (Strands(1e39 * line, first, radius), "float32"),
        (Strands(line, first, 1e-60 * radius), "float32"),
        (Strands(line, first, 1e60 * radius), "float32"),
    ):
        with pytest.raises(InputError, match=words):
            write_hair(hair, tmp_path / "a.hair")
    with pytest.raises(InputError, match="info"):
        write_hair(two_strands(), tmp_path / "a.hair", info="x" * 89)
    assert not list(tmp_path.iterdir())


@FUZZ
@given(st.data())
def test_fuzz_only_input_errors(tmp_path: Path, data: st.DataObject) -> None:
    """Bytes changed, bits flipped, cut off or added anywhere: strands or an `InputError`, nothing else."""
    content = bytearray(raw(arrays=data.draw(st.sampled_from([0b00111, 0b00011, 0b11111]))))
    for _ in range(data.draw(st.integers(0, 3))):
        place = data.draw(st.one_of(st.integers(0, 40), st.integers(0, len(content) - 1)))
        content[place] = data.draw(st.integers(0, 255))
    if data.draw(st.booleans()):
        content = content[: data.draw(st.integers(0, len(content)))]
    content += data.draw(st.binary(max_size=3))
    try:
        hair = read(tmp_path / "a.hair", bytes(content))
    except InputError as error:
        assert "a.hair" in error.field
    else:
        assert bool(torch.isfinite(hair.points).all()) and bool((hair.radius > 0).all())


@FUZZ
@given(st.binary(max_size=400))
def test_fuzz_any_bytes(tmp_path: Path, content: bytes) -> None:
    with pytest.raises(InputError):
        read(tmp_path / "a.hair", content)
