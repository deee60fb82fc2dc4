"""The compiled header against the formulas of the kernels in float64 on the same tables, and against the exact BSDF and
proposal."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from dsfit.context import Context
from dsfit.export.compiled import FAST
from tests.export import cases
from tests.kernels import cases as kernels

pytestmark = pytest.mark.skipif(not cases.has_compiler(), reason="no C++ compiler")
SAMPLES = 100
SLOW = [
    pytest.param(preset, kind, flags, marks=pytest.mark.slow, id=f"{preset}-{kind}-{flags[-1]}")
    for preset in ("nonabsorbing", "blond", "brown", "black")
    for kind, flags in (("untrained", cases.FLAGS), ("trained", FAST), ("trained", (*FAST, "-ffast-math")))
]
headers = pytest.mark.parametrize(("preset", "kind", "flags"), [("blond", "any", cases.FLAGS), *SLOW])


def relative(error: Tensor, scale: Tensor) -> float:
    """Largest error of each context relative to its scale."""
    return float((error / scale.clamp_min(1e-10)).max())


def directions(sampled: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
    """Drawn ones, as many uniform over the sphere, and poles and borders of azimuth."""
    spread = kernels.directions(*sampled[0].shape)
    half = math.pi / 2
    corners = torch.cartesian_prod(torch.tensor([-half, -1.57, 0.2, half]), torch.tensor([-math.pi, 0.0, half, 3.2]))
    edges = (x[:, None].expand(-1, sampled[0].shape[1]) for x in corners.unbind(-1))
    found = zip(sampled[:2], spread, edges, strict=True)
    theta_i, phi = (torch.cat(x).contiguous() for x in found)
    return theta_i.clamp(-1.57079637, 1.57079637), phi


@headers
def test_header_agrees_with_its_twin(preset: str, kind: str, flags: tuple[str, ...]) -> None:
    """f and pdf cos(theta_i) to 1e-5 of their largest at a context, draws to 1e-5."""
    code, twin, given = cases.compiled(preset, kind, flags), cases.twin(preset, kind), cases.contexts()
    doubles = tuple(x.double() for x in given)
    own = code.prepare(*given)
    u = cases.uniforms(SAMPLES, len(given[0]))
    drawn = code.sample(own, u)
    theta_i, phi = directions(drawn)
    value, density = code.eval(own, theta_i, phi), code.pdf(own, theta_i, phi)
    fields = twin.fields(*doubles)
    wanted = twin.eval(*doubles, theta_i.double(), phi.double())
    expected = twin.pdf(doubles[0], fields, theta_i.double(), phi.double())
    for x in (value, density, *drawn):
        assert bool(torch.isfinite(x).all())
    assert relative((value - wanted).abs(), wanted.amax((0, 2), keepdim=True)) < 1e-5
    cosine = torch.cos(theta_i.double()).abs()
    assert relative((density - expected).abs() * cosine, (expected * cosine).amax(0)) < 1e-5
    assert float(((density - expected).abs() / expected).max()) < 1e-4
    theta, azimuth = twin.sample(doubles[0], fields, u.double())
    assert float((drawn[0] - theta).abs().max()) < 1e-5
    assert float(((drawn[1] - azimuth).abs() > 1e-5).double().mean()) < 1e-4  # a uniform number at a row's share
    assert torch.equal(drawn[2], density[:SAMPLES]) and torch.equal(drawn[3], value[:SAMPLES])


@headers
def test_tables_are_close_to_the_exact_bsdf_and_proposal(preset: str, kind: str, flags: tuple[str, ...]) -> None:
    """f within 2e-3 of the largest value of a context, 1e-5 at the median; log pdf within 2e-4 at the median."""
    code, given = cases.compiled(preset, kind, flags), cases.contexts()
    own = code.prepare(*given)
    theta_i, phi = directions(code.sample(own, cases.uniforms(SAMPLES, len(given[0]))))
    c = [x.double() for x in given]
    exact = kernels.bsdf(preset)(theta_i.double(), c[0], phi.double(), *c[1:])
    error = (code.eval(own, theta_i, phi) - exact).abs() / exact.amax((0, 2), keepdim=True).clamp_min(1e-10)
    assert float(error.max()) < 2e-3
    assert float(error.median()) < 1e-5
    omega = torch.stack([theta_i, -phi], dim=-1).double()
    density = cases.proposal(preset, kind)(Context(c[0], 0.0, *c[1:])).log_prob(omega)
    gap = (torch.log(code.pdf(own, theta_i, phi).double()) - density).abs()
    gap = gap[theta_i.abs() < 1.5707]  # at the poles float32 and float64 hold different cosines off 0
    assert float(gap.quantile(0.999)) < 1e-2
    assert float(gap.median()) < 2e-4
