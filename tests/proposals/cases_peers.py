"""Proposals that stand for what others do: Cauchy lobes, offsets turned by scattering, tables."""

from __future__ import annotations

import functools
import math

import dsfit
from dsfit.proposals import Product, SplitGaussianLobe
from dsfit.proposals.base import Azimuthal, Proposal
from dsfit.proposals.deon_azimuth import TurnedOffset
from dsfit.proposals.ou import OuProposal
from dsfit.proposals.ou_azimuth import GlintCosine, WrappedCauchy
from dsfit.proposals.table_2d import Table2D
from dsfit.proposals.table_2d_grid import GridOfTables
from tests.proposals.cases import DEG, Case, Peak, uniform_theta


@functools.cache
def _bsdf() -> dsfit.DualScattering:
    return dsfit.DualScattering(dsfit.Fiber.preset("brown"), precision="table")


def _ou() -> Proposal:
    return OuProposal(_bsdf())


def _table() -> Proposal:
    return Table2D(dsfit.Integrand(_bsdf()), (24, 8))


@functools.cache
def _grid_of(blend: str) -> Proposal:
    integrand = dsfit.Integrand(_bsdf())
    return GridOfTables(integrand, views=9, depths=(0.0, 4.0, 30.0), resolution=(24, 8), blend=blend)


def _turned(azimuth: Azimuthal) -> Proposal:
    return Product(SplitGaussianLobe(0.05, 0.3, 0.3), azimuth)


def _cauchy_peaks(theta_r: float) -> list[Peak]:
    lobes = ((-7.5, 5.3), (3.75, 2.7), (11.25, 10.6), (0.0, 10.0))
    kinks = [theta_r + side * 2 * math.acos(math.sqrt((1.55**2 - 1) / 3)) for side in (-1, 1)]  # eta' = 2: no caustic
    return [(2 * mode * DEG - theta_r, 2 * width * DEG) for mode, width in lobes] + [(x, 1e-3) for x in kinks]


_ENDS = ((math.pi, 0.3), (-math.pi, 0.3))
_GLINTS = ((0.2, 0.2), (-0.2, 0.2))

CASES = [
    Case(
        "wrapped cauchy",
        lambda: uniform_theta(WrappedCauchy(0.4)),
        phi_peaks=((math.pi, 0.4), (-math.pi, 0.4)),
        extremes=tuple(lambda s=s: uniform_theta(WrappedCauchy(s)) for s in (1e-4, 0.01, 2.0, 10.0)),
    ),
    Case("glint", lambda: uniform_theta(GlintCosine(1.55, 0.2)), _cauchy_peaks, _GLINTS, one_to_one=False),
    Case("ou cauchy", _ou, lambda theta_r: _cauchy_peaks(theta_r)[1:2], _ENDS, one_to_one=False),
    Case("turned offset R", lambda: _turned(TurnedOffset("R", 1.55)), lambda theta_r: [(0.1 - theta_r, 0.6)]),
    Case("table", _table),
    Case("grid of tables, nearest", lambda: _grid_of("nearest"), one_to_one=False),
    Case("grid of tables, linear", lambda: _grid_of("linear"), one_to_one=False),
]
