"""Hair in pbrt scene files (versions 3 and 4): `Shape "curve"`, evaluated to polylines."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dsfit.errors import InputError
from dsfit.render.geometry.affine import COUNTS, changed
from dsfit.render.geometry.build import MOST_POINTS, check_count
from dsfit.render.geometry.pbrt_text import Source
from dsfit.render.geometry.reading import strands_of_file
from dsfit.render.geometry.splines import BASES, DEGREES, evaluated, spans
from dsfit.render.geometry.transform import turned_up
from dsfit.render.strands import Strands

_BEGIN, _END = ("AttributeBegin", "TransformBegin"), ("AttributeEnd", "TransformEnd")
_PASSED_OVER = (
    "Accelerator", "AreaLightSource", "Attribute", "Camera", "ColorSpace", "CoordinateSystem", "Film", "Integrator",
    "LightSource", "MakeNamedMaterial", "MakeNamedMedium", "Material", "MediumInterface", "NamedMaterial", "Option",
    "PixelFilter", "ReverseOrientation", "Sampler", "SurfaceIntegrator", "Texture", "VolumeIntegrator", "WorldEnd",
)  # fmt: skip
"""Directives that do not place curves."""
_JOIN = 1e-6
"""Curves follow each other if the gap between them is at most this share of the larger one."""


@dataclass(frozen=True)
class _Curve:
    """Control points `[n, 3]` in the world, widths there at both ends, and where in the file it stands."""

    control: np.ndarray
    basis: str
    degree: int
    width: tuple[float, float]
    position: int


def read_pbrt_curves(path: str | Path, *, pieces: int = 8, up: str = "y") -> Strands:
    """The strands of all `Shape "curve"` of a pbrt file in text form, float64, in world coordinates.

    Bezier curves and uniform B-splines of degree 2 and 3, of type flat, ribbon or cylinder, which are all read as round
    fibres; widths are diameters, linear along the curve, and scaled by the cube root of the transformation's
    determinant. Consecutive curves of which the second starts where the first ends are one strand (within 1e-6 of
    their size). Read are AttributeBegin/End, TransformBegin/End, Translate, Scale, Rotate, LookAt, Transform,
    ConcatTransform, Identity and WorldBegin; other shapes, materials, lights and the camera are passed over.

    Args:
        path: of the file.
        pieces: straight pieces that each span of a curve becomes, 1 to 256.
        up: the axis that points up in the file; strands are rotated to y up.

    Raises:
        InputError: naming file, line and what is allowed: no such file; text that is not pbrt's; curves with the wrong
            number of control points; widths < 0, or 0 everywhere; numbers that are not finite; a transformation that
            is a projection or flattens space; Include, Import, instances and animation, which are not followed; no
            curve at all; more than 20 million points.
    """
    pieces = check_count("read_pbrt_curves.pieces", pieces, 1, 256)
    source = Source(path)
    curves = _curves(source)
    if not curves:
        raise InputError(str(path), "no curves", 'at least one Shape "curve"')
    total = sum(spans(len(curve.control), curve.basis, curve.degree) * pieces + 1 for curve in curves)
    if total > MOST_POINTS:
        raise InputError(f"{path}: points", total, f"at most {MOST_POINTS}; take fewer pieces per span")
    points, width = _evaluated(curves, pieces)
    points, width, first = _joined(points, width)
    return turned_up(strands_of_file(path, points, first, width), up)


def _curves(source: Source) -> list[_Curve]:
    """All curves of the file, in its order."""
    curves: list[_Curve] = []
    current, saved = np.eye(4), []
    for position, name, arguments in source.directives():
        if name in COUNTS:
            current = _transformed(source, position, current, name, arguments)
        elif name == "WorldBegin":
            current = np.eye(4)
        elif name in _BEGIN:
            saved.append((name, current))
        elif name in _END:
            begin = name.replace("End", "Begin")
            if not saved or saved[-1][0] != begin:
                raise source.error(position, "directive", name, f"{name} only after {begin}")
            current = saved.pop()[1]
        elif name == "Shape":
            if not arguments or not isinstance(arguments[0], str):
                raise source.error(position, "Shape", arguments[:1], 'the kind of shape, such as "curve"')
            if arguments[0] == "curve":
                curves.append(_curve(source, position, current, arguments[1:]))
        elif name not in _PASSED_OVER:
            allowed = "Shape, Attribute, Transform and other directives of a scene; Include, Import, instances and "
            raise source.error(position, "directive", name, allowed + "animation are not followed")
    if saved:
        raise source.error(len(source.text), "end of the file", saved[-1][0], f"an end for every {saved[-1][0]}")
    return curves


def _transformed(source: Source, position: int, current: np.ndarray, name: str, arguments: list[Any]) -> np.ndarray:
    numbers = arguments[0] if len(arguments) == 1 and isinstance(arguments[0], list) else arguments
    if len(numbers) != COUNTS[name] or not all(isinstance(x, float) for x in numbers):
        raise source.error(position, name, arguments, f"{COUNTS[name]} numbers")
    with np.errstate(all="ignore"):
        result = changed(current, name, numbers)
        if result is None or not (np.abs(result) < 1e60).all() or not abs(np.linalg.det(result[:3, :3])) > 0:
            raise source.error(position, name, arguments, "numbers that move, turn or scale, not project or flatten")
    return result


def _curve(source: Source, position: int, current: np.ndarray, arguments: list[Any]) -> _Curve:
    given = source.parameters(position, arguments)

    def one(name: str, kind: type, default: Any) -> Any:
        values = given.get(name, ("", [default]))[1]
        if len(values) != 1 or not isinstance(values[0], kind):
            raise source.error(position, f"curve {name}", values, "one number" if kind is float else "one word")
        return values[0]

    def choice(name: str, kind: type, allowed: tuple[Any, ...]) -> Any:
        value = one(name, kind, allowed[0])
        if value not in allowed:
            raise source.error(position, f"curve {name}", value, "one of " + ", ".join(map(repr, allowed)))
        return value

    choice("type", str, ("flat", "ribbon", "cylinder"))
    basis, degree = choice("basis", str, BASES), int(choice("degree", float, DEGREES))
    width = one("width", float, 1.0)
    ends = one("width0", float, width), one("width1", float, width)
    if not (0.0 <= min(ends) and max(ends) > 0.0):
        raise source.error(position, "curve width", list(ends), "numbers >= 0, not both 0")
    values = given.get("P", ("", []))[1]
    if not values or len(values) % 3 or not all(isinstance(x, float) for x in values):
        raise source.error(position, "curve P", f"{len(values)} values", "three numbers for each control point")
    control = np.array(values).reshape(-1, 3)
    if not spans(len(control), basis, degree):
        rule = f"{degree + 1} or more" if basis == "bspline" else f"{degree} k + 1, k = 1, 2, ..."
        raise source.error(position, "curve P", f"{len(control)} points", f"{rule} ({basis} of degree {degree})")
    with np.errstate(all="ignore"):
        world = control @ current[:3, :3].T + current[:3, 3]
        scale = float(np.cbrt(abs(np.linalg.det(current[:3, :3]))))
        if not (np.abs(world) < 1e30).all() or not max(ends) * scale < 1e30:
            raise source.error(position, "curve", "too large", "coordinates and widths below 1e30 in the world")
    return _Curve(world, basis, degree, (ends[0] * scale, ends[1] * scale), position)


def _evaluated(curves: list[_Curve], pieces: int) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Points and widths of every curve; curves of the same kind and size together."""
    alike: dict[tuple[str, int, int], list[int]] = {}
    for index, curve in enumerate(curves):
        alike.setdefault((curve.basis, curve.degree, len(curve.control)), []).append(index)
    points: list[np.ndarray] = [np.empty(0)] * len(curves)
    width: list[np.ndarray] = [np.empty(0)] * len(curves)
    for (basis, degree, _), members in alike.items():
        found = evaluated(np.stack([curves[k].control for k in members]), basis, degree, pieces)
        s = np.linspace(0.0, 1.0, found.shape[1])
        for k, place in zip(members, found, strict=True):
            points[k] = place
            width[k] = curves[k].width[0] * (1.0 - s) + curves[k].width[1] * s
    return points, width


def _joined(points: list[np.ndarray], width: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One array of points and one of widths, and the first point of every strand `[S + 1]`."""
    start, end = np.stack([p[0] for p in points]), np.stack([p[-1] for p in points])
    size = np.array([np.ptp(p, axis=0).max() for p in points])
    gap = np.abs(start[1:] - end[:-1]).max(-1)
    follows = np.concatenate([[False], gap <= _JOIN * np.maximum(size[1:], size[:-1])])
    kept = np.array([len(p) for p in points]) - follows
    place = np.concatenate([p[int(f) :] for p, f in zip(points, follows, strict=True)])
    thick = np.concatenate([w[int(f) :] for w, f in zip(width, follows, strict=True)])
    ends = np.concatenate([[0], kept.cumsum()])
    return place, thick, np.append(ends[:-1][~follows], ends[-1])
