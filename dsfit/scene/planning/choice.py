"""Which terms to leave out: the cheapest choice among all whose error stays within the tolerance."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dsfit.scene.planning.terms import NAMES, SUBSETS

# Microseconds per direction and core, in float64: only their order of magnitude matters.
_LOBES = {"direct": (0.15, 0.25, 5.0), "scattered table": (0.4, 0.4, 0.4), "scattered exact": (3.0, 4.0, 22.0)}
_TREATMENT = 1.0
_BACK, _AVERAGES = 0.4, 2.0
_UNBOUNDED = 1e200


@dataclass(frozen=True)
class Choice:
    """Terms to keep, and what the rest amounts to.

    Attributes:
        keep: whether each of the eight terms is kept.
        treated: whether TRT's caustic is treated.
        bounds: error that leaving out each term (and the two treatments) makes, relative to what is kept, the largest
            over contexts and channels, `[10]`; 0 for what is kept.
        worst: box `[10]` where it is largest.
        total: the largest error of all together.
    """

    keep: tuple[bool, ...]
    treated: bool
    bounds: Tensor
    worst: Tensor
    total: float


def relative_errors(upper: Tensor, kept: Tensor) -> Tensor:
    """upper / kept with 0 / 0 = 0: what is not there cannot be missed."""
    safe = torch.where(kept > 0, kept, 1.0)
    return torch.where(upper == 0, 0.0, torch.where(kept > 0, upper / safe, torch.inf))


def choose(
    upper: Tensor, kept: Tensor, exact: Tensor, tolerance: float, *, table: bool, treatment: bool
) -> Choice:
    """The cheapest of the 256 choices of terms, with the caustic treated or not.

    Args:
        upper: bounds on the ten integrals `[B, 10, C]`, 0 for what is left out exactly.
        kept: lower bounds on what each choice leaves, `[256, B, C]`.
        exact: whether each term `[8]` is left out exactly.
        tolerance: largest relative error of any channel in any context.
        table: whether N^G is looked up, not integrated.
        treatment: whether there is a treatment to leave out.
    """
    upper = upper.clamp_max(_UNBOUNDED)  # times 0 it must be 0
    best: tuple[float, float] | None = None
    found = None
    for treated in (True, False) if treatment else (True,):
        left = 1 - SUBSETS
        gone = torch.einsum("st,btc->sbc", left, upper[:, :8])
        if not treated:
            for column, lobe in ((8, 2), (9, 6)):
                gone = gone + SUBSETS[:, lobe, None, None] * upper[:, column]
        error = relative_errors(gone, kept).amax((1, 2))
        for s in torch.nonzero((error <= tolerance) & ~((SUBSETS > 0) & exact).any(1)).flatten().tolist():
            rank = (_cost(SUBSETS[s], table, treated), float(error[s]))
            if best is None or rank < best:
                best, found = rank, (s, treated)
    assert found is not None  # leaving out nothing but the exact makes no error
    return _describe(found[0], found[1], upper, kept)


def _describe(s: int, treated: bool, upper: Tensor, kept: Tensor) -> Choice:
    keep = SUBSETS[s] > 0
    gone = torch.cat([~keep, keep[[2, 6]] & (not treated)])
    each = relative_errors(upper, kept[s].unsqueeze(1)) * gone[:, None]
    each = torch.where(gone[:, None], each, 0.0).amax(-1)
    total = relative_errors((upper * gone[:, None]).sum(1), kept[s]).amax()
    return Choice(tuple(keep.tolist()), treated, each.amax(0), each.argmax(0), float(total))


def _cost(keep: Tensor, table: bool, treated: bool) -> float:
    total = 0.0
    flags = dict(zip(NAMES, (keep > 0).tolist(), strict=True))
    scattered = _LOBES["scattered table" if table else "scattered exact"]
    for half, costs in (("direct", _LOBES["direct"]), ("scattered", scattered)):
        total += sum(cost for name, cost in zip(("R", "TT", "TRT"), costs, strict=True) if flags[half, name])
        total += _BACK * flags[half, "back"]
    if flags["direct", "back"] or any(flags["scattered", name] for name in ("R", "TT", "TRT", "back")):
        total += _AVERAGES
    if treated and (flags["direct", "TRT"] or (flags["scattered", "TRT"] and not table)):
        total += _TREATMENT
    return total
