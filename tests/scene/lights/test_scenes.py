"""Emitters in an integrand: quadrature that follows their edges, MIS with the BSDF, symmetry, bounds, sums."""

from __future__ import annotations

import functools
import math

import pytest
import torch
from torch import Tensor

import dsfit
from dsfit.context import Context
from dsfit.errors import InputError
from dsfit.proposals import chapter_proposals
from dsfit.scene import (
    ConstantLight,
    EnvironmentLight,
    Integrand,
    RectangleLight,
    RingLight,
    SphereLight,
    SunLight,
    TotalLight,
    VonMisesFisherLights,
)
from dsfit.scene.planning.surroundings import radiance
from tests.scene.lights.cases import CONTEXT, EMITTERS, RGB, total, turn, uniforms

SEEN = Context(0.3, 0.4, 2.0, 0.3)


@functools.cache
def hair() -> dsfit.DualScattering:
    return dsfit.DualScattering(dsfit.Fiber.preset("blond"), precision="table")


def lit(name: str) -> Integrand:
    return Integrand(hair(), total() if name == "total" else EMITTERS[name]())


def some_slow(quick: tuple[str, ...], slow: tuple[str, ...]) -> list[object]:
    return [*quick, *(pytest.param(name, marks=pytest.mark.slow) for name in slow)]


@pytest.mark.parametrize(
    "name", some_slow(("sun", "ring"), ("sun at the tangent", "sphere", "rectangle close", "ring around", "total"))
)
def test_quadrature_converges_and_light_sampling_agrees(name: str) -> None:
    """The reference's own bound holds against a looser and a tighter one, and against Sobol points on the light."""
    integrand = lit(name)
    loose, tight = (dsfit.reference(integrand, SEEN, rtol, max_evaluations=1_000_000) for rtol in (1e-3, 1e-5))
    assert loose.converged and tight.converged
    assert bool(((loose.value - tight.value).abs() <= loose.error + tight.error).all())
    dist = integrand.light.proposal()(SEEN)
    points = torch.quasirandom.SobolEngine(dist.dimension, scramble=True, seed=5).draw(2**13, dtype=torch.float64)
    omega, log_prob = dist.sample_with_log_prob(points)
    found = (integrand(omega, SEEN) / torch.exp(log_prob)[:, None]).mean(0)
    assert bool(((found / tight.value - 1).abs() < (0.02 if name == "total" else 4e-3)).all()), found / tight.value


@pytest.mark.slow
def test_a_budget_that_does_not_suffice_is_said() -> None:
    found = dsfit.reference(lit("ring"), SEEN, 1e-9, max_evaluations=130_000)
    truth = dsfit.reference(lit("ring"), SEEN, 1e-6).value
    assert not found.converged and bool(((found.value - truth).abs() <= found.error + 1e-6 * truth).all())


@pytest.mark.parametrize("name", some_slow(("sphere", "total"), ("sun wide", "rectangle", "ring close")))
def test_mis_with_the_bsdf_is_unbiased(name: str) -> None:
    integrand = lit(name)
    truth = dsfit.reference(integrand, SEEN, 1e-4).value
    proposals = chapter_proposals(hair(), learnable=False)
    strategies = [integrand.light.proposal(), proposals["R"], proposals["TT"], proposals["front"], proposals["uniform"]]
    for heuristic in ("balance", "power"):
        g = torch.Generator().manual_seed(3)
        found = dsfit.estimate(integrand, strategies, SEEN, 20_000, heuristic=heuristic, generator=g, test=False)
        score = (found.value - truth) / found.standard_error
        assert float(score.abs().max()) < 4.5 and float((found.standard_error / truth).max()) < 0.1


def test_a_wrong_density_is_caught() -> None:
    """The rectangle's area over its squared distance taken for its solid angle: cosine left out."""
    integrand = lit("rectangle close")
    light = integrand.light
    truth = dsfit.reference(integrand, SEEN, 1e-4).value
    omega, log_prob = light.proposal()(SEEN).sample_with_log_prob(uniforms(20_000, 2))
    for wrong in (0.0, math.log(0.9)):
        values = integrand(omega, SEEN) / torch.exp(log_prob + wrong)[:, None]
        score = (values.mean(0) - truth) / (values.std(0) / math.sqrt(len(values)))
        assert (float(score.abs().max()) < 4.5) == (wrong == 0.0)


