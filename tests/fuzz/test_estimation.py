"""Uniforms, heuristics, estimates, references, fits and materials with any arguments."""

from __future__ import annotations

import math
from typing import Any

import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

import dsfit
from dsfit import Context, DualScattering, Fiber, Integrand, Material
from dsfit.mis import heuristic, multi_sample, parse_allocation, split_counts
from dsfit.mis.estimate import Estimate
from dsfit.proposals import GaussianLobe, Mixture, Product, Proposal, UniformAzimuth, UniformSphere
from dsfit.random import uniforms
from tests.fuzz.common import anything, attempt, finite, fuzz, mostly_fine, numbers, refused, tensors, unit

BSDF = DualScattering(Fiber.preset("brown"), azimuthal="simplified", d_b=0.0)
INTEGRAND = Integrand(BSDF)
SPHERE = UniformSphere()
LOBE = Product(GaussianLobe(0.1, 0.3), UniformAzimuth())
MIX = Mixture([LOBE, SPHERE])


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(1)


counts = st.integers(-2, 9) | st.sampled_from([True, None, 1.5, math.nan, "3", 2**40, 10**30])


@fuzz(120)
@given(
    st.lists(counts, max_size=3) | counts,
    counts | st.sampled_from([21202]),
    st.sampled_from(["random", "sobol", "stratified", "x", None]),
    st.sampled_from([torch.float64, torch.float32, torch.float16, torch.int64, None]),
    st.booleans(),
)
def test_uniforms(shape: Any, dimension: Any, kind: Any, dtype: Any, seeded: bool) -> None:
    if isinstance(shape, list) and any(isinstance(n, int) and n > 9 for n in shape):
        shape = [10**30]
    u = attempt(uniforms, shape, dimension, generator=generator() if seeded else 3, kind=kind, dtype=dtype)
    if not refused(u):
        assert u.shape == (*shape, dimension) and u.dtype == dtype and bool(((u > 0) & (u < 1)).all())


names = st.sampled_from(["balance", "power", "maximum", "cutoff", "optimal"])
kinds = (
    names
    | st.sampled_from([None, "", 3, [], {}])
    | st.fixed_dictionaries(
        {"kind": names}, optional={"beta": anything, "alpha": anything, "rcond": anything, "x": anything}
    )
)
logs = st.sampled_from([-math.inf, 0.0, -1e308, -750.0, 700.0, 1e308]) | st.floats(-50, 50)


@fuzz(150)
@given(kinds, st.integers(1, 3), st.integers(0, 4), st.data())
def test_heuristics(kind: Any, strategies: int, points: int, data: st.DataObject) -> None:
    rule = attempt(heuristic, kind)
    if refused(rule):
        return
    flat = data.draw(st.lists(logs, min_size=strategies * points, max_size=strategies * points))
    log_p = torch.tensor(flat, dtype=torch.float64).reshape(strategies, points)
    shares = data.draw(st.lists(st.sampled_from([0.0, 1.0, 1e-300, 1e300]) | numbers, max_size=4))
    weights = attempt(rule.weights, log_p, torch.tensor(shares, dtype=torch.float64))
    if not refused(weights):
        finite(weights)
        alive = ((log_p > -math.inf) & (torch.tensor(shares) > 0)[:, None]).any(0)
        total = weights.sum(0)
        assert bool((total[~alive] == 0).all()) and bool(((total[alive] - 1).abs() < 1e-9).all())


@fuzz(120)
@given(
    st.sampled_from(["equal", "optimal", "proportional", "x"])
    | anything
    | st.lists(st.integers(-1, 9), max_size=3)
    | st.lists(unit, max_size=3)
    | st.fixed_dictionaries(
        {"kind": st.sampled_from(["equal", "optimal", "proportional"])},
        optional={"weights": anything, "pilot": anything | counts, "costs": anything, "minimum": anything},
    ),
    st.integers(1, 3),
    st.integers(1, 20),
)
def test_allocations(allocation: Any, strategies: int, samples: int) -> None:
    fractions = attempt(parse_allocation, allocation, strategies, samples)
    if isinstance(fractions, list):
        assert len(fractions) == strategies and abs(sum(fractions) - 1) < 1e-9
        split = attempt(split_counts, samples, fractions)
        assert refused(split) or sum(split) == samples


