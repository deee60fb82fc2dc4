"""The samplers as printed must be rejected, and their corrected twins must not: otherwise the checks prove nothing."""

from __future__ import annotations

import math

import pytest
import torch

from dsfit.context import Context
from dsfit.proposals.printed import PRINTED
from tests.proposals.cases import DEG
from tests.proposals.grid import cell_masses, chi_square, counts

ANGLES = (0.0, 46 * DEG, 80 * DEG, 89.9 * DEG, -75 * DEG)
CELLS = (24, 16)
# A clamp and a missing normalisation only show where mass falls outside what theta_r can reach.
REACHABLE = {"lobe_clamped": ANGLES[2:]}
# Normalised as they stand, so that only samples can tell.
NORMALISED = {"cosine_as_printed", "transmittance_inclination_as_printed"}


def verdict(name: str, theta_r: float) -> tuple[float, float]:
    """Integral of the claimed density, and the p-value of samples against its cells."""
    control = PRINTED[name]()
    context = Context(theta_r, 0.7, dtype=torch.float64)
    distribution = control(context)
    width = control.beta
    peaks = [(2 * control.alpha - theta_r, 2 * width), (2 * control.alpha, width)]
    sides = [(side * math.pi, scale) for side in (-1, 1) for scale in (width, control.gamma)]
    with torch.no_grad():
        masses = cell_masses(distribution, context, CELLS, peaks, sides, ())
        u = torch.rand(100_000, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
        omega = distribution.sample(u.clamp(1e-12, 1 - 1e-12))
    assert omega.isfinite().all()
    return float(masses.sum()), chi_square(counts(omega, context, CELLS), masses)


@pytest.mark.parametrize("name", PRINTED)
def test_control_is_rejected(name: str) -> None:
    for theta_r in REACHABLE.get(name, ANGLES):
        total, p_value = verdict(name, theta_r)
        assert p_value < 1e-6, (theta_r, p_value, total)
        if name in NORMALISED:
            assert abs(total - 1) < 1e-8


def test_totals_are_those_of_the_errata() -> None:
    """What the claimed densities integrate to: the slips have the size that the algebra gives."""
    assert verdict("lobe_as_printed", 0.0)[0] == pytest.approx(
        2 * math.pi * math.cos(15 * DEG) * math.exp(-((7.5 * DEG) ** 2) / 2)
    )
    assert verdict("lobe_without_jacobian", 0.0)[0] == pytest.approx(2, abs=1e-6)
    assert verdict("front_as_printed", 0.0)[0] == pytest.approx(2)
    for theta_r, mass in ((0.0, 0.707), (60 * DEG, 0.612)):
        assert verdict("transmittance_as_printed", theta_r)[0] == pytest.approx(mass, abs=6e-4)
    assert verdict("azimuth_clamped", 0.0)[0] == pytest.approx(1 - 0.116, abs=1e-3)


def test_every_control_says_what_is_wrong() -> None:
    for name, control in PRINTED.items():
        assert control.equations.startswith("(") and len(control.slip) > 20, name
        assert control.__doc__
