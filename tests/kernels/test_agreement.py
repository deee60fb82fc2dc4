"""Kernels against the float64 BSDF and the float64 proposal."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from dsfit.context import Context
from dsfit.kernels.geometry import Cell, Direction, Records
from tests.kernels import cases

SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in ("nonabsorbing", "brown", "black")]
presets = pytest.mark.parametrize("preset", ["blond", *SLOW])
# of each lobe's largest value; TRT has the corner where its glint fades out
LOOK_UP = {"TRT": 7e-3, "R_scattered": 4e-4, "TT_scattered": 5e-4, "TRT_scattered": 3e-3}


@presets
def test_azimuths_are_within_their_bound_of_each_lobes_largest(preset: str) -> None:
    kernel, count = cases.kernel(preset), 4000
    layout = kernel.program("both").layout
    table = kernel.program("both").tables.records
    u = torch.rand(2, count, generator=torch.Generator().manual_seed(1))
    theta_r, phi = math.pi * u[0] - math.pi / 2, math.pi * u[1]
    direction = Direction.at(-theta_r, phi, theta_r)  # theta_diff = theta_r
    records = Records(table, Cell.of(direction, layout.rows, layout.columns), layout)
    bsdf = cases.bsdf(preset)
    scattered = bsdf.azimuthal_scattered(direction.diff.double(), direction.phi.double())
    wanted = {"TRT": bsdf.azimuthal(direction.diff.double(), direction.phi.double())[:, 2]}
    wanted |= {f"{name}_scattered": scattered[:, p] for p, name in enumerate(("R", "TT", "TRT"))}
    for name, start in layout.offsets().items():
        reference = wanted[name][:, :1] if name == "R_scattered" else wanted[name]
        found = torch.stack([records[start + c] for c in range(reference.shape[1])], dim=-1)
        error = (found - reference).abs().amax(0) / kernel.columns[name].amax((0, 1))
        assert float(error.max()) < LOOK_UP[name], name


@presets
@pytest.mark.parametrize("v", [None, 0.0, 1.0])
def test_values_agree_with_the_bsdf(preset: str, v: float | None) -> None:
    """Within 2e-3 of the largest value of a context, 1e-5 at the median."""
    kernel, context = cases.kernel(preset), cases.contexts(150, v=v)
    contexts = kernel.prepare_context(context)
    drawn = kernel.sample(contexts, cases.uniforms(24, 150))
    spread = cases.directions(24, 150)
    theta_i, phi = (torch.cat(x) for x in zip(drawn, spread, strict=True))
    reference = cases.exact(context, theta_i, phi, preset)
    error = (kernel.eval(contexts, theta_i, phi) - reference).abs() / reference.amax(0)
    assert float(error.max()) < 2e-3
    assert float(error.median()) < 1e-5


@presets
def test_integrals_agree_to_one_in_ten_thousand_of_the_furnace(preset: str) -> None:
    theta_r = torch.tensor([0.1, -0.7, 1.2, 0.4, -1.1, 0.0])
    context = Context(theta_r, 0.0, torch.tensor([0.0, 1.0, 4.0, 12.0, 2.0, 0.0]), torch.tensor([1, 0, 0.3, 0, 0.9, 1]))
    theta_i, phi, weight = _product_rule(161, 161)
    kernel = cases.kernel(preset)
    found = _integral(kernel.eval(kernel.prepare_context(context), theta_i, phi), weight)
    wanted = _integral(cases.exact(context, theta_i, phi, preset), weight)
    assert float(((found - wanted).abs() / wanted.amax(-1, keepdim=True)).max()) < 1e-4


@presets
def test_log_densities_agree_with_the_proposal(preset: str) -> None:
    kernel, context = cases.kernel(preset), cases.contexts(200)
    contexts = kernel.prepare_context(context)
    drawn, spread = kernel.sample(contexts, cases.uniforms(24, 200)), cases.directions(24, 200)
    theta_i, phi = (torch.cat(x) for x in zip(drawn, spread, strict=True))
    error = (kernel.log_prob(contexts, theta_i, phi) - cases.exact_log_prob(context, theta_i, phi, preset)).abs()
    assert float(error.max()) < 2e-3
    assert float(error.median()) < 2e-6


def test_draws_are_those_of_the_proposal() -> None:
    """The same component and inclination from the same uniforms; azimuths come from one of two rows instead of their
    blend."""
    kernel, context, u = cases.kernel(), cases.contexts(300), cases.uniforms(16, 300)
    theta_i, phi = kernel.sample(kernel.prepare_context(context), u)
    reference = cases.mixture()(context.to(torch.float64)).sample(u.double())
    close = (theta_i - reference[..., 0]).abs() < 1e-4
    assert bool(close.all())
    turn = (phi.abs() - reference[..., 1].abs()).abs()
    assert float(turn[close].median()) < 2e-3


def _product_rule(inclinations: int, azimuths: int) -> tuple[Tensor, Tensor, Tensor]:
    """Midpoints of theta_i and phi, as `[S, 1]`, and their weights."""
    theta = (torch.arange(inclinations) + 0.5) * (math.pi / inclinations) - math.pi / 2
    phi = (torch.arange(azimuths) + 0.5) * (math.pi / azimuths)
    theta, phi = (x.reshape(-1, 1).expand(-1, 6).contiguous() for x in torch.meshgrid(theta, phi, indexing="ij"))
    return theta, phi, torch.cos(theta.double()) * (math.pi / inclinations) * (2 * math.pi / azimuths)


def _integral(value: Tensor, weight: Tensor) -> Tensor:
    return (value.double() * weight.unsqueeze(-1)).sum(0)