class Strange(Proposal):
    """A distribution that returns given numbers, whatever is asked."""

    def __init__(self, theta: float, log_prob: float) -> None:
        super().__init__()
        self.theta, self.value = theta, log_prob

    def forward(self, context: Context) -> Any:
        outer = self

        class Law:
            dimension, batch_shape = 1, context.batch_shape

            def log_prob(self, omega: Tensor) -> Tensor:
                return torch.full(omega.shape[:-1], outer.value, dtype=torch.float64)

            def sample(self, u: Tensor) -> Tensor:
                return torch.full((*u.shape[:-1], 2), outer.theta, dtype=torch.float64)

            def sample_with_log_prob(self, u: Tensor) -> tuple[Tensor, Tensor]:
                omega = self.sample(u)
                return omega, self.log_prob(omega)

        return Law()


batches = st.sampled_from(
    [
        0.3,
        torch.tensor([0.1, 1.5], dtype=torch.float64),
        torch.empty(0, dtype=torch.float64),
        torch.tensor([[0.1], [0.2]], dtype=torch.float32),
    ]
)
proposals = st.sampled_from(
    [SPHERE, LOBE, MIX, [SPHERE, LOBE], [LOBE, SPHERE, MIX], [], None, 3, [None], "x"]
) | st.builds(Strange, numbers, numbers)


@fuzz(100)
@given(
    proposals,
    batches,
    counts | st.integers(1, 40),
    kinds,
    st.sampled_from(["multi", "one", "x"]),
    st.sampled_from(["equal", "optimal", [1, 1], {"kind": "proportional", "weights": [1.0, 0.0]}, None, 3]),
    st.sampled_from(["random", "sobol", "stratified", None]),
    counts | st.just(16),
    counts | st.just(65536),
)
def test_estimate(
    strategies: Any,
    theta_r: Any,
    samples: Any,
    kind: Any,
    model: Any,
    allocation: Any,
    points: Any,
    replicates: Any,
    chunk: Any,
) -> None:
    if isinstance(samples, int) and samples > 100:
        samples = 0
    context = Context(theta_r)
    found = attempt(
        dsfit.estimate,
        INTEGRAND,
        strategies,
        context,
        samples,
        kind,
        generator=generator(),
        model=model,
        allocation=allocation,
        uniforms=points,
        replicates=replicates,
        chunk=chunk,
    )
    if not refused(found):
        assert isinstance(found, Estimate) and found.value.shape == (*context.batch_shape, 3)
        finite(found.value)
        assert found.value.dtype == context.dtype and found.samples <= samples
        assert bool((found.standard_error >= 0).logical_or(found.standard_error.isnan()).all())


values = st.sampled_from([0.0, 1.0, math.nan, math.inf, -1.0, 1e300, 1e-300]) | numbers


@fuzz(50)
@given(values, st.integers(0, 2), st.sampled_from([torch.float64, torch.float32]))
def test_estimates_of_strange_integrands(value: float, channels: int, dtype: torch.dtype) -> None:
    def integrand(omega: Tensor, context: Context) -> Tensor:
        return torch.full((*omega.shape[:-1], channels), value, dtype=torch.float64).to(dtype)

    for strategies, kind in (([SPHERE, LOBE], "balance"), (SPHERE, "power"), ([SPHERE, LOBE], "optimal")):
        found = attempt(
            dsfit.estimate, integrand, strategies, Context(0.1, dtype=dtype), 16, kind, generator=generator()
        )
        if not refused(found):
            finite(found.value)


