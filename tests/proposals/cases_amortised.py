"""The amortised proposal, as it starts, with a network that is not small, and briefly trained."""

from __future__ import annotations

import copy
import functools
import math

import torch

import dsfit
from dsfit.fit.amortise import amortise
from dsfit.proposals import AmortisedProposal, FiberAzimuth
from tests.proposals.cases import Case, Peak

HIDDEN = (4,)
_COLUMNS = 12  # of the azimuthal tables: the suite's quadrature has a panel for each
_NODES = tuple(k * math.pi / _COLUMNS for k in range(-_COLUMNS, _COLUMNS + 1))


@functools.cache
def bsdf(preset: str = "blond") -> dsfit.DualScattering:
    return dsfit.DualScattering(dsfit.Fiber.preset(preset), precision="table")


@functools.cache
def untrained(preset: str = "blond") -> AmortisedProposal:
    """As it starts, with few hidden units."""
    return AmortisedProposal(bsdf(preset), HIDDEN)


@functools.cache
def _trained() -> AmortisedProposal:
    return amortise(bsdf(), start=untrained(), steps=10, inclinations=6, pairs=4).proposal


def _coarse(proposal: AmortisedProposal) -> AmortisedProposal:
    """A copy whose azimuths come from tables with few columns."""
    copied = copy.deepcopy(proposal).requires_grad_(True)
    for k, law in enumerate(copied.laws):
        if isinstance(law, FiberAzimuth):
            width = (law.density.shape[1] - 1) // _COLUMNS
            copied.laws[k] = FiberAzimuth(law.density[:, ::width])
    return copied


def _random(size: float, seed: int = 1) -> AmortisedProposal:
    """Corrections of about this size, different in every context."""
    proposal = _coarse(untrained())
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in proposal.network.parameters():
            parameter.copy_(size * torch.randn(parameter.shape, generator=generator, dtype=torch.float64))
    return proposal


def _peaks(build, n: float):  # noqa: ANN001, ANN202
    """Mode and larger width in theta_i of every component that matters."""

    def peaks(theta_r: float) -> list[Peak]:
        with torch.no_grad():
            shape = build().shape(dsfit.Context(theta_r, n=n, dtype=torch.float64))
        width = torch.maximum(shape.below, shape.above)
        columns = (shape.log_weights.tolist(), shape.mode.tolist(), width.tolist())
        return [(2 * m - theta_r, 2 * w) for share, m, w in zip(*columns, strict=True) if share > -20]

    return peaks


def _case(name: str, build, n: float, **more) -> Case:  # noqa: ANN001, ANN003
    return Case(name, build, _peaks(build, n), phi_breaks=_NODES, one_to_one=False, n=n, **more)


_SIZES = (lambda: _random(3.0), lambda: _random(100.0), lambda: _random(100.0, 2))

CASES = [
    _case("amortised scattered", lambda: _random(0.2), 3.0, extremes=_SIZES),
    _case("amortised trained", lambda: _coarse(_trained()), 0.0),
]
