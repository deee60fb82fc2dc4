"""Derivatives that were once wrong in one mode of differentiation."""

from __future__ import annotations

import torch

import dsfit
from dsfit.checks.gradients.compare import check_derivative

THETA_DIFF = torch.tensor([0.1, -0.5, 0.9], dtype=torch.float64)
PHI = torch.tensor([0.4, 1.9, -2.8], dtype=torch.float64)


def windows(values: dict[str, torch.Tensor]) -> torch.Tensor:
    return dsfit.DualScattering(dsfit.Fiber.preset("blond", **values)).azimuthal_scattered(THETA_DIFF, PHI)


def test_forward_mode_of_windows_at_the_caustic() -> None:
    """The roots of azimuths beyond the caustic are the caustic itself, where Newton's steps have no slope."""
    check = check_derivative(windows, {"eta": torch.tensor(1.55, dtype=torch.float64)}, "eta", step=0.02)
    assert check.forward is not None and check.worst < 1 and check.apart < 1e-12 and check.unclear_share == 0


def test_forward_mode_of_a_round_section() -> None:
    """A section is treated as round only where nobody asks for the derivative in its eccentricity."""
    values = {"eccentricity": torch.tensor(1.0, dtype=torch.float64)}
    check = check_derivative(windows, values, "eccentricity", step=0.02)
    assert check.forward is not None and check.worst < 1 and check.apart < 1e-12 and check.unclear_share == 0
    assert float(check.numeric.abs().max()) > 0.005

    def fiber(eccentricity: torch.Tensor) -> torch.Tensor:
        strand = dsfit.Fiber.preset("blond", eccentricity=eccentricity)
        assert strand.requires_grad and not strand.is_round
        return strand.eta

    torch.func.jvp(fiber, (values["eccentricity"],), (torch.ones((), dtype=torch.float64),))
    assert dsfit.Fiber.preset("blond").is_round and not dsfit.Fiber.preset("blond").requires_grad
