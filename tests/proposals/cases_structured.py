"""The laws drawn from the fibre's own azimuths, and the structured family."""

from __future__ import annotations

import functools
import math

import torch

import dsfit
from dsfit.proposals import FiberAzimuth, OffsetAzimuth, Product, SplitGaussianLobe, StructuredProposal, UniformAzimuth
from dsfit.proposals.base import Proposal
from dsfit.proposals.structured import azimuth_tables
from tests.proposals.cases import DEG, Case, Peak


@functools.cache
def _bsdf() -> dsfit.DualScattering:
    return dsfit.DualScattering(dsfit.Fiber.preset("blond"))


def _peaks(*lobes: tuple[float, float]):  # noqa: ANN202
    def peaks(theta_r: float) -> list[Peak]:
        return [(2 * mode - theta_r, 2 * width) for mode, width in lobes]

    return peaks


def _split() -> Proposal:
    return Product(SplitGaussianLobe(0.1, 0.05, 0.2), UniformAzimuth())


def _split_extreme(mode: float, below: float, above: float):  # noqa: ANN202
    return lambda: Product(SplitGaussianLobe(mode, below, above), UniformAzimuth())


def _azimuth(scattered: bool, k: int):  # noqa: ANN202
    def build() -> Proposal:
        return Product(SplitGaussianLobe(0.05, 0.15, 0.15), azimuth_tables(_bsdf(), scattered)[k])

    return build


def _offset(lobe: str, mode: float = 0.05, width: float = 0.15):  # noqa: ANN202
    return lambda: Product(SplitGaussianLobe(mode, width, width), OffsetAzimuth(lobe, 1.55))


def _dark_row() -> Proposal:
    """A table with a row without any light, which becomes uniform."""
    rows = torch.rand(9, 13, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    rows[4] = 0
    return Product(SplitGaussianLobe(0.0, 0.3, 0.3), FiberAzimuth(rows))


def _structured(n: float):  # noqa: ANN202
    return lambda: StructuredProposal(_bsdf(), dsfit.Context(0.3, n=n))


# the density is piecewise linear in phi: cells of the suite's grid end at nodes, panels must end at them as well
_NODES = tuple(k * math.pi / 180 for k in range(-180, 181))
_COARSE = tuple(k * math.pi / 12 for k in range(-12, 13))
_LOBES = _peaks((-7.5 * DEG, 7 * DEG), (3.75 * DEG, 3.5 * DEG), (11.25 * DEG, 14 * DEG))

CASES = [
    Case(
        "split lobe",
        _split,
        _peaks((0.1, 0.05), (0.1, 0.2)),
        extremes=(_split_extreme(0.0, 1e-4, 2.0), _split_extreme(1.2, 0.01, 0.01), _split_extreme(-1.0, 3.0, 1e-3)),
    ),
    *(
        Case(
            f"azimuth {name} {'scattered' if s else 'direct'}", _azimuth(s, k), _peaks((0.05, 0.15)), phi_breaks=_NODES
        )
        for s in (False, True)
        for k, name in enumerate(("R", "TT", "TRT"))
    ),
    Case("offset azimuth R", _offset("R"), _peaks((0.05, 0.15))),
    Case("azimuth with a dark row", _dark_row, _peaks((0.0, 0.3)), phi_breaks=_COARSE),
    Case("structured direct", _structured(0.0), _LOBES, phi_breaks=_NODES, one_to_one=False, n=0.0),
    Case("structured scattered", _structured(3.0), _LOBES, phi_breaks=_NODES, one_to_one=False),
]
