"""Plans: what goes, that the error stays below the bound, and what a planned integrand refuses."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

import dsfit
from dsfit.bsdf.terms import Terms
from dsfit.experiment.methods import structured_start
from dsfit.scene import ConstantLight, ConstantScattering, SlabScattering, VonMisesFisherLights
from dsfit.scene.plan import ContextRange, Plan, plan

F64, DEG = torch.float64, math.pi / 180
VIEWS = torch.tensor([0.0, 45.0, 80.0], dtype=F64) * DEG
OMEGA = torch.tensor([[0.3, 2.0], [-0.7, -1.0], [1.1, 3.0], [0.0, 0.1]], dtype=F64)
BLOND = dsfit.DualScattering(dsfit.Fiber.preset("blond"), precision="table")
BLACK = dsfit.DualScattering(dsfit.Fiber.preset("black"))
BLACK_TABLE = BLACK.replace(precision="table")


def dropped(found: Plan) -> set[tuple[str, str]]:
    return {(d.half, d.name) for d in found.dropped}


def error_of(found: Plan, context: dsfit.Context, rtol: float = 1e-5) -> float:
    """Largest error of the planned integral in any channel, relative to it."""
    whole, kept = (dsfit.reference(x, context, rtol).value for x in (found.whole, found.integrand))
    return float(((whole - kept).abs() / kept).amax())


def test_nothing_to_drop_changes_nothing() -> None:
    integrand = dsfit.Integrand(BLOND)
    context = dsfit.Context(0.5, n=3.0, v=0.5)
    found = plan(integrand, context)
    assert found.terms == Terms() and found.dropped == () and found.bound == 0
    torch.testing.assert_close(found.integrand(OMEGA, context), integrand(OMEGA, context), rtol=0, atol=0)


@pytest.mark.parametrize(("n", "half"), [(0.0, "scattered"), (20.0, "direct")])
def test_a_share_of_zero_is_exact(n: float, half: str) -> None:
    """The half goes with tolerance 0; what is left is the same to the last bit."""
    integrand, context = dsfit.Integrand(BLOND), dsfit.Context(VIEWS, n=n)
    found = plan(integrand, context)
    assert getattr(found.terms, half) == () and found.bound == 0
    assert all(d.bound == 0 and d.reason.startswith("v = ") for d in found.dropped if d.half == half)
    omega = OMEGA[:, None]
    torch.testing.assert_close(found.integrand(omega, context), integrand(omega, context), rtol=0, atol=0)


def test_no_back_scattering_is_exact() -> None:
    integrand = dsfit.Integrand(BLACK.replace(d_b=0.0))
    context = dsfit.Context(0.5, n=3.0, v=0.5)
    found = plan(integrand, context)
    assert dropped(found) == {("direct", "back"), ("scattered", "back")}
    torch.testing.assert_close(found.integrand(OMEGA, context), integrand(OMEGA, context), rtol=0, atol=0)


def test_grey_is_exact() -> None:
    fiber = dsfit.Fiber.preset("blond", sigma_a=torch.full((3,), 0.1, dtype=F64))
    integrand = dsfit.Integrand(dsfit.DualScattering(fiber), ConstantLight([1.0, 0.5, 2.0]))
    context = dsfit.Context(0.5, n=3.0, v=0.5)
    found = plan(integrand, context)
    assert found.terms.grey and found.integrand.channels == 3
    torch.testing.assert_close(found.integrand(OMEGA, context), integrand(OMEGA, context), rtol=2e-14, atol=1e-17)


def test_black_light_and_no_density() -> None:
    everything = plan(dsfit.Integrand(BLACK, ConstantLight(0.0)), dsfit.Context(0.5))
    assert everything.kept == () and bool((everything.integrand(OMEGA, dsfit.Context(0.5)) == 0).all())
    assert "nothing" in str(everything)
    no_d_f = plan(dsfit.Integrand(BLACK.replace(d_f=0.0)), dsfit.Context(0.5, n=3.0))
    assert no_d_f.kept == ()
    empty = SlabScattering(2.0, 0.5, 0.0)
    assert plan(dsfit.Integrand(BLACK, scattering=empty), dsfit.Context(0.5, n=3.0)).terms.scattered == ()


def test_the_fade_of_the_glint() -> None:
    """eta >= 2 + fade: the treatment changes nothing anywhere, and goes without tolerance."""
    bsdf = dsfit.DualScattering(dsfit.Fiber.preset("blond", eta=2.4))
    integrand, context = dsfit.Integrand(bsdf), dsfit.Context(0.5)
    found = plan(integrand, context)
    assert not found.terms.glint and ("both", "glint") in dropped(found)
    torch.testing.assert_close(found.integrand(OMEGA, context), integrand(OMEGA, context), rtol=1e-13, atol=0)


def test_black_hair_loses_what_enters_it() -> None:
    """TRT, back scattering and most of the scattered light of black hair go within 1 %, and R never does."""
    integrand = dsfit.Integrand(BLACK_TABLE)
    n, v = torch.tensor([[0.0, 1.0], [1.0, 0.4]], dtype=F64)
    context = dsfit.Context(VIEWS[:2], n=n, v=v)
    found = plan(integrand, context, 1e-2)
    assert {("direct", "TRT"), ("scattered", "TT"), ("scattered", "TRT")} <= dropped(found)
    assert ("direct", "R") in found.kept
    error = error_of(found, context)
    assert 0 < error <= found.bound <= 1e-2
    assert sum(d.bound for d in found.dropped) >= found.bound * (1 - 1e-12)


def test_deep_light_goes_by_its_transmittance() -> None:
    """a_f^20 of brown hair: all that is scattered goes although v is only 0.05."""
    brown = dsfit.DualScattering(dsfit.Fiber.preset("brown"), precision="table")
    context = dsfit.Context(VIEWS, n=20.0, v=0.05)
    found = plan(dsfit.Integrand(brown), context, 1e-6)
    assert found.terms.scattered == () and 0 < found.bound < 1e-6


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow), 2])
def test_error_stays_below_the_bound(seed: int) -> None:
    """Random fibres, contexts and tolerances: the true error of the integral, by quadrature, is below the bound."""
    g = torch.Generator().manual_seed(seed)
    x = torch.rand(8, generator=g, dtype=F64).tolist()
    fiber = dsfit.Fiber.preset("brown", sigma_a=[4 * x[0] ** 2, 8 * x[1]], eta=1.3 + 0.5 * x[2])
    bsdf = dsfit.DualScattering(fiber, d_b=x[3], azimuthal="simplified")
    context = dsfit.Context((2 * x[4] - 1) * 1.5, n=10 * x[5], v=x[6])
    light = ConstantLight([1.0, 3.0 * x[7]])
    for tolerance in (1e-2, 0.2):
        found = plan(dsfit.Integrand(bsdf, light), context, tolerance)
        assert found.bound <= tolerance
        assert error_of(found, context, 1e-4) <= found.bound + 2e-4


def test_lobes_of_light() -> None:
    """Under light that differs by direction the bound holds with the least and the largest radiance."""
    light = VonMisesFisherLights(torch.tensor([[0.3, 1.0]], dtype=F64), 4.0, [1.0, 2.0, 0.5], 0.2)
    context = dsfit.Context(0.5)
    found = plan(dsfit.Integrand(BLACK, light), context, 0.05)
    assert ("direct", "TRT") in dropped(found)
    assert error_of(found, context) <= found.bound <= 0.05


def test_a_range_of_contexts() -> None:
    """A plan for a range holds in it, and nowhere else."""
    found = plan(dsfit.Integrand(BLACK), ContextRange((-1.5, 1.5), (0.0, 0.0), (1.0, 1.0)), 1e-2)
    assert ("direct", "TRT") in dropped(found)
    for theta_r in (-1.3, 0.1):
        assert error_of(found, dsfit.Context(theta_r), 1e-4) <= found.bound + 1e-4
    with pytest.raises(dsfit.InputError, match="context.theta_r"):
        found.integrand(OMEGA, dsfit.Context(1.55))
    with pytest.raises(dsfit.InputError, match="context.n"):
        found.integrand(OMEGA, dsfit.Context(0.1, n=1.0, v=1.0))


def test_contexts_outside_the_plan_are_refused() -> None:
    context = dsfit.Context(VIEWS, n=20.0)
    found = plan(dsfit.Integrand(BLOND), context)
    found.integrand(OMEGA, context[1])
    found.integrand(OMEGA.to(torch.float32), context[2].to(torch.float32))  # rounding is inside
    for other in (dsfit.Context(0.3, n=20.0), dsfit.Context(0.0, n=21.0), dsfit.Context(0.0, n=20.0, v=0.5)):
        with pytest.raises(dsfit.InputError, match="plan"):
            found.integrand(OMEGA, other)
    # where scattering does not ask the context, only theta_r counts
    fixed = plan(dsfit.Integrand(BLOND, scattering=ConstantScattering(20.0, 0.0)), context)
    fixed.integrand(OMEGA, dsfit.Context(0.0, n=3.0))


def test_derivatives_are_kept_or_refused() -> None:
    """A share of 0 still has a derivative: it is kept if asked for in time, and refused afterwards."""
    v = torch.zeros((), dtype=F64, requires_grad=True)
    lit = dsfit.Context(0.5, n=3.0, v=v)
    integrand = dsfit.Integrand(BLOND)
    kept = plan(integrand, lit)
    assert kept.terms.direct == Terms().direct
    slope = torch.autograd.grad(kept.integrand(OMEGA, lit).sum(), v)[0]
    expected = torch.autograd.grad(integrand(OMEGA, lit).sum(), v)[0]
    torch.testing.assert_close(slope, expected, rtol=0, atol=0)
    late = plan(integrand, dsfit.Context(0.5, n=3.0, v=0.0))
    with pytest.raises(dsfit.InputError, match="context.v"):
        late.integrand(OMEGA, lit)
    d_b = torch.zeros((), dtype=F64, requires_grad=True)
    open_back = plan(dsfit.Integrand(dsfit.DualScattering(BLACK.fiber, d_b=d_b)), dsfit.Context(0.5), 0.1)
    assert "back" in open_back.terms.direct and open_back.limits is not None
    sigma_a = torch.full((3,), 5.0, dtype=F64, requires_grad=True)
    fiber = dsfit.Fiber.preset("black", sigma_a=sigma_a)
    open_fiber = plan(dsfit.Integrand(dsfit.DualScattering(fiber)), dsfit.Context(0.5), 0.1)
    assert "TRT" in open_fiber.terms.direct and not open_fiber.terms.grey


def test_gradients_of_directions() -> None:
    """Derivatives of what is kept are those of the same terms without a plan."""
    context = dsfit.Context(0.5)
    found = plan(dsfit.Integrand(BLACK), context, 1e-2)
    plain = dsfit.Integrand(BLACK.replace(terms=found.terms))
    slopes: list[Tensor] = []
    for integrand in (found.integrand, plain):
        omega = OMEGA.clone().requires_grad_()
        slopes.append(torch.autograd.grad(integrand(omega, context).sum(), omega)[0])
    torch.testing.assert_close(slopes[0], slopes[1], rtol=0, atol=0)


def test_proposals_and_quadrature_follow() -> None:
    """No component for what went, and fewer nodes."""
    context = dsfit.Context(0.5)
    integrand = dsfit.Integrand(BLACK)
    found = plan(integrand, context, 1e-2)
    start = structured_start(found.integrand, context)
    assert start.names == (*found.components, "broad")  # type: ignore[attr-defined]
    whole, kept = (dsfit.quadrature_nodes(x, context) for x in (integrand, found.integrand))
    assert len(kept.weight) < 0.7 * len(whole.weight)
    g = torch.Generator().manual_seed(0)
    estimate = dsfit.estimate(found.integrand, [start], context, 4000, generator=g)
    value = dsfit.reference(found.integrand, context, 1e-5).value
    assert bool(((estimate.value - value).abs() <= 5 * estimate.standard_error).all())


def test_planning_again_starts_from_the_whole() -> None:
    context = dsfit.Context(0.5)
    first = plan(dsfit.Integrand(BLACK), context, 1e-2)
    assert plan(first.integrand, context).terms.direct == Terms().direct


def test_limits_are_said() -> None:
    """Where nothing is proven, exact zeros alone go, and the plan says why."""
    context = dsfit.Context(0.5)
    printed = plan(dsfit.Integrand(BLACK.replace(convention="printed")), context, 1e-2)
    assert printed.bound == 0 and "convention" in (printed.limits or "") and "exact zeros only" in str(printed)
    batch = dsfit.Fiber.preset("black", eta=torch.tensor([1.5, 1.6], dtype=F64))
    assert "batch" in (plan(dsfit.Integrand(dsfit.DualScattering(batch)), context, 1e-2).limits or "")
    eccentric = plan(dsfit.Integrand(dsfit.DualScattering(BLACK.fiber.replace(eccentricity=0.9))), context, 1e-2)
    assert ("direct", "TRT") in eccentric.kept  # its direct TRT is not bounded


def test_table_and_data() -> None:
    context = dsfit.Context(VIEWS)
    found = plan(dsfit.Integrand(BLACK), context, 1e-2)
    text, data = str(found), found.to_dict()
    assert "kept     direct R, TT" in text and "v = 1 everywhere" in text and "tolerance 0.01" in text
    assert data["kept"] == {"direct": list(found.terms.direct), "scattered": []}
    assert {(d["half"], d["term"]) for d in data["dropped"]} == dropped(found)
    assert data["bound"] == found.bound and data["even"] is True


@pytest.mark.parametrize(
    ("arguments", "field"),
    [
        ((None, dsfit.Context(0.1)), "integrand"),
        ((dsfit.Integrand(BLACK), None), "contexts"),
        ((dsfit.Integrand(BLACK), dsfit.Context(torch.zeros(0))), "contexts"),
        ((dsfit.Integrand(BLACK), dsfit.Context(0.1), -0.1), "tolerance"),
        ((dsfit.Integrand(BLACK), dsfit.Context(0.1), 1.0), "tolerance"),
        ((dsfit.Integrand(BLACK), dsfit.Context(0.1), math.nan), "tolerance"),
    ],
)
def test_bad_input(arguments: tuple[object, ...], field: str) -> None:
    with pytest.raises(dsfit.InputError, match=field):
        plan(*arguments)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "wrong", [{"theta_r": (1.0, 0.0)}, {"n": (-1.0, 2.0)}, {"v": (0.0, 1.5)}, {"n": (0.0, math.inf)}, {"v": 1}]
)
def test_ranges_that_are_none(wrong: dict[str, object]) -> None:
    with pytest.raises(dsfit.InputError, match="range"):
        ContextRange(**wrong)  # type: ignore[arg-type]


def test_light_along_the_tangent_is_even() -> None:
    """Lobes along the fibre's tangent leave the scene symmetric; quadrature of half the circle agrees."""
    axes = torch.tensor([[[1.0, 0.0, 0.0]], [[1.0, 1e-9, 0.0]]], dtype=F64)
    along, aside = (dsfit.Integrand(BLOND, VonMisesFisherLights(axis, 3.0, [1.0, 2.0, 1.0])) for axis in axes)
    assert along.is_even and not aside.is_even
    context = dsfit.Context(0.4, n=2.0, v=0.5)
    a, b = (dsfit.reference(x, context, 1e-5) for x in (along, aside))
    torch.testing.assert_close(a.value, b.value, rtol=2e-5, atol=0)
    assert a.evaluations < 0.7 * b.evaluations