@pytest.mark.parametrize(
    ("light", "even"),
    [
        (SunLight([-1.0, 0, 0], 0.4, 1.0), True),
        (SunLight([-1.0, 1e-3, 0], 0.4, 1.0), False),
        (SphereLight([3.0, 0, 0], 1.0), True),
        (SphereLight([0.1, 0.3, 0], 1.0), True),
        (SphereLight([3.0, 1.0, 0], 1.0), False),
        (RectangleLight([2, -1, -1], [0, 2, 0], [0, 0, 2], two_sided=True), False),
        (RingLight([2, 0, 0], [1, 0, 0], 0.5, 1.0, two_sided=True), False),
        (TotalLight([SunLight([1.0, 0, 0], 0.4, 1.0), ConstantLight()]), True),
        (TotalLight([SunLight([0.0, 1, 0], 0.4, 1.0), ConstantLight()]), False),
    ],
)
def test_evenness_is_claimed_only_where_it_holds(light: dsfit.scene.Light, even: bool) -> None:
    integrand = Integrand(hair(), light)
    assert integrand.is_even == even
    if even:
        phi = torch.linspace(-3, 3, 40, dtype=torch.float64)
        theta = torch.linspace(-1.5, 1.5, 41, dtype=torch.float64)[:, None]
        one, other = (
            integrand(torch.stack(torch.broadcast_tensors(theta, SEEN.phi_r + s * phi), -1), SEEN) for s in (1, -1)
        )
        torch.testing.assert_close(one, other)


def test_a_position_that_a_derivative_is_asked_of_is_not_even() -> None:
    place = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    assert not Integrand(hair(), SphereLight([3.0, 0, 0], 1.0, position=place)).is_even


@pytest.mark.parametrize("name", [*EMITTERS, "total"])
def test_bounds_hold_and_a_plan_leaves_nothing_out_that_matters(name: str) -> None:
    light = total() if name == "total" else EMITTERS[name]()
    bounds = radiance(light)
    assert bounds is not None
    omega = torch.cat([light.proposal()(CONTEXT).sample(uniforms(500, 3)), uniforms(500, 2, seed=3) * 3 - 1.5])
    found = light(omega)
    assert bool((found >= bounds.low - 1e-15).all() and (found <= bounds.high * (1 + 1e-12)).all())
    assert bool((float(light.power()) <= bounds.total.mean() * (1 + 1e-3)).all())
    planned = dsfit.plan(Integrand(hair(), light), SEEN, 1e-2)
    assert planned.limits is None
    if name == "sphere":
        whole = dsfit.reference(Integrand(hair(), light), SEEN, 1e-5).value
        left = dsfit.reference(planned.integrand, SEEN, 1e-5).value
        assert bool(((left / whole - 1).abs() <= planned.bound + 1e-4).all())


# ---- sums ----


def test_a_total_is_the_sum_and_its_density_the_mixture() -> None:
    whole = total()
    context = Context(0.1)
    dist = whole.proposal()(context)
    shares = whole.parts()
    powers = torch.stack([light.power() for light in whole.lights])
    torch.testing.assert_close(shares, powers / powers.sum())
    omega, log_prob = dist.sample_with_log_prob(uniforms(4000, dist.dimension))
    parts = [light.proposal()(context).log_prob(omega).exp() for light in whole.lights]
    torch.testing.assert_close(log_prob.exp(), sum(s * p for s, p in zip(shares, parts, strict=True)))
    torch.testing.assert_close(whole(omega), sum(light(omega) for light in whole.lights))
    value = whole(omega).mean(-1) / log_prob.exp()
    assert abs(float(value.mean()) - float(whole.power())) < 4 * float(value.std()) / math.sqrt(4000) + 1e-9
    given = TotalLight(list(whole.lights), [0, 2, 3, 4, 1])
    torch.testing.assert_close(given.parts(), torch.tensor([0.0, 0.2, 0.3, 0.4, 0.1], dtype=torch.float64))


