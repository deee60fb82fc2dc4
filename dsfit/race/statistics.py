"""Root mean squared errors with intervals, and the test of whether estimates are centred on the truth."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor

LEVEL = 0.95
HEAVY = 0.5
"""Share of the sum of squares from which on a single one of many estimates decides and the error counts as
heavy-tailed."""
_CENTRED = 0.01
_TEST_SHARE = 0.2
_FEWEST, _MANY = 8, 32
_CHANCE = 1e-3


@dataclass(frozen=True)
class Rmse:
    """Root mean square of relative errors, `value`, with the ends of its 95 % interval.

    Attributes:
        count: estimates that it is the mean of.
        degrees: of freedom of the interval.
        top_share: share of the largest squared error in their sum; near 1 where rare large weights decide, so that
            the root mean square of few estimates is too low.
    """

    value: float
    low: float
    high: float
    count: int
    degrees: float
    top_share: float

    @property
    def heavy(self) -> bool:
        """Whether a single estimate makes up most of the sum, among enough of them to tell."""
        return self.count >= _MANY and self.top_share > HEAVY

    def to_dict(self) -> dict[str, Any]:
        """As plain data."""
        return {**asdict(self), "heavy": self.heavy}


def _largest_share(count: int, least: float) -> float:
    """`least`, or what the largest of `count` squares of normal errors exceeds with probability `_CHANCE`."""
    from scipy.special import chdtri

    largest = float(chdtri(1.0, _CHANCE / count))
    return max(least, largest / (largest + count - 1))


def relative_squared(estimates: Tensor, truth: Tensor) -> Tensor:
    """`|estimate - truth|^2 / |truth|^2` `[...]` with |.| over channels, for estimates `[..., C]`; float64."""
    truth = truth.to(torch.float64)
    return (estimates.to(torch.float64) - truth).square().sum(-1) / truth.square().sum(-1)


def rmse(squared: Tensor) -> Rmse:
    """The root mean square of relative errors from their squares `[R]`.

    The sum of squares is taken as a multiple of chi-square with `nu = 2 R mean^2 / variance` degrees of freedom
    (Satterthwaite 1946, Biometrics Bulletin 2), which is R for normal errors of one channel, and fewer where tails are
    heavier; at most R, at least 1.
    """
    from scipy.special import chdtri

    squared = squared.to(torch.float64).flatten()
    count, mean = len(squared), float(squared.mean())
    if not mean > 0 or not math.isfinite(mean):
        value = math.sqrt(mean) if mean == 0 else math.inf
        return Rmse(value, 0.0, value, count, float(count), 0.0)
    variance = float(squared.var()) if count > 1 else 0.0
    degrees = float(count) if variance == 0 else min(float(count), 2 * count * mean**2 / variance)
    degrees = max(1.0, degrees)
    tail = (1 - LEVEL) / 2
    low, high = (math.sqrt(mean * degrees / float(chdtri(degrees, p))) for p in (tail, 1 - tail))
    return Rmse(math.sqrt(mean), low, high, count, degrees, float(squared.max() / squared.sum()))


@dataclass(frozen=True)
class Centred:
    """Whether estimates scatter around the truth.

    Attributes:
        tested: whether there was enough to test by: the standard error of the mean within 1 %, no single estimate that
            decides.
        p_value: two-sided, the least over channels with Sidak's correction; 1 where not tested.
        bias: |mean deviation| / |truth|, the standard error not subtracted.
    """

    tested: bool
    p_value: float
    bias: float


def centred(deviations: Tensor, allowance: float, predicted: float = 0.0) -> Centred:
    """Student's t-test that relative deviations `(estimate - truth) / |truth|` `[R, C]` have mean 0.

    Args:
        deviations: one row per independent estimate.
        allowance: what the truth and the arithmetic may be off by, relative.
        predicted: standard deviation of one deviation by quadrature, if known; the larger one counts, because few
            estimates with rare large weights do not know theirs.
    """
    from scipy.special import stdtr

    deviations = deviations.to(torch.float64)
    count, channels = deviations.shape
    mean = deviations.mean(0)
    bias = float(torch.linalg.vector_norm(mean))
    if count < _FEWEST or not bool(torch.isfinite(deviations).all()):
        return Centred(False, 1.0, bias)
    error = torch.maximum(deviations.std(0), torch.tensor(predicted, dtype=torch.float64)) / math.sqrt(count)
    squared = deviations.square().sum(-1)
    decided = float(squared.max()) > _largest_share(count, _TEST_SHARE) * float(squared.sum())
    if float(torch.linalg.vector_norm(error)) > _CENTRED or decided:
        return Centred(False, 1.0, bias)
    t = (mean.abs() - allowance).clamp_min(0) / error.clamp_min(1e-300)
    p = 2 * torch.as_tensor(stdtr(count - 1.0, (-t).numpy()))
    return Centred(True, float(-math.expm1(channels * math.log1p(-min(float(p.min()), 1 - 1e-16)))), bias)
