"""What the header draws follows its density, its density integrates to 1, vectors and angles mean the same."""

from __future__ import annotations

import math

import pytest
import torch
from scipy import stats
from torch import Tensor

import dsfit
from tests.export import cases
from tests.kernels import cases as kernels

pytestmark = pytest.mark.skipif(not cases.has_compiler(), reason="no C++ compiler")
CONTEXTS = ((0.2, 0.0, 1.0), (-1.1, 0.5, 0.3), (0.6, 3.0, 0.0), (1.45, 30.0, 0.0), (-1.569, 2.0, 0.1))
ROWS, COLUMNS, FINE = 24, 16, 40


def some() -> tuple[Tensor, Tensor, Tensor]:
    return tuple(torch.tensor(x) for x in zip(*CONTEXTS, strict=True))


def cell_masses(code: cases.CompiledHeader, own: Tensor) -> Tensor:
    """Integrals of the density over cells of theta_i and phi, `[ROWS, COLUMNS, B]`."""
    rows, columns = ROWS * FINE, COLUMNS * FINE
    theta = (torch.arange(rows) + 0.5) * (math.pi / rows) - math.pi / 2
    phi = (torch.arange(columns) + 0.5) * (2 * math.pi / columns) - math.pi
    grid = torch.cartesian_prod(theta, phi)[:, None].expand(-1, len(own), -1)
    density = code.pdf(own, grid[..., 0].contiguous(), grid[..., 1].contiguous()).double()
    mass = density * torch.cos(grid[..., 0].double()) * (math.pi / rows) * (2 * math.pi / columns)
    return mass.reshape(ROWS, FINE, COLUMNS, FINE, len(own)).sum((1, 3))


def test_draws_follow_the_density() -> None:
    """Chi-square over 384 cells for each context, at Sidak's level for 1e-3."""
    code, given, count = cases.compiled(), some(), 60_000
    own = code.prepare(*given)
    mass = cell_masses(code, own)
    assert float((mass.sum((0, 1)) - 1).abs().max()) < 2e-3
    theta, phi, _, _ = code.sample(own, cases.uniforms(count, len(CONTEXTS)))
    row = ((theta / math.pi + 0.5) * ROWS).long().clamp(0, ROWS - 1)
    column = ((phi / (2 * math.pi) + 0.5) * COLUMNS).long().clamp(0, COLUMNS - 1)
    for b in range(len(CONTEXTS)):
        found = torch.bincount(row[:, b] * COLUMNS + column[:, b], minlength=ROWS * COLUMNS).double()
        expected = mass[..., b].flatten() * (count / mass[..., b].sum())
        large = expected >= 10
        parts = ((x[large], x[~large].sum()[None]) for x in (found, expected))
        pairs = [torch.cat(part) for part in parts]
        value = float(((pairs[0] - pairs[1]) ** 2 / pairs[1].clamp_min(1e-9)).sum())
        assert stats.chi2.sf(value, int(large.sum())) > 1 - (1 - 1e-3) ** (1 / len(CONTEXTS)), CONTEXTS[b]


def test_mean_of_inverse_densities_is_the_sphere() -> None:
    code, count = cases.compiled(), 200_000
    inverse = 1 / code.sample(code.prepare(*some()), cases.uniforms(count, len(CONTEXTS), seed=7))[2].double()
    error = inverse.std(0) / math.sqrt(count)
    assert bool(((inverse.mean(0) - 4 * math.pi).abs() < 4.5 * error).all())
    assert bool((error < 2.0).all())


def test_vectors_and_angles_mean_the_same() -> None:
    code, count = cases.compiled(), 4000
    wo, wi = cases.unit_vectors(count, 1), cases.unit_vectors(count, 2)
    wi[2] = wo[2] * torch.tensor([-1.0, 1.0, 1.0])
    n, v = 5 * torch.rand(count, generator=torch.Generator().manual_seed(4)), torch.full((count,), 0.4)
    value, pbrt, density = code.vectors(wo, wi, n, v)
    (theta_r, phi_r), (theta_i, phi_i) = (angles(x) for x in (wo, wi))
    phi = phi_r - phi_i
    exact = kernels.bsdf()(theta_i, theta_r, phi, n.double(), v.double())
    assert float(((value - exact).abs() / exact.amax(-1, keepdim=True).clamp_min(1.0)).max()) < 5e-3
    own = code.prepare(theta_r.float(), n, v)
    angled = code.pdf(own, theta_i.float()[None], phi.float()[None])[0]
    inside = wi[:, 0].abs() < 0.9999  # where float32 angles tell cosines
    assert float(((density - angled).abs() / angled)[inside].max()) < 1e-3
    assert torch.allclose(pbrt * wi[:, 2:].abs(), value, rtol=1e-5)


def test_f_pbrt_is_that_of_a_material() -> None:
    """Tangent, normal and binormal of dsfit are PBRT's x, z and -y."""
    code, count = cases.compiled(), 300
    wo, wi = cases.unit_vectors(count, 5)[2:], cases.unit_vectors(count, 6)[2:]
    n, v = torch.full((count - 2,), 1.5), torch.full((count - 2,), 0.3)
    material = dsfit.Material(kernels.bsdf(), cases.proposal(), 1.5, 0.3)
    turned = [torch.stack([x[:, 0], x[:, 2], -x[:, 1]], dim=-1).double() for x in (wo, wi)]
    wanted = material.f(*turned)
    _, found, density = code.vectors(wo.contiguous(), wi.contiguous(), n, v)
    assert float(((found - wanted).abs() / wanted.amax()).max()) < 2e-3
    assert torch.allclose(density.double(), material.pdf(*turned), rtol=1e-2)


def test_drawn_vectors_are_unit_vectors_of_the_drawn_angles() -> None:
    code, count = cases.compiled(), 3000
    wo, u = cases.unit_vectors(count, 8), cases.uniforms(count)
    n, v = torch.full((count,), 4.0), torch.full((count,), 0.2)
    wi, density, value = code.sample_vectors(wo, u, n, v)
    assert float((wi.norm(dim=-1) - 1).abs().max()) < 1e-6
    again, _, same = code.vectors(wo, wi, n, v)
    usual = slice(2, None)  # the first two look along the fibre, where azimuths have no digits
    assert float(((same - density).abs() / density)[usual].median()) < 1e-6
    assert float(((same - density).abs() / density)[usual].quantile(0.99)) < 1e-3
    assert torch.allclose(again[usual], value[usual], rtol=1e-2, atol=1e-3 * float(value.max()))


def test_one_call_for_contexts_met_once() -> None:
    code, given = cases.compiled(), cases.contexts()
    u = cases.uniforms(len(given[0]))
    once, twice = code.shade(*given, u), code.sample(code.prepare(*given), u[None].contiguous())
    for a, b in zip(once, twice, strict=True):
        assert torch.equal(a, b[0])


def angles(vectors: Tensor) -> tuple[Tensor, Tensor]:
    x, y, z = vectors.double().unbind(-1)
    return torch.atan2(x, torch.hypot(y, z)), torch.atan2(z, y)
