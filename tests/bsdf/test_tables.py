"""The tabulated N^G stays within its stated error."""

from __future__ import annotations

import math

import pytest
import torch

import dsfit


@pytest.mark.parametrize("name", dsfit.Fiber.presets())
def test_table_error(name: str) -> None:
    fiber = dsfit.Fiber.preset(name)
    exact, table = (dsfit.DualScattering(fiber, precision=p) for p in ("exact", "table"))
    g = torch.Generator().manual_seed(1)
    diff = torch.rand(1500, generator=g, dtype=torch.float64) * (math.pi / 2)
    phi = (torch.rand(1500, generator=g, dtype=torch.float64) * 2 - 1) * math.pi
    a, b = exact.azimuthal_scattered(diff, phi), table.azimuthal_scattered(diff, phi)
    error = ((a - b).abs().amax(0) / a.amax(0)).amax(-1)
    assert float(error[0]) < 1e-5 and float(error[1]) < 1e-5 and float(error[2]) < 2e-3, error


def test_integrals_agree() -> None:
    fiber = dsfit.Fiber.preset("blond")
    values = []
    for precision in ("exact", "table"):
        integrand = dsfit.Integrand(dsfit.DualScattering(fiber, precision=precision))
        values.append(dsfit.reference(integrand, dsfit.Context(1.2, n=3.0), 1e-6).value)
    torch.testing.assert_close(values[1], values[0], rtol=1e-5, atol=0)


def test_table_is_refused_where_it_would_be_wrong() -> None:
    blond = dsfit.Fiber.preset("blond")
    refused = [
        (blond.replace(eccentricity=0.9), "marschner"),
        (blond.replace(eta=torch.tensor([1.5, 1.6], dtype=torch.float64)), "marschner"),
        (blond.replace(eta=torch.tensor(1.5, dtype=torch.float64, requires_grad=True)), "marschner"),
        (blond, "raw"),
    ]
    for fiber, model in refused:
        with pytest.raises(dsfit.InputError, match="precision"):
            dsfit.DualScattering(fiber, azimuthal=model, precision="table")
