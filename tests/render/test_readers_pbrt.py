"""pbrt curves: against scipy's splines, pbrt's rules of transformations, and damage of every kind."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.interpolate import BPoly, BSpline

from dsfit.errors import InputError
from dsfit.render import Strands
from dsfit.render.geometry import pbrt_file, pbrt_text, read_pbrt_curves

LINE = "0 0 0  0 1 0  0 2 0  0 3 0"
SCENE = f"""# a scene as exporters write it
LookAt 0 0 5  0 0 0  0 1 0
Camera "perspective" "float fov" [ 40 ]
Film "image" "integer xresolution" [ 400 ] "string filename" "out.exr"
WorldBegin
AttributeBegin
  Translate 1 0 0   # moved
  NamedMaterial "hair"
  Shape "curve" "string type" [ "cylinder" ] "point P" [ {LINE} ]
    "float width0" [ 0.2 ] "float width1" [ 0.1 ]
AttributeEnd
TransformBegin
  Scale 2 2 2
  Shape "curve" "point3 P" [ 0 0 0  1 0 0  2 1 0  3 0 0 ] "float width" 0.5 "bool flag" true
TransformEnd
Shape "sphere" "float radius" 2
WorldEnd
"""


def read(path: Path, text: str | bytes, **options: Any) -> Strands:
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_pbrt_curves(path, **options)


def curve(points: Any = LINE, more: str = "") -> str:
    if not isinstance(points, str):
        points = " ".join(repr(float(x)) for x in np.asarray(points).flatten())
    return f'Shape "curve" "point P" [ {points} ] {more}\n'


def test_a_scene(tmp_path: Path) -> None:
    hair = read(tmp_path / "a.pbrt", SCENE, pieces=3)
    assert hair.first.tolist() == [0, 4, 8] and hair.points.dtype == torch.float64
    expected = torch.tensor([[1, 0, 0], [1, 1, 0], [1, 2, 0], [1, 3, 0]], dtype=torch.float64)
    assert torch.allclose(hair.points[:4], expected, atol=1e-14)
    assert torch.allclose(2 * hair.radius[:4], torch.tensor([0.2, 1 / 6, 0.4 / 3, 0.1], dtype=torch.float64))
    assert hair.points[[4, 7]].tolist() == [[0, 0, 0], [6, 0, 0]]
    assert torch.allclose(hair.radius[4:], torch.full((4,), 0.5, dtype=torch.float64))  # widths are scaled too


@pytest.mark.parametrize("degree", [2, 3])
@pytest.mark.parametrize("count", [1, 2, 5])
def test_splines_against_scipy(tmp_path: Path, degree: int, count: int) -> None:
    """Points at equal steps of the parameter, of uniform B-splines and of Bezier spans, as scipy evaluates them."""
    generator = np.random.default_rng(degree * 10 + count)
    pieces = 5
    t = np.linspace(0, count, count * pieces + 1)
    kind = f'"integer degree" {degree} "string basis" '
    control = generator.normal(size=(count + degree, 3))
    found = read(tmp_path / "a.pbrt", curve(control, kind + '"bspline"'), pieces=pieces)
    knots = np.arange(-degree, count + degree + 1)
    expected = BSpline(knots, control, degree)(t)
    np.testing.assert_allclose(found.points.numpy(), expected, atol=1e-13)
    control = generator.normal(size=(count * degree + 1, 3))
    found = read(tmp_path / "a.pbrt", curve(control, kind + '["bezier"]'), pieces=pieces)
    local = np.stack([control[k : k + count * degree : degree] for k in range(degree)] + [control[degree::degree]])
    expected = BPoly(local, np.arange(count + 1))(t)
    np.testing.assert_allclose(found.points.numpy(), expected, atol=1e-13)


def test_consecutive_curves_that_touch_are_one_strand(tmp_path: Path) -> None:
    width = '"float width0" 0.3 "float width1" 0.1 '
    second = curve("0 3 0  1 4 0  1 5 0  1 6 0", '"float width0" 0.1 "float width1" 0.2')
    third = curve("9 0 0  9 1 0  9 2 0  9 3 0")
    nearly = curve("9 3.000001 0  9 4 0  9 5 0  9 6 0")
    apart = curve("9 6.0001 0  9 7 0  9 8 0  9 9 0")
    hair = read(tmp_path / "a.pbrt", curve(LINE, width) + second + third + nearly + apart, pieces=4)
    assert hair.first.tolist() == [0, 9, 18, 23]
    assert bool((hair.points.diff(dim=0)[:8].norm(dim=-1) > 0.1).all())  # the shared point is there once
    assert torch.allclose(2 * hair.radius[[0, 4, 8]], torch.tensor([0.3, 0.1, 0.2], dtype=torch.float64))
    moved = read(tmp_path / "a.pbrt", curve() + "Translate 0 3 0\n" + curve(), pieces=2)
    assert moved.first.tolist() == [0, 5]  # joined in the world, not in the file's numbers


def test_windows_of_a_bspline_are_one_strand(tmp_path: Path) -> None:
    """Exporters write a strand as one curve per span, each with three control points of the one before."""
    control = np.random.default_rng(0).normal(size=(7, 3)).cumsum(0)
    basis = '"string basis" "bspline" "float width" 0.1'
    windows = "".join(curve(control[k : k + 4], basis) for k in range(4))
    one, parts = (read(tmp_path / "a.pbrt", text) for text in (curve(control, basis), windows))
    assert len(parts) == 1
    assert torch.allclose(parts.points, one.points, atol=1e-13)
    assert torch.allclose(parts.radius, one.radius)


@pytest.mark.parametrize(
    ("steps", "expected"),
    [
        ("Translate 1 2 3", (1, 5, 3)),
        ("Scale 1 2 1", (0, 6, 0)),
        ("Rotate 90 0 0 1", (-3, 0, 0)),
        ("Rotate 90 1 0 0", (0, 0, 3)),
        ("Rotate -450 5 0 0", (0, 0, -3)),
        ("Translate 1 0 0 Rotate 90 0 0 1", (-2, 0, 0)),
        ("Rotate 90 0 0 1 Translate 1 0 0", (-3, 1, 0)),
        ("Translate 9 9 9 Identity", (0, 3, 0)),
        ("Translate 9 9 9 WorldBegin", (0, 3, 0)),
        ("Translate 9 9 9 Transform [ 1 0 0 0  0 1 0 0  0 0 1 0  5 6 7 1 ]", (5, 9, 7)),
        ("Translate 1 1 1 ConcatTransform [ 0 1 0 0  -1 0 0 0  0 0 1 0  5 6 7 1 ]", (3, 7, 8)),
        ("Translate 1 1 1 AttributeBegin Scale 7 7 7 AttributeEnd", (1, 4, 1)),
        ("TransformBegin Translate 1 1 1 AttributeBegin AttributeEnd TransformEnd", (0, 3, 0)),
        ("LookAt 0 0 -5  0 0 0  0 1 0", (0, 3, 5)),
        ("LookAt 1 0 0  2 0 0  0 1 0", (0, 3, -1)),
    ],
)
def test_transformations(tmp_path: Path, steps: str, expected: tuple[int, ...]) -> None:
    hair = read(tmp_path / "a.pbrt", f"{steps}\n{curve()}")
    assert torch.allclose(hair.points[-1], torch.tensor(expected, dtype=torch.float64), atol=1e-12)
    determinant = 2.0 if "Scale 1 2 1" in steps else 1.0
    assert float(hair.radius[0]) == pytest.approx(0.5 * determinant ** (1 / 3))


def test_up_and_number_forms(tmp_path: Path) -> None:
    hair = read(tmp_path / "a.pbrt", curve("0 0 -0.  +1 .5e1 2E0  1 1 1  1.5 2 3e0"), up="z", pieces=1)
    assert hair.points.tolist() == [[0, 0, 0], [2, 3, 1.5]]


def test_a_comment_and_a_string_inside_lists(tmp_path: Path) -> None:
    text = 'Shape "curve" "point P" [ 0 0 0 # the ] root\n 0 1 0 0 2 0 0 3 0 ] "string type" [ "flat" ] # end ['
    assert len(read(tmp_path / "a.pbrt", text)) == 1


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("", "no curves"),
        ('Shape "sphere"', "no curves"),
        ("\n\n12 Shape", "line 3: text.*directive"),
        ("\nTranslat 1 0 0\n" + curve(), "line 2: directive: got 'Translat'"),
        (curve() + 'Include "more.pbrt"', "line 2: directive.*not followed"),
        (curve() + 'ObjectBegin "x"', "directive.*instances"),
        ("ActiveTransform EndTime", "directive.*animation|directive.*not followed"),
        ("Shape", "line 1: Shape"),
        ("Shape 7", "line 1: Shape"),
        ('Shape "curve', 'closed by "'),
        ('Shape "curve" "point P" [ 0 0', "to close the list"),
        ('Shape "curve" "point P" [ 0 [ 0 ] ]', "lists that hold no lists"),
        ('Shape "curve" "point P" [ "0" [ 0 ] ]', "lists that hold no lists"),
        ("Shape ]", r"only after \["),
        ('Shape "curve" "point P"', "line 1: parameter"),
        ('Shape "curve" "P" [ 0 ]', "line 1: parameter"),
        ('Shape "curve" 3 [ 0 ]', "line 1: parameter"),
        (curve() + curve(LINE, '"point P" [ 1 ]'), "line 2: parameter: got 'P'.*once"),
        ('Shape "curve"', "curve P: got '0 values'"),
        (curve("0 0 0 1"), "curve P: got '4 values'.*three numbers"),
        (curve("0 0 x 1"), "line 1: value: got 'x'.*finite number"),
        (curve("0 0 nan"), "value: got 'nan'"),
        (curve("0 0 1e999"), "value: got '1e999'"),
        (curve("0 0 1_0"), "value: got '1_0'"),
        (curve("0 0 \u0663"), "finite number"),
        (curve('0 0 "1"'), "three numbers"),
        (curve("0 0 0 1 1 1 2 2 2"), r"curve P: got '3 points'; allowed: 3 k \+ 1"),
        (curve(LINE + " 1 1 1"), r"got '5 points'; allowed: 3 k \+ 1"),
        (curve("0 0 0 1 1 1 2 2 2", '"string basis" "bspline"'), "4 or more"),
        (curve(LINE, '"integer degree" 2'), r"got '4 points'; allowed: 2 k \+ 1"),
        (curve(LINE, '"integer degree" 4'), "curve degree: got 4.0; allowed: one of 3.0, 2.0"),
        (curve(LINE, '"string basis" "hermite"'), "curve basis: got 'hermite'"),
        (curve(LINE, '"string type" "tube"'), "curve type: got 'tube'"),
        (curve(LINE, '"string type" 3'), "curve type.*one word"),
        (curve(LINE, '"float width" [ 1 2 ]'), "curve width.*one number"),
        (curve(LINE, '"float width" -1'), "curve width"),
        (curve(LINE, '"float width" 0'), "curve width.*not both 0"),
        (curve(LINE, '"float width0" 1 "float width1" -1'), "curve width"),
        (curve("1 1 1 " * 4), "length of strand 0"),
        (curve() + curve("1 1 1 " * 4), "length of strand 1"),
        ("\nAttributeEnd\n" + curve(), "line 2: directive.*only after AttributeBegin"),
        ("AttributeBegin TransformEnd " + curve(), "only after TransformBegin"),
        ("AttributeBegin " + curve(), "an end for every AttributeBegin"),
        ("Translate 1 0 " + curve(), "line 1: Translate.*3 numbers"),
        ('Translate 1 0 "x" ' + curve(), "Translate.*3 numbers"),
        ("Scale 1 0 1 " + curve(), "Scale.*flatten"),
        ("Rotate 90 0 0 0 " + curve(), "Rotate"),
        ("LookAt 0 0 0 0 0 0 0 1 0 " + curve(), "LookAt"),
        ("LookAt 0 0 0 0 1 0 0 1 0 " + curve(), "LookAt"),
        ("Transform [ " + "1 " * 15 + "] " + curve(), "Transform.*16 numbers"),
        ("Transform [ " + "1 0 0 1 0 1 0 0 0 0 1 0 0 0 0 1" + "] " + curve(), "Transform.*project"),
        ("Scale 1e90 1e90 1e90 " + curve(), "Scale"),
        ("Scale 1e28 1e28 1e28 " + curve("0 0 0 1 0 0 2 0 0 1e9 0 0"), "too large"),
        (b"\xff\xfe\x00binary", "finite number|directive"),
    ],
)
def test_damage_is_named(tmp_path: Path, text: str | bytes, names: str) -> None:
    with pytest.raises(InputError, match=names) as caught:
        read(tmp_path / "bad.pbrt", text)
    assert "bad.pbrt" in caught.value.field


def test_limits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for pieces in (0, 257, 1.0, True):
        with pytest.raises(InputError, match="pieces"):
            read(tmp_path / "a.pbrt", curve(), pieces=pieces)
    for path in (tmp_path, tmp_path / "none"):
        with pytest.raises(InputError, match="a pbrt scene file"):
            read_pbrt_curves(path)
    monkeypatch.setattr(pbrt_file, "MOST_POINTS", 20)
    assert len(read(tmp_path / "a.pbrt", curve(), pieces=19)) == 1
    with pytest.raises(InputError, match="fewer pieces"):
        read(tmp_path / "a.pbrt", curve(), pieces=20)
    monkeypatch.setattr(pbrt_text, "MOST_BYTES", 30)
    with pytest.raises(InputError, match="at most 30 bytes"):
        read(tmp_path / "a.pbrt", curve())


def test_tips_of_width_zero_get_one_percent(tmp_path: Path) -> None:
    hair = read(tmp_path / "a.pbrt", curve(LINE, '"float width0" 2 "float width1" 0'), pieces=2)
    assert hair.radius.tolist() == [1.0, 0.5, 0.01]


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(angle=st.floats(-720, 720), axis=st.tuples(*[st.floats(-5, 5)] * 3).filter(lambda a: math.hypot(*a) > 1e-3))
def test_rotations_keep_lengths_and_the_axis(tmp_path: Path, angle: float, axis: tuple[float, ...]) -> None:
    control = np.array([(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), axis])
    text = f"Rotate {angle!r} {axis[0]!r} {axis[1]!r} {axis[2]!r}\n" + curve(control, '"string basis" "bspline"')
    plain = read(tmp_path / "a.pbrt", curve(control, '"string basis" "bspline"')).points
    turned = read(tmp_path / "a.pbrt", text).points
    assert torch.allclose(turned.norm(dim=-1), plain.norm(dim=-1), atol=1e-12)
    along = torch.tensor(axis, dtype=torch.float64)
    assert torch.allclose(turned @ along, plain @ along, atol=1e-11)


# fmt: off
PARTS = ["[", "]", '"', "#", "\n", "0", "-1", "1e9", "1e999", "nan", "true", "Shape", '"curve"', '"point P"', "Scale",
         '"float width"', "AttributeBegin", "AttributeEnd", "Transform", "Rotate 3", "WorldBegin", " ", "é", "\0"]
# fmt: on


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_fuzz_only_input_errors(tmp_path: Path, data: st.DataObject) -> None:
    """Parts of a scene replaced, cut off, put in: strands or an `InputError`, nothing else."""
    text = bytearray(SCENE.encode())
    for _ in range(data.draw(st.integers(1, 4))):
        place = data.draw(st.integers(0, len(text)))
        length = data.draw(st.integers(0, 12))
        piece = data.draw(st.one_of(st.sampled_from(PARTS).map(str.encode), st.binary(max_size=4)))
        text[place : place + length] = piece
    if data.draw(st.booleans()):
        text = text[: data.draw(st.integers(0, len(text)))]
    try:
        hair = read(tmp_path / "a.pbrt", bytes(text))
    except InputError as error:
        assert "a.pbrt" in error.field
    else:
        assert bool(torch.isfinite(hair.points).all()) and bool((hair.radius > 0).all())


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.sampled_from(PARTS), max_size=30))
def test_fuzz_any_parts(tmp_path: Path, parts: list[str]) -> None:
    try:
        read(tmp_path / "a.pbrt", " ".join(parts))
    except InputError as error:
        assert "a.pbrt" in error.field
