"""What every generator of strands needs: checked arguments, a seeded generator, curves to `Strands`."""

from __future__ import annotations

import torch
from torch import Tensor

from dsfit.errors import InputError, as_number
from dsfit.render.strands import Strands

MOST_POINTS = 20_000_000
"""Most points that a generator makes: 640 MB."""


def check_count(field: str, value: object, low: int, high: int) -> int:
    """Return an integer in [low, high], else raise `InputError`."""
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        raise InputError(field, value, f"an integer in [{low}, {high}]")
    return value


def check_size(name: str, strands: object, points: object) -> tuple[int, int]:
    """Return how many strands of how many points a generator shall make, checked one by one and together."""
    strands = check_count(f"{name}.strands", strands, 1, 1_000_000)
    points = check_count(f"{name}.points", points, 3, 1_000)
    if strands * points > MOST_POINTS:
        raise InputError(f"{name}.strands x points", strands * points, f"at most {MOST_POINTS} points in all")
    return strands, points


def check_length(field: str, value: object) -> float:
    """Return a length > 0, at most 1e6, else raise `InputError`."""
    return as_number(field, value, 0.0, 1e6, open_low=True)


def check_share(field: str, value: object) -> float:
    """Return a number in [0, 1], else raise `InputError`."""
    return as_number(field, value, 0.0, 1.0)


def seeded(name: str, seed: object) -> torch.Generator:
    """A generator in the state of this seed, an integer in [0, 2^63)."""
    return torch.Generator().manual_seed(check_count(f"{name}.seed", seed, 0, 2**63 - 1))


def uniform(shape: tuple[int, ...], generator: torch.Generator, low: float = 0.0, high: float = 1.0) -> Tensor:
    """Independent numbers in [low, high), float64."""
    return low + (high - low) * torch.rand(shape, generator=generator, dtype=torch.float64)


def normal(shape: tuple[int, ...], generator: torch.Generator) -> Tensor:
    """Independent standard normal numbers, float64, cut off at three standard deviations: no strand stands far out."""
    return torch.randn(shape, generator=generator, dtype=torch.float64).clamp(-3.0, 3.0)


def along(points: int) -> Tensor:
    """The parameter s `[points]` from 0 at the root to 1 at the tip."""
    return torch.linspace(0.0, 1.0, points, dtype=torch.float64)


def smoothstep(x: Tensor, low: float = 0.0, high: float = 1.0) -> Tensor:
    """0 below `low`, 1 above `high`, 3 t^2 - 2 t^3 between."""
    t = ((x - low) / (high - low)).clamp(0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def to_strands(
    curves: Tensor, radius: float, generator: torch.Generator, *, tip: float = 1.0, variation: float = 0.1
) -> Strands:
    """Strands of curves `[S, K, 3]`.

    Args:
        radius: of the mean fibre where it is not tapered.
        tip: radius at the tip, as a share: it goes from 1 to `tip` over the last 30 percent of the strand.
        variation: radii of strands are uniform within this share of the mean.
    """
    strands, points, _ = curves.shape
    each = uniform((strands, 1), generator, 1.0 - variation, 1.0 + variation)
    taper = 1.0 - (1.0 - tip) * smoothstep(along(points), 0.7, 1.0)
    first = torch.arange(strands + 1) * points
    return Strands(curves.reshape(-1, 3).contiguous(), first, (radius * each * taper).flatten())
