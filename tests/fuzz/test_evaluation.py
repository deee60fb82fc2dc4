"""BSDF, integrands and proposals evaluated anywhere: finite and of the right shape and dtype, or refused by name."""

from __future__ import annotations

from typing import Any

import torch
from hypothesis import assume, given
from hypothesis import strategies as st
from torch import Tensor

from dsfit import Context, DualScattering, Fiber, Integrand
from dsfit.proposals import (
    CauchyLobe,
    CosineHalf,
    FrontHalf,
    GaussianLobe,
    Lobe,
    Mixture,
    OffsetAzimuth,
    Product,
    Proposal,
    Scattered,
    SplitGaussianLobe,
    StructuredProposal,
    TransmittanceCosine,
    TruncatedGaussian,
    UniformAzimuth,
    WrappedGaussian,
    chapter_proposals,
)
from dsfit.scene import (
    ConstantScattering,
    EnvironmentLight,
    SlabScattering,
    SphereScattering,
    VonMisesFisherLights,
)
from tests.fuzz.common import anything, attempt, finite, fuzz, mostly_fine, numbers, refused, tensors, unit

BSDFS = {
    "black": DualScattering(Fiber.preset("black"), azimuthal="raw"),
    "simplified": DualScattering(Fiber.preset("brown"), azimuthal="simplified", convention="printed"),
    "elliptic": DualScattering(Fiber.preset("brown", eccentricity=1.1)),
    "table": DualScattering(Fiber.preset("blond"), precision="table"),
}
LIGHTS = {
    "furnace": None,
    "lobes": VonMisesFisherLights([[0.3, 0.2], [1.0, -2.0]], [1e6, 0.0], [1.0, 2.0]),
    "map": EnvironmentLight(torch.arange(24.0, dtype=torch.float64).reshape(2, 4, 3)),
}
PLACES = {
    "context": None,
    "constant": ConstantScattering(3.0, 0.2),
    "slab": SlabScattering(1.0, 0.0, 4.0),
    "sphere": SphereScattering(1.0, 8.0, (0.0, 0.0, 1.0), aligned=True),
}
angles = mostly_fine | anything


@fuzz(40)
@given(st.sampled_from(list(BSDFS)), angles, angles, angles, mostly_fine | anything, st.none() | unit | anything)
def test_bsdf(name: str, theta_i: Any, theta_r: Any, phi: Any, n: Any, v: Any) -> None:
    bsdf = BSDFS[name]
    value = attempt(bsdf, theta_i, theta_r, phi, n, v)
    if not refused(value):
        finite(value)
        assert bool((value >= 0).all())
        shapes = [torch.as_tensor(x).shape for x in (theta_i, theta_r, phi, n, v) if x is not None]
        assert value.shape == (*torch.broadcast_shapes(*shapes), 3)


def _inclination(limit: float) -> st.SearchStrategy[float]:
    return st.sampled_from([0.0, limit, -limit]) | st.floats(-limit, limit)


HALF_PI = torch.pi / 2
contexts = st.tuples(
    _inclination(HALF_PI), st.floats(-4, 4), st.sampled_from([0.0, 1e-300, 1e4]) | st.floats(0, 50), st.none() | unit
)


def make(one: tuple[float, float, float, float | None], dtype: torch.dtype = torch.float64) -> Context:
    theta_r, phi_r, n, v = one
    limit = torch.tensor(HALF_PI, dtype=dtype).item()
    return Context(max(-limit, min(limit, theta_r)), phi_r, n, v, dtype=dtype)


fibres = st.fixed_dictionaries(
    {},
    optional={
        "sigma_a": st.lists(st.sampled_from([0.0, 1e-300, 1e4]) | st.floats(0, 20), min_size=1, max_size=3),
        "eta": st.sampled_from([1.0001, 1.01, 3.0, 10.0]) | st.floats(1.05, 3),
        "alpha": st.lists(st.floats(-1.5, 1.5), min_size=3, max_size=3),
        "beta": st.lists(st.sampled_from([1e-4, 10.0]) | st.floats(1e-3, 2), min_size=3, max_size=3),
        "caustic_width": st.sampled_from([1e-4, 3.1]) | st.floats(0.01, 3.0),
        "glint_scale": st.sampled_from([0.0, 100.0]) | st.floats(0, 3),
        "caustic_fade": st.floats(1e-3, 10),
        "caustic_max_offset": unit,
        "gamma_tt": st.sampled_from([1e-3, 50.0]) | st.floats(0.01, 4),
    },
)


