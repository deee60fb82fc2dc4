"""What the atlas holds: a function of the library, its 50-digit twin, and the regimes it is measured in.

A regime is named "class: detail", as in "narrow: beta 0.01 deg" (or just the class, where there is one of it), with the
classes of `CLASSES`; the map of the atlas has one column for each class.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from torch import Tensor

CLASSES: dict[str, str] = {
    "ordinary": "parameters of hair, away from every edge",
    "narrow": "lobes of 0.01 degrees and less; a concentration of 1e12",
    "wide": "lobes far wider than their domain",
    "grazing": "inclinations near and at 90 degrees; poles",
    "tail": "far from where the mass is; windows many standard deviations away",
    "small": "windows and differences of nearly equal numbers",
    "ends of u": "uniform numbers next to 0 and 1",
    "clear": "no absorption, or next to none; a_f near 1",
    "dark": "strong absorption; a_f near 0",
    "deep n": "many fibres, and numbers of fibres that are not whole",
    "index": "refractive indices near 1, and of 3",
    "caustic": "next to a caustic, a focus, or the seam of the circle at phi = 0 or pi",
    "switch": "on either side of where the code changes from one formula to another",
}
"""Kinds of regimes, in the order of the map's columns."""

Point = tuple[float, ...]
"""One value for each argument."""


@dataclass(frozen=True)
class Function:
    """A row of the atlas.

    The arguments are rounded to the dtype first and handed to the twin as they are, so that an error is the code's own,
    not that of the rounding of its input.

    Attributes:
        name: how the atlas calls it, as in `bsdf.N_TT`.
        arguments: names of the scalar arguments.
        compute: the library's function of tensors `[K]`, one per argument, to `[K]`.
        exact: the twin, of mpmath numbers, one per argument, at whatever precision mpmath is set to. Shares no code
            with `compute`.
        regimes: name of a regime ("class: detail", see `CLASSES`) to its points.
        gradients: arguments in which the derivative is measured too; all if left out.
        naive: the formula as one would write it down first, shown beside the stable one; None if it is the same.
        logarithm: the value is the log of a density, whose absolute error is the relative error of the density.
        scale: a point's size below which an error counts as absolute (arguments, exact value -> size); 0 if left
            out. For functions that cross zero, where no relative error can be small.
        density: negative values are faults.
        limits: largest relative error that the tests accept by dtype name, value and gradient.
    """

    name: str
    arguments: tuple[str, ...]
    compute: Callable[..., Tensor]
    exact: Callable[..., Any]
    regimes: Mapping[str, Sequence[Point]]
    gradients: tuple[str, ...] | None = None
    naive: Callable[..., Tensor] | None = None
    logarithm: bool = False
    scale: Callable[..., float] | None = None
    density: bool = False
    limits: Mapping[str, tuple[float, float]] = field(
        default_factory=lambda: {"float64": (1e-11, 1e-8), "float32": (1e-4, 1e-3)}
    )
