"""pbrt's transformations as 4x4 matrices that act on column vectors."""

from __future__ import annotations

import math

import numpy as np

COUNTS = {"Identity": 0, "Translate": 3, "Scale": 3, "Rotate": 4, "LookAt": 9, "Transform": 16, "ConcatTransform": 16}
"""Directives that change the transformation, and how many numbers each takes."""


def changed(current: np.ndarray, directive: str, numbers: list[float]) -> np.ndarray | None:
    """The transformation after a directive; None where it cannot be: an axis or a view of length 0, a projection."""
    if directive == "Identity":
        return np.eye(4)
    if directive in ("Transform", "ConcatTransform"):
        matrix = np.array(numbers).reshape(4, 4).T  # the file lists columns
        if not np.array_equal(matrix[3], (0.0, 0.0, 0.0, 1.0)):
            return None
        return matrix if directive == "Transform" else current @ matrix
    step = {"Translate": _translate, "Scale": _scale, "Rotate": _rotate, "LookAt": _look_at}[directive](numbers)
    return None if step is None else current @ step


def _translate(numbers: list[float]) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, 3] = numbers
    return matrix


def _scale(numbers: list[float]) -> np.ndarray:
    return np.diag([*numbers, 1.0])


def _rotate(numbers: list[float]) -> np.ndarray | None:
    """By an angle in degrees about an axis (Rodrigues)."""
    axis = _unit(np.array(numbers[1:]))
    if axis is None:
        return None
    angle = math.radians(numbers[0])
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    matrix = np.eye(4)
    matrix[:3, :3] += math.sin(angle) * cross + (1.0 - math.cos(angle)) * cross @ cross
    return matrix


def _look_at(numbers: list[float]) -> np.ndarray | None:
    """World to camera: the camera looks along +z, x to the right, in a left-handed frame as pbrt's."""
    eye, target, up = np.array(numbers).reshape(3, 3)
    forward, up_unit = _unit(target - eye), _unit(up)
    if forward is None or up_unit is None:
        return None
    right = _unit(np.cross(up_unit, forward))
    if right is None:
        return None
    camera = np.eye(4)
    camera[:3, :4] = np.stack([right, np.cross(forward, right), forward, eye], axis=1)
    return np.linalg.inv(camera)


def _unit(vector: np.ndarray) -> np.ndarray | None:
    size = np.abs(vector).max()
    if not 0.0 < size < 1e150:
        return None
    vector = vector / size  # tiny vectors too have a direction
    length = np.linalg.norm(vector)
    return vector / length if length > 1e-12 else None
