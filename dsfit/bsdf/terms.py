"""Which terms of the dual scattering integrand are computed."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from dsfit.errors import InputError

TERMS = ("R", "TT", "TRT", "back")


@dataclass(frozen=True)
class Terms:
    """The terms of F (eqs 4-9) that a scene needs; what is not named is left out of the computation.

    Args:
        direct: of F_direct, among "R", "TT", "TRT", "back"; kept in that order.
        scattered: of F_scatter, likewise.
        glint: whether TRT's caustic is treated (the removal and the two Gaussians). Only where TRT is needed. Without
            it N_TRT is the raw one; a table of N^G stays the treated one it was made as.
        grey: whether all channels are equal, so that one is computed and stands for all.

    Raises:
        InputError: a term that does not exist or is named twice, a flag that is no boolean.
    """

    direct: tuple[str, ...] = TERMS
    scattered: tuple[str, ...] = TERMS
    glint: bool = True
    grey: bool = False

    def __post_init__(self) -> None:
        for field in ("direct", "scattered"):
            given = getattr(self, field)
            if isinstance(given, str) or not isinstance(given, Iterable):
                raise InputError(f"terms.{field}", given, "a tuple of some of " + ", ".join(TERMS))
            names = tuple(given)
            for name in names:
                if name not in TERMS or names.count(name) > 1:
                    raise InputError(f"terms.{field}", name, "some of " + ", ".join(TERMS) + ", each once")
            object.__setattr__(self, field, tuple(name for name in TERMS if name in names))
        for field in ("glint", "grey"):
            if not isinstance(getattr(self, field), bool):
                raise InputError(f"terms.{field}", getattr(self, field), "True or False")

    @property
    def direct_lobes(self) -> tuple[int, ...]:
        """Numbers 0, 1, 2 of R, TT, TRT in F_direct."""
        return _lobes(self.direct)

    @property
    def scattered_lobes(self) -> tuple[int, ...]:
        """Numbers 0, 1, 2 of R, TT, TRT in F_scatter."""
        return _lobes(self.scattered)


def _lobes(names: tuple[str, ...]) -> tuple[int, ...]:
    return tuple(k for k, name in enumerate(TERMS[:3]) if name in names)