def test_shares_follow_the_power_at_each_point() -> None:
    """A rectangle seen from the front, from behind and from its plane, and a sphere that always shines."""
    sheet = RectangleLight([-1, -1, 0], [2, 0, 0], [0, 2, 0], 1.0)
    position = torch.tensor([[0, 0, 1.0], [0, 0, -1.0], [3, 0, 0]], dtype=torch.float64)
    frame = torch.stack([turn(k) for k in range(3)])
    for lights in ([sheet, SphereLight([0, 0, 5.0], 1.0)], [SphereLight([0, 0, 5.0], 1.0), sheet]):
        light = TotalLight(lights).placed(position, frame)
        shares = light.parts()
        k = lights.index(sheet)
        assert 0 < float(shares[0, k]) < 1 and bool((shares[1:, k] == 0).all()) and bool((shares[1:, 1 - k] == 1).all())
        dist = light.proposal()(Context(torch.zeros(3, dtype=torch.float64)))
        omega, log_prob = dist.sample_with_log_prob(uniforms(500, 3, 3))
        assert bool(log_prob.isfinite().all()) and bool((light(omega) > 0).all())


def test_nothing_arrives_from_any_light() -> None:
    light = TotalLight([RectangleLight([-1, -1, 1], [2, 0, 0], [0, 2, 0], 1.0), ConstantLight(0.0)])
    omega, log_prob = light.proposal()(CONTEXT).sample_with_log_prob(uniforms(100, 3))
    assert bool(log_prob.isfinite().all()) and not bool((light(omega) > 0).any())


def test_a_light_without_a_share_must_be_covered() -> None:
    sun, sky = SunLight([0.0, 1.0, 0.0], 0.1, 1.0), ConstantLight()
    assert float(TotalLight([sun, sky], [0, 1]).parts()[0]) == 0
    dist = TotalLight([sky, sun], [1, 0]).proposal()(CONTEXT)  # the last light is never drawn from
    u = uniforms(100, 3)
    u[:, 0] = 1 - 1e-16
    assert float((dist.sample_with_log_prob(u)[1] + math.log(4 * math.pi)).abs().max()) < 1e-12
    for others in ([sun, sky], [sun, VonMisesFisherLights([[0.0, 1.0]], 1e4)]):
        with pytest.raises(InputError, match="shares"):
            TotalLight(others, [1, 0])
    dark = torch.ones(4, 8, 3)
    for image, allowed in ((dark, True), (dark * (torch.arange(8) > 2)[:, None], False)):
        lights = [sun, EnvironmentLight(image)]
        if allowed:
            TotalLight(lights, [0, 1])
        else:
            with pytest.raises(InputError, match="shares"):
                TotalLight(lights, [0, 1])


@pytest.mark.parametrize(
    ("build", "field"),
    [
        (lambda: TotalLight([]), "lights"),
        (lambda: TotalLight([1.0]), "lights"),
        (lambda: TotalLight([ConstantLight([1, 2, 3]), ConstantLight([1, 2])]), "lights"),
        (lambda: TotalLight([ConstantLight()], [1, 2]), "shares"),
        (lambda: TotalLight([ConstantLight(), ConstantLight()], [1, -1]), "shares"),
        (lambda: TotalLight([ConstantLight(), ConstantLight()], [0, 0]), "shares"),
    ],
)
def test_bad_sums_are_named(build, field: str) -> None:
    with pytest.raises(InputError) as caught:
        build()
    assert caught.value.field == field


@pytest.mark.parametrize(
    ("light", "power"),
    [
        (VonMisesFisherLights([[0.3, 1.0], [0.1, 0.0]], [50.0, 5.0], [RGB, RGB], 0.1), None),
        (EnvironmentLight(torch.rand(16, 32, 3, generator=torch.Generator().manual_seed(0)) ** 4, 2.0), 5e-3),
    ],
)
def test_power_of_lights_without_an_edge(light: dsfit.scene.Light, power: float | None) -> None:
    dist = light.proposal()(CONTEXT)
    points = torch.quasirandom.SobolEngine(dist.dimension, scramble=True, seed=1).draw(2**14, dtype=torch.float64)
    omega, log_prob = dist.sample_with_log_prob(points)
    found: Tensor = (light(omega).mean(-1) / log_prob.exp()).mean()
    assert float(light.power()) == pytest.approx(float(found), rel=power or 1e-9)
