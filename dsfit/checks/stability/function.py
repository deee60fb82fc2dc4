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
        gradient_scale: the same for derivatives, in every argument, on top of the rule below.
        density: negative values are faults.
        limits: largest relative error that is accepted, by dtype name: of the value, and of the gradient.
        loose: limits of single regimes, or of classes of them, where the mathematics gives away more; say why.

    How an error is measured. Value: `|got - exact| / max(|exact|, scale)`, with scale at least 1 for logarithms, so
    that the rounding of a large logarithm is not held against the code. Derivative in x_k: relative to
    `max(|d_k|, 1e-3 max_j |d_j| u_j / u_k)`, `u = max(|x|, 1e-3)`: one that is a thousand times smaller than another,
    per relative change of the argument, counts as zero. Exact values outside the dtype's normal range may be rounded to
    0 or inf. A twin returns `mpmath.nan` (or an infinity) for points that rounding has put outside the function's
    domain; these are left out. NaN, an infinity in place of a number, or a negative density count as an infinite error.
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
    gradient_scale: Callable[..., float] | None = None
    density: bool = False
    limits: Mapping[str, tuple[float, float]] = field(
        default_factory=lambda: {"float64": (1e-11, 1e-8), "float32": (1e-4, 1e-3)}
    )
    loose: Mapping[str, Mapping[str, tuple[float, float]]] = field(default_factory=dict)

    def limit(self, regime: str, dtype: str) -> tuple[float, float]:
        """Limits of value and gradient in that regime."""
        kind = class_of(regime)
        return self.loose.get(regime, self.loose.get(kind, self.limits)).get(dtype, self.limits[dtype])


def class_of(regime: str) -> str:
    """The class of a regime, `CLASSES`.

    Raises:
        KeyError: none of them.
    """
    kind = regime.partition(":")[0]
    if kind not in CLASSES:
        raise KeyError(f"{regime!r} is of no class; classes are {', '.join(CLASSES)}")
    return kind
