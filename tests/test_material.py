"""The PBRT-style interface integrates to the same number as quadrature."""

from __future__ import annotations

import math

import pytest
import torch

import dsfit
from dsfit.frame import to_vector
from dsfit.proposals import UniformSphere


@pytest.fixture(scope="module")
def material() -> dsfit.Material:
    bsdf = dsfit.DualScattering(dsfit.Fiber.preset("blond"))
    return dsfit.Material(bsdf, dsfit.StructuredProposal(bsdf, dsfit.Context(0.4)))


def test_sample_f_integrates_to_the_reference(material: dsfit.Material) -> None:
    wo = to_vector(torch.tensor([0.4, 0.9], dtype=torch.float64))
    u = torch.rand(20_000, 3, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    drawn = material.sample_f(wo, u)
    weight = drawn.f * drawn.wi[:, 1:2].abs() / drawn.pdf[:, None]
    mean, error = weight.mean(0), weight.std(0) / math.sqrt(len(u))
    exact = dsfit.reference(dsfit.Integrand(material.bsdf), dsfit.Context(0.4, 0.9)).value
    assert bool((error < 0.01 * exact).all())
    assert bool(((mean - exact).abs() < 4 * error).all())


def test_f_and_pdf_agree_with_sample_f(material: dsfit.Material) -> None:
    wo = to_vector(torch.tensor([[0.4, 0.9], [-1.2, 3.0]], dtype=torch.float64))
    u = torch.rand(50, 2, 3, generator=torch.Generator().manual_seed(6), dtype=torch.float64)
    drawn = material.sample_f(wo, u)
    assert drawn.f.shape == (50, 2, 3) and drawn.wi.shape == (50, 2, 3)
    torch.testing.assert_close(material.pdf(wo, drawn.wi), drawn.pdf, rtol=1e-7, atol=0)
    torch.testing.assert_close(material.f(wo, drawn.wi), drawn.f, rtol=1e-7, atol=1e-12)


def test_bad_vectors_are_named(material: dsfit.Material) -> None:
    good = torch.tensor([1.0, 0.0, 0.0])
    with pytest.raises(dsfit.InputError, match="wi"):
        material.f(good, torch.tensor([1.0, 1.0, 0.0]))
    with pytest.raises(dsfit.InputError, match="wo"):
        material.pdf(torch.tensor([1.0, 0.0]), good)
    with pytest.raises(dsfit.InputError, match="u: "):
        material.sample_f(good, torch.rand(4, 2))
    with pytest.raises(dsfit.InputError, match="proposal"):
        dsfit.Material(material.bsdf, UniformSphere)
