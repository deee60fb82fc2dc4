"""The contexts that a plan is made for: a list of them, or a range of theta_r, n and v, as boxes."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from dsfit.context import Context
from dsfit.errors import InputError, as_real
from dsfit.frame import HALF_PI
from dsfit.scene.planning.interval import Interval

ROUNDED = 2.0**-22
"""A context may be asked for in float32: every number stands for its neighbours within this, relatively; 0 and 1 for
themselves."""
FIELDS = ("theta_r", "n", "v")
_THETA_STEP, _N_RATIO = math.radians(3.0), 1.25


@dataclass(frozen=True)
class ContextRange:
    """All contexts with theta_r, n and v in ranges [low, high]; phi_r is free. Angles in radians.

    Raises:
        InputError: a range that is no pair of increasing numbers, or out of its domain.

    Example:
        >>> import dsfit
        >>> unlit = dsfit.ContextRange(n=(1.0, 30.0), v=(0.0, 0.0))
        >>> dsfit.plan(dsfit.Integrand(dsfit.DualScattering(dsfit.Fiber.preset("blond"))), unlit).kept[0]
        ('scattered', 'R')
    """

    theta_r: tuple[float, float] = (-HALF_PI, HALF_PI)
    n: tuple[float, float] = (0.0, 30.0)
    v: tuple[float, float] = (0.0, 1.0)

    def __post_init__(self) -> None:
        limits = {"theta_r": (-HALF_PI, HALF_PI), "n": (0.0, math.inf), "v": (0.0, 1.0)}
        for name, (low, high) in limits.items():
            ends = as_real(f"range.{name}", getattr(self, name), torch.float64)
            fits = ends.shape == (2,) and bool(torch.isfinite(ends).all()) and low <= ends[0] <= ends[1] <= high
            if not fits:
                raise InputError(f"range.{name}", getattr(self, name), f"a pair low <= high in [{low:g}, {high:g}]")
            object.__setattr__(self, name, (float(ends[0]), float(ends[1])))

    def boxes(self) -> Boxes:
        """Small boxes that cover the range. A ratio of sums that are linear in v is monotone in v, so that the two ends
        of its range are all that is needed."""
        theta = _cuts(*self.theta_r, _THETA_STEP)
        n = growing(*self.n)
        v = sorted(set(self.v))
        rows = [(*a, *b, c, c) for a, b, c in itertools.product(theta, n, v)]
        low_t, high_t, low_n, high_n, low_v, high_v = torch.tensor(rows, dtype=torch.float64).unbind(-1)
        return Boxes(Interval(low_t, high_t), Interval(low_n, high_n), Interval(low_v, high_v))

    def outside(self, context: Context, fields: tuple[str, ...] = FIELDS) -> str | None:
        """The first field of a context outside the range, or None; float32's rounding of the ends is inside."""
        for name in fields:
            low, high = getattr(self, name)
            least, most = (float(x) for x in torch.aminmax(getattr(context, name).detach()))
            exact = name == "v"
            slack = 0.0 if exact else ROUNDED * max(abs(low), abs(high))
            if least < low - slack or most > high + slack:
                return name
        return None

    def describe(self) -> str:
        """For tables."""
        theta, n, v = ([round(x, 6) for x in pair] for pair in (self.theta_r, self.n, self.v))
        degrees = [round(math.degrees(x), 3) for x in theta]
        return f"theta_r {degrees[0]:g}..{degrees[1]:g} deg, n {n[0]:g}..{n[1]:g}, v {v[0]:g}..{v[1]:g}"


@dataclass(frozen=True)
class Boxes:
    """Intervals of theta_r, n, v, each `[B]`: the bounds hold for every context in any of them."""

    theta_r: Interval
    n: Interval
    v: Interval

    @staticmethod
    def around(context: Context) -> Boxes:
        """A box for each context, wide enough for its rounding to float32; equal contexts once."""
        fields = (context.theta_r, context.n, context.v)
        rows = torch.stack([x.detach().reshape(-1).to(torch.float64) for x in fields], dim=-1)
        theta, n, v = torch.unique(rows, dim=0).unbind(-1)
        theta_r = Interval(theta - ROUNDED * theta.abs(), theta + ROUNDED * theta.abs()).clamp(-HALF_PI, HALF_PI)
        whole = (v == 0) | (v == 1)
        share = Interval(torch.where(whole, v, v * (1 - ROUNDED)), torch.where(whole, v, v * (1 + ROUNDED)))
        return Boxes(theta_r, Interval(n * (1 - ROUNDED), n * (1 + ROUNDED)), share.clamp(0.0, 1.0))

    def __len__(self) -> int:
        return len(self.theta_r.low)

    def __getitem__(self, index: slice) -> Boxes:
        return Boxes(*(x.reshape(lambda y: y[index]) for x in (self.theta_r, self.n, self.v)))

    def holds(self, context: Context, fields: tuple[str, ...] = FIELDS) -> Tensor:
        """Whether each context `[M]` (flattened) is in one of the boxes."""
        found = []
        for name in fields:
            value = getattr(context, name).detach().reshape(-1, 1).to(torch.float64)
            box: Interval = getattr(self, name)
            found.append((value >= box.low) & (value <= box.high))
        return torch.stack(found).all(0).any(-1)


def _cuts(low: float, high: float, step: float) -> list[tuple[float, float]]:
    count = max(1, math.ceil((high - low) / step))
    ends = [low + (high - low) * k / count for k in range(count)] + [high]
    return list(itertools.pairwise(ends))


def growing(low: float, high: float) -> list[tuple[float, float]]:
    """Ranges of n whose width grows with n, from 0.1 to 1."""
    if low == high:
        return [(low, high)]
    ends = [low]
    while ends[-1] < high:
        ends.append(min(high, ends[-1] + min(1.0, max(ends[-1] * (_N_RATIO - 1), 0.1))))
    return list(itertools.pairwise(ends))
