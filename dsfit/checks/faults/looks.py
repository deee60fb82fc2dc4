"""The checks that look for planted faults, each on a small subject that is built anew on every call."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch

from dsfit.bsdf import DualScattering, Fiber
from dsfit.checks.finding import Finding
from dsfit.checks.subject import Subject
from dsfit.context import Context
from dsfit.proposals.base import Proposal
from dsfit.scene.integrand import Integrand

THETA_R, PHI_R = 0.6, 0.4
Look = Callable[[int], list[Finding]]


def fiber() -> Fiber:
    """Blond hair."""
    return Fiber.preset("blond")


def bsdf(precision: str = "exact") -> DualScattering:
    """Its BSDF."""
    return DualScattering(fiber(), precision=precision)


def sampling(make: Callable[[Context], Proposal], n: float = 0.0, theta_r: float = THETA_R) -> Look:
    """Chi-square of a proposal."""

    def look(seed: int) -> list[Finding]:
        from dsfit.checks.chi_square import chi_square, findings

        context = Context(theta_r, PHI_R, n)
        generator = torch.Generator().manual_seed(seed)
        return findings("proposal", "", chi_square(make(context), context, 60_000, generator=generator, rtol=1e-5))

    return look


def estimating(
    make: Callable[[], dict[str, Proposal]],
    n: float = 0.0,
    heuristics: Sequence[str] = ("balance",),
) -> Look:
    """Estimators against the quadrature."""

    def look(seed: int) -> list[Finding]:
        from dsfit.checks.unbiased import run

        context = Context(THETA_R, PHI_R, n)
        integrand = Integrand(bsdf("table" if n else "exact"))
        return run(Subject(integrand, context, make(), "", seed), samples=100_000, heuristics=heuristics).findings

    return look


def digits(*names: str, classes: tuple[str, ...] = ("ordinary",)) -> Look:
    """Functions of the atlas against 50 digits, in float64 and in their ordinary regimes alone."""

    def look(seed: int) -> list[Finding]:
        from dsfit.checks.stability.atlas import functions
        from dsfit.checks.stability.function import class_of
        from dsfit.checks.stability.measure import measure

        found = []
        for name in names:
            entry = functions()[name]
            for regime in (r for r in entry.regimes if class_of(r) in classes):
                error = measure(entry, regime, "float64").value
                limit = entry.limits["float64"][0]
                found.append(Finding("stability", name, regime, value=error.worst, bound=limit))
        return found

    return look


def energy() -> Look:
    """Energy of the lobes and of the averages."""

    def look(seed: int) -> list[Finding]:
        from dsfit.checks.furnace.model import energy_findings

        return list(energy_findings(bsdf()))

    return look


def known_furnace() -> Look:
    """The furnace of a lossless fibre."""

    def look(seed: int) -> list[Finding]:
        from dsfit.checks.furnace import model

        model.known_table.cache_clear()
        try:
            return list(model.known_findings())
        finally:
            model.known_table.cache_clear()

    return look


def symmetry() -> Look:
    """Exchange of light and viewer, mirror images."""

    def look(seed: int) -> list[Finding]:
        from dsfit.checks.furnace.model import symmetry_findings

        return list(symmetry_findings(bsdf(), torch.Generator().manual_seed(seed)))

    return look


def limiting() -> Look:
    """Limits of many and of no fibres, of absorption, of widths."""

    def look(seed: int) -> list[Finding]:
        from dsfit.checks.furnace.model import limit_findings

        return list(limit_findings(bsdf(), torch.Generator().manual_seed(seed)))

    return look


def degrees(value: float) -> float:
    """Radians."""
    return value * math.pi / 180