@fuzz(10)
@given(
    st.sampled_from([1e-2, 1e-3, 0.9]) | anything,
    batches,
    st.sampled_from([INTEGRAND, None, 3, SPHERE]),
    st.sampled_from([SPHERE, MIX, None, INTEGRAND]),
    counts | st.just(20_000),
)
def test_reference_nodes_and_excess(rtol: Any, theta_r: Any, integrand: Any, proposal: Any, most: Any) -> None:
    context = Context(theta_r)
    found = attempt(
        dsfit.reference, integrand, context, rtol, max_evaluations=min(most, 20_000) if isinstance(most, int) else most
    )
    if not refused(found):
        finite(found.value, found.error, found.m_star)
        assert found.value.shape == (*context.batch_shape, 3) and found.m_star.shape == context.batch_shape
    nodes = attempt(dsfit.quadrature_nodes, integrand, context, rtol)
    if not refused(nodes):
        finite(nodes.omega, nodes.weight, nodes.value)
    if context.batch_shape.numel() < 2:
        gap = attempt(dsfit.excess, integrand, proposal, context, rtol, max_evaluations=20_000)
        if not refused(gap):
            finite(gap.value, gap.largest_weight, gap.mass)
            assert gap.value.shape == context.batch_shape


CONTEXT = Context(0.3)
NODES = dsfit.quadrature_nodes(INTEGRAND, CONTEXT, 1e-2)
options = st.fixed_dictionaries(
    {},
    optional={
        "objective": st.sampled_from(["excess", "forward_kl", "variance_cost", "x", None]),
        "solver": st.sampled_from(["torch.adam", "torch.lbfgs", "x", None]),
        "starts": counts.filter(lambda n: not isinstance(n, int) or n < 4),
        "jitter": mostly_fine | st.just("x"),
        "seed": counts.filter(lambda n: n != 2**40),
        "tolerance": mostly_fine,
        "max_seconds": mostly_fine,
        "weights": mostly_fine,
        "jacobian": st.sampled_from(["auto", "own", "reverse", "forward", "x", None]),
        "nonsense": st.just(1),
    },
)
nodesets = st.sampled_from(
    [
        NODES,
        NODES,
        None,
        3,
        (),
        [NODES],
        (NODES.omega, NODES.weight),
        (NODES.omega, NODES.weight[:5], NODES.value),
        (NODES.omega, -NODES.weight, NODES.value),
        (NODES.omega, NODES.weight, NODES.value * math.nan),
        (NODES.omega, NODES.weight, NODES.value * 0),
    ]
)


@fuzz(40)
@given(st.sampled_from([LOBE, MIX, LOBE, MIX, SPHERE, None, INTEGRAND]), nodesets, options)
def test_fit(proposal: Any, nodes: Any, extra: dict[str, Any]) -> None:
    known = {"solver": "torch.lbfgs", "max_steps": 1, "rtol": 1e-2}
    found = attempt(dsfit.fit, proposal, INTEGRAND, CONTEXT, nodes=nodes, **{**known, **extra})
    if not refused(found):
        assert math.isfinite(found.excess) and math.isfinite(found.largest_weight)
        finite(*found.proposal.parameters())


@fuzz(100)
@given(tensors(numbers), tensors(unit), tensors(numbers), st.booleans(), mostly_fine | anything)
def test_material(vector: Any, u: Any, other: Any, normalise: bool, n: Any) -> None:
    if normalise and vector.is_floating_point() and vector.ndim and vector.shape[-1] == 3:
        vector = torch.nn.functional.normalize(vector.nan_to_num(1.0, 1.0, 1.0).clamp(-10, 10), dim=-1)
        other = vector.roll(1, -1)
    material = attempt(Material, BSDF, MIX, n)
    if refused(material):
        return
    for call in (material.f, material.f_cos, material.pdf):
        value = attempt(call, vector, other)
        if not refused(value):
            finite(value)
    drawn = attempt(material.sample_f, vector, u)
    if not refused(drawn):
        finite(drawn.f, drawn.wi, drawn.pdf)


@fuzz(40)
@given(st.lists(tensors(unit), max_size=2), kinds)
def test_multi_sample(u: list[Tensor], kind: Any) -> None:
    laws = [SPHERE(CONTEXT), LOBE(CONTEXT)]
    value = attempt(multi_sample, INTEGRAND, laws, CONTEXT, u, kind)
    if not refused(value):
        finite(value)
