"""The kernel's density: normalised, and that of what it draws."""

from __future__ import annotations

import math

import pytest
import torch

from dsfit.checks.chi_square import chi_square
from dsfit.context import Context
from dsfit.kernels.normal import upper_quantile
from dsfit.quadrature import panel_points
from tests.kernels import cases

POINTS = ((0.1, 0.0, 1.0), (1.2, 3.0, 0.0), (-1.5, 1.0, 0.4), (0.7, 40.0, 0.02))


def test_density_integrates_to_one() -> None:
    context = Context(*(torch.tensor(x, dtype=torch.float32) for x in (list(c) for c in _columns())))
    kernel = cases.kernel()
    contexts = kernel.prepare_context(context)
    breaks = torch.linspace(-math.pi / 2, math.pi / 2, 161, dtype=torch.float64)[None]
    theta, weight = (x[0] for x in panel_points(breaks, 6))
    columns = kernel.laws.grid.columns
    phi = torch.linspace(0, math.pi, columns, dtype=torch.float64)  # the density is linear between these
    ends = torch.full_like(phi, 2 * math.pi / (columns - 1))
    ends[[0, -1]] /= 2
    nodes = torch.stack(torch.meshgrid(theta, phi, indexing="ij"), dim=-1).reshape(-1, 2, 1).expand(-1, 2, len(POINTS))
    mass = torch.exp(kernel.log_prob(contexts, nodes[:, 0].float().contiguous(), nodes[:, 1].float().contiguous()))
    factor = (torch.cos(theta) * weight)[:, None] * ends
    assert torch.allclose((mass * factor.reshape(-1, 1)).sum(0), torch.ones(len(POINTS)).double(), atol=2e-5)


def _columns() -> tuple[tuple[float, ...], ...]:
    theta_r, n, v = zip(*POINTS, strict=True)
    return theta_r, tuple(0.0 for _ in POINTS), n, v


@pytest.mark.parametrize("point", POINTS)
def test_samples_follow_the_density(point: tuple[float, float, float]) -> None:
    theta_r, n, v = point
    context = Context(torch.tensor(theta_r, dtype=torch.float32), 0.3, n, v)
    generator = torch.Generator().manual_seed(11)
    found = chi_square(cases.kernel().proposal(), context, 40_000, (20, 14), generator=generator, rtol=1e-4)
    assert found.invalid == 0
    assert abs(found.mass - 1) < 3e-4
    assert found.p_value > 1e-3


def test_the_tail_is_inverted_to_float32() -> None:
    y = torch.cat([torch.logspace(-13.5, -0.001, 4000), 1 - torch.logspace(-6, -1, 500)]).clamp_max(1)
    wanted = -torch.special.ndtri(y.double() / 2)
    error = (upper_quantile(y) - wanted).abs() / wanted.clamp_min(0.1)
    assert float(error.max()) < 2e-6


def test_sample_eval_is_what_the_separate_calls_give() -> None:
    kernel = cases.kernel()
    contexts, u = kernel.prepare_context(cases.contexts(40)), cases.uniforms(5, 40)
    theta_i, phi, pdf, value = kernel.sample_eval(contexts, u)
    assert all(torch.equal(a, b) for a, b in zip((theta_i, phi), kernel.sample(contexts, u), strict=True))
    assert torch.equal(kernel.eval(contexts, theta_i, phi), value)
    assert torch.equal(kernel.log_prob(contexts, theta_i, phi), torch.log(pdf))