models = st.sampled_from(["marschner", "raw", "simplified"])
named = st.sampled_from(["consistent", "printed"])
FLOATS = st.sampled_from([torch.float64, torch.float32])


@fuzz(60)
@given(
    fibres,
    models,
    named,
    st.lists(st.tuples(_inclination(HALF_PI), st.floats(-3.2, 3.2)), min_size=1, max_size=4),
    st.none() | st.floats(-3.2, 3.2),
    FLOATS,
)
def test_azimuths_of_extreme_fibres(
    fields: dict[str, Any], model: str, convention: str, points: list[tuple[float, float]], phi_h: Any, dtype: Any
) -> None:
    bsdf = DualScattering(Fiber.preset("blond", **fields), azimuthal=model, convention=convention)
    diff, phi = torch.tensor(points, dtype=dtype).unbind(-1)
    for law in (bsdf.azimuthal, bsdf.azimuthal_scattered):
        value = law(diff, phi)
        finite(value)
        assert value.dtype == dtype and value.shape == (len(points), 3, bsdf.channels) and bool((value >= 0).all())
        mirrored = law(-diff, -phi)
        assert bool(((value - mirrored).abs() <= 1e-12 * value.abs().amax()).all())


@fuzz(2)
@given(
    fibres,
    models,
    named,
    contexts,
    st.lists(st.tuples(_inclination(HALF_PI), st.floats(-3.2, 3.2)), min_size=1, max_size=5),
    FLOATS,
)
def test_extreme_fibres_are_finite_and_even(
    fields: dict[str, Any], model: str, convention: str, one: Any, omega: list[tuple[float, float]], dtype: Any
) -> None:
    bsdf = DualScattering(Fiber.preset("blond", **fields), azimuthal=model, convention=convention)
    context = make(one, dtype)
    theta, phi = torch.tensor(omega, dtype=dtype).unbind(-1)
    limit = torch.tensor(HALF_PI, dtype=dtype)
    theta = theta.clamp(-limit, limit)
    value = bsdf(theta, context.theta_r, phi, context.n, context.v)
    finite(value)
    assert value.dtype == dtype and value.shape == (len(omega), bsdf.channels) and bool((value >= 0).all())
    mirrored = bsdf(theta, context.theta_r, -phi, context.n, context.v)
    assert bool(((value - mirrored).abs() <= 1e-12 * value.abs().amax()).all())


@fuzz(60)
@given(
    st.sampled_from(list(BSDFS)),
    st.sampled_from(list(LIGHTS)),
    st.sampled_from(list(PLACES)),
    contexts,
    tensors(numbers),
)
def test_integrand_at_any_tensor(bsdf: str, light: str, place: str, one: Any, omega: Tensor) -> None:
    integrand = Integrand(BSDFS[bsdf], LIGHTS[light], PLACES[place])
    value = attempt(integrand, omega, make(one))
    if not refused(value):
        finite(value)
        assert value.shape == (*omega.shape[:-1], 3) and omega.shape[-1] == 2 and bool((value >= 0).all())


def _all() -> dict[str, Proposal]:
    bsdf = BSDFS["table"]
    found = dict(chapter_proposals(bsdf))
    found |= {f"light {k}": light.proposal() for k, light in LIGHTS.items() if light is not None}
    found["mixture"] = Mixture([found["R"], found["back"], found["front"]], [1.0, 2.0, 1e-300])
    context = Context(torch.tensor([0.2, -1.0], dtype=torch.float64), 0.0, 3.0, 0.5)
    found["structured"] = StructuredProposal(bsdf, context)
    azimuths = {
        "cos": CosineHalf(),
        "wrapped": WrappedGaussian(1e-3),
        "truncated": TruncatedGaussian(50.0),
        "scattered": Scattered(WrappedGaussian(0.3)),
        "front": FrontHalf(),
        "TRT": OffsetAzimuth("TRT", 1.3),
    }
    for k, azimuth in azimuths.items():
        found[f"narrow {k}"] = Product(GaussianLobe(1.5, 2e-5), azimuth)
    laws = {
        "cauchy": CauchyLobe(-1.5, 2e-5),
        "split": SplitGaussianLobe(1.5, 2e-5, 90.0),
        "cosine": TransmittanceCosine(),
    }
    for k, law in laws.items():
        found[f"law {k}"] = Product(law, UniformAzimuth())
    found["lobe"] = Lobe("TT", 0.0, 99.0, 99.0, beta_f=0.1)
    return found


