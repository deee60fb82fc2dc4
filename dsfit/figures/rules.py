"""How values of two runs of an experiment must agree: what "reproduced" means, value by value."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Exact:
    """Equal, bit by bit for arrays."""

    def __str__(self) -> str:
        return "equal"


@dataclass(frozen=True)
class Close:
    """Equal up to rounding and the order of sums: |a - b| <= atol + rtol |b|."""

    rtol: float = 1e-6
    atol: float = 0.0

    def __str__(self) -> str:
        parts = [f"{self.rtol:g} (relative)"] * bool(self.rtol) + [f"{self.atol:g}"] * bool(self.atol)
        return "within " + (" + ".join(parts) or "0")


@dataclass(frozen=True)
class Estimate:
    """Equal in distribution: z = (a - b) / sqrt(s_a^2 + s_b^2) within what chance allows over all values of the
    experiment together (Šidák, 1 %).

    Attributes:
        error: name of the value that holds the standard errors; `*` stands for what the pattern's `*` stood for.
        most: a standard error above this share of the value is no agreement but too little data.
    """

    error: str
    most: float = 0.5

    def __str__(self) -> str:
        return "within their standard errors"


@dataclass(frozen=True)
class Measured:
    """Seconds and what follows from them, by this machine and hour: only the ratio is told, nothing is held to it."""

    def __str__(self) -> str:
        return "measured anew"


Rule = Exact | Close | Estimate | Measured
