"""Which terms of the dual scattering integrand are computed."""

from __future__ import annotations

from dataclasses import dataclass

from dsfit.errors import InputError

TERMS = ("R", "TT", "TRT", "back")


@dataclass(frozen=True)
class Terms:
    """The terms of F (eqs 4-9) that a scene needs; what is not named is left out of the computation.

    Args:
        direct: of F_direct, among "R", "TT", "TRT", "back".
        scattered: of F_scatter, likewise.
        glint: whether TRT's caustic is treated (the removal and the two Gaussians). Only where TRT is needed.
        grey: whether all channels are equal, so that one is computed and stands for all.

    Raises:
        InputError: a term that does not exist.
    """

    direct: tuple[str, ...] = TERMS
    scattered: tuple[str, ...] = TERMS
    glint: bool = True
    grey: bool = False

    def __post_init__(self) -> None:
        for field in ("direct", "scattered"):
            for name in getattr(self, field):
                if name not in TERMS:
                    raise InputError(f"terms.{field}", name, "some of " + ", ".join(TERMS))