PROPOSALS = _all()


@fuzz(200)
@given(st.sampled_from(list(PROPOSALS)), contexts, tensors(numbers), tensors(unit))
def test_proposal_at_any_tensor(name: str, one: Any, omega: Tensor, u: Tensor) -> None:
    distribution = PROPOSALS[name](make(one))
    value = attempt(distribution.log_prob, omega)
    if not refused(value):
        assert value.shape == omega.shape[:-1] and not bool(value.isnan().any()) and bool((value < torch.inf).all())
    drawn = attempt(distribution.sample_with_log_prob, u)
    if not refused(drawn):
        direction, density = drawn
        finite(direction, density)
        assert direction.shape == (*u.shape[:-1], 2) and density.shape == u.shape[:-1]
        limit = HALF_PI * (1 + 4 * torch.finfo(direction.dtype).eps)
        assert bool((direction[..., 0].abs() <= limit).all()) and bool((direction[..., 1].abs() <= 3.1416).all())


@fuzz(150)
@given(
    st.sampled_from(list(PROPOSALS)),
    contexts,
    st.lists(unit, min_size=8, max_size=8),
    st.sampled_from([torch.float64, torch.float32]),
)
def test_every_uniform_gives_a_direction_with_its_density(name: str, one: Any, u: list[float], dtype: Any) -> None:
    context = make(one, dtype)
    distribution = PROPOSALS[name](context)
    assume(distribution.dimension <= 4)
    numbers = torch.tensor(u, dtype=dtype).reshape(2, 4)
    direction, density = distribution.sample_with_log_prob(numbers)
    finite(direction, density)
    assert direction.dtype == dtype and density.dtype == dtype
    again = distribution.log_prob(direction)
    finite(again)


@fuzz(80)
@given(
    st.sampled_from(list(PROPOSALS)),
    st.lists(contexts, min_size=1, max_size=3),
    st.lists(st.floats(0.001, 0.999), min_size=12, max_size=12),
)
def test_a_batch_is_the_same_as_a_loop(name: str, batch: list[Any], u: list[float]) -> None:
    proposal = PROPOSALS[name]
    singles = [make(one) for one in batch]
    context = Context(*(torch.stack([getattr(c, k) for c in singles]) for k in ("theta_r", "phi_r", "n", "v")))
    numbers = torch.tensor((u * 3)[: 4 * len(batch)], dtype=torch.float64).reshape(len(batch), 4)
    direction, density = proposal(context).sample_with_log_prob(numbers)
    for k, one in enumerate(singles):
        alone, own = proposal(one).sample_with_log_prob(numbers[k])
        torch.testing.assert_close(direction[k], alone, rtol=1e-9, atol=1e-9)
        torch.testing.assert_close(density[k], own, rtol=1e-6, atol=1e-6)


ROUND = [name for name in PROPOSALS if not name.startswith("light")]


@fuzz(80)
@given(st.sampled_from(ROUND), contexts, _inclination(HALF_PI), st.floats(-3.1, 3.1))
def test_densities_are_even_in_the_relative_azimuth(name: str, one: Any, theta: float, phi: float) -> None:
    context = make((one[0], 0.0, *one[2:]))
    omega = torch.tensor([[theta, phi], [theta, -phi]], dtype=torch.float64)
    a, b = PROPOSALS[name](context).log_prob(omega).tolist()
    assert a == b or abs(a - b) < 1e-6 * max(1.0, abs(a))


@fuzz(50)
@given(
    st.sampled_from(["consistent", "printed"]),
    contexts,
    st.lists(contexts, min_size=1, max_size=3),
    st.tuples(_inclination(1.5), st.floats(-3.1, 3.1)),
)
def test_a_batch_of_contexts_is_a_loop_for_the_integrand(
    convention: str, first: Any, rest: list[Any], omega: tuple[float, float]
) -> None:
    integrand = Integrand(BSDFS["table" if convention == "consistent" else "simplified"])
    singles = [make(one) for one in (first, *rest)]
    context = Context(*(torch.stack([getattr(c, k) for c in singles]) for k in ("theta_r", "phi_r", "n", "v")))
    direction = torch.tensor(omega, dtype=torch.float64)
    together = integrand(direction.expand(len(singles), 2), context)
    alone = torch.stack([integrand(direction, one) for one in singles])
    torch.testing.assert_close(together, alone, rtol=1e-9, atol=1e-300)
