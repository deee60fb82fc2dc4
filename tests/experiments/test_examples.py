"""The examples of using dsfit as a library run, and what they claim is so."""

from __future__ import annotations

import pytest

from experiments.examples import own_integrand, own_proposal, torch_in_optimistix


def test_own_integrand() -> None:
    found = own_integrand.main()
    assert found["fitted"] < found["start"] / 2 < found["uniform"] / 4
    assert abs(found["estimate"] - found["exact"]) < 4 * found["error"] < 0.05 * found["exact"]


def test_own_proposal() -> None:
    found = own_proposal.main()
    assert found["chi-square p"] > 0.001
    assert found["fitted"] < found["start"] / 2 < found["uniform"]


def test_torch_in_optimistix() -> None:
    found = torch_in_optimistix.main()
    assert found["fitted"] == pytest.approx(found["true"], rel=0.02)
    assert found["rms residual"][0] == pytest.approx(0.01, rel=0.2)
