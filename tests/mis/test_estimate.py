"""What `estimate` promises besides unbiasedness."""

from __future__ import annotations

import pytest
import torch
from scipy import stats
from torch import Tensor

from dsfit.context import Context
from dsfit.errors import InputError
from dsfit.mis import HEURISTICS, convergence, estimate, multi_sample, one_sample
from dsfit.proposals.base import Distribution
from dsfit.random import KINDS, uniforms
from tests.mis.toys import Lobe, Sphere, SphereDistribution, TwoLobes, contexts, generator

PAIR = [Lobe(6.0), Sphere()]


def run(samples: int = 640, seed: int = 0, context: Context | None = None, proposals: object = None, **options):
    context = contexts(5) if context is None else context
    proposals = PAIR if proposals is None else proposals
    integrand = options.pop("integrand", TwoLobes())
    return estimate(integrand, proposals, context, samples, generator=generator(seed), **options)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("model", ["multi", "one"])
def test_same_seed_same_numbers(kind: str, model: str) -> None:
    first, again, other = (run(seed=s, uniforms=kind, model=model) for s in (1, 1, 2))
    assert torch.equal(first.value, again.value) and torch.equal(first.standard_error, again.standard_error)
    assert torch.equal(first.consistency_p_value, again.consistency_p_value)
    assert not torch.equal(first.value, other.value)


@pytest.mark.parametrize("shape", [(), (1,), (3,), (2, 3)])
@pytest.mark.parametrize("heuristic", ["balance", "optimal"])
@pytest.mark.parametrize("kind", ["random", "sobol"])
def test_shapes(shape: tuple[int, ...], heuristic: str, kind: str) -> None:
    context = Context(torch.full(shape, 0.3, dtype=torch.float64))
    result = run(context=context, heuristic=heuristic, uniforms=kind, samples=320)
    assert result.value.shape == result.standard_error.shape == result.variance.shape == (*shape, 3)
    assert result.largest_weight.shape == result.consistency_p_value.shape == shape
    assert result.samples == 320 and result.evaluations == 320 * max(1, context.batch_shape.numel())
    assert result.fractions == (0.5, 0.5) and result.seconds > 0 and not result.value.requires_grad


@pytest.mark.parametrize("samples", [1, 2, 3, 17, 1001])
def test_any_number_of_independent_samples(samples: int) -> None:
    """Counts that do not divide into blocks; one sample has a value and no standard error."""
    seen = []

    def integrand(omega: Tensor, context: Context) -> Tensor:
        seen.append(omega[..., 0].numel())
        return torch.ones_like(omega[..., :1]) + omega[..., :1].square()

    result = run(samples, proposals=Sphere(), integrand=integrand)
    assert result.samples == samples and sum(seen) == result.evaluations == 5 * samples
    assert bool(torch.isfinite(result.value).all())
    assert bool(result.standard_error.isnan().all()) == (samples == 1)


@pytest.mark.parametrize("chunk", [1, 7, 50, 300, 10**6])
@pytest.mark.parametrize("kind", KINDS)
def test_chunks_bound_memory_and_change_nothing_that_matters(chunk: int, kind: str) -> None:
    seen = []

    class Spy(TwoLobes):
        def forward(self, omega: Tensor, context: Context) -> Tensor:
            seen.append(omega[..., 0].numel())
            return super().forward(omega, context)

    context = contexts(5)
    result = run(samples=640, chunk=chunk, uniforms=kind, integrand=Spy(), replicates=8)
    assert max(seen) <= max(chunk, 5) and sum(seen) == 640 * 5 == result.evaluations
    z = (result.value - TwoLobes().integral(context).detach()) / result.standard_error
    assert float(z.abs().max()) < 6
    if chunk >= 5 * 8 and kind != "stratified":  # as long as all blocks fit, pieces are those of one sequence
        torch.testing.assert_close(result.value, run(samples=640, uniforms=kind, replicates=8).value)


@pytest.mark.parametrize("heuristic", ["balance", "power", "maximum", "cutoff"])
def test_batch_equals_loop(heuristic: str) -> None:
    """Given the same uniforms, a batch of contexts gives exactly what one context at a time gives."""
    context, integrand = contexts(4), TwoLobes()
    u = [uniforms((50, 4), 2, generator=generator(s)) for s in range(2)]
    v = uniforms((80, 4), 3, generator=generator(9))
    c = torch.tensor([0.4, 0.6], dtype=torch.float64)
    batch = multi_sample(integrand, [p(context) for p in PAIR], context, u, heuristic)
    batch_one = one_sample(integrand, [p(context) for p in PAIR], context, v, c, heuristic)
    for k in range(4):
        alone, laws = context[k], [p(context[k]) for p in PAIR]
        torch.testing.assert_close(multi_sample(integrand, laws, alone, [x[:, k] for x in u], heuristic), batch[k])
        torch.testing.assert_close(one_sample(integrand, laws, alone, v[:, k], c, heuristic), batch_one[k])


def test_optimal_reaches_zero_variance_for_a_mixture_of_the_densities() -> None:
    """F in the span of the densities: alpha is exact and the error vanishes, where balance keeps one."""
    context, lobe, sphere = contexts(6), Lobe(6.0), Sphere()

    def integrand(omega: Tensor, context: Context) -> Tensor:
        return (3 * lobe(context).log_prob(omega).exp() - 0.2 * sphere(context).log_prob(omega).exp())[..., None]

    for model in ("multi", "one"):
        best = run(integrand=integrand, context=context, heuristic="optimal", model=model)
        balance = run(integrand=integrand, context=context, model=model)
        torch.testing.assert_close(best.value, torch.full_like(best.value, 2.8), rtol=1e-9, atol=0)
        assert float(best.standard_error.max()) < 1e-6 < float(balance.standard_error.min())


def test_optimal_survives_duplicate_strategies() -> None:
    context = contexts(200)
    result = run(context=context, proposals=[Lobe(6.0), Lobe(6.0), Sphere(), Sphere()], heuristic="optimal")
    single = run(context=context, proposals=[Lobe(6.0), Sphere()], heuristic="optimal")
    assert float(result.standard_error.mean()) < 1.2 * float(single.standard_error.mean())
    z = (result.value - TwoLobes().integral(context).detach()) / result.standard_error
    assert 0.8 < float(z.square().mean().sqrt()) < 1.25


def test_sobol_converges_faster() -> None:
    context, integrand = contexts(3), TwoLobes()
    slopes = {}
    for kind in KINDS:
        curve = convergence(
            integrand, PAIR, context, [512, 8192], 12, integrand.integral(context).detach(),
            generator=generator(3), uniforms=kind, replicates=4, test=False,
        )  # fmt: skip
        assert curve.samples.tolist() == [512, 8192] and curve.error.shape == (2, 3)
        assert bool((curve.low <= curve.error).all() and (curve.error <= curve.high).all())
        assert bool((curve.bias <= curve.error).all() and (curve.seconds > 0).all()) and len(curve.estimates) == 2
        slopes[kind] = float(torch.log(curve.error[1] / curve.error[0]).mean() / torch.log(torch.tensor(16.0)))
    assert slopes["sobol"] < -0.75 and abs(slopes["random"] + 0.5) < 0.12


def test_convergence_interval_covers_the_true_error() -> None:
    """Relative RMSE of 400 repeats of 40: the 95 % interval holds the error known from theory most of the time."""
    context, integrand = contexts(60), TwoLobes()
    truth = integrand.integral(context).detach()
    many = run(2**16, context=context, seed=8)
    exact = (many.variance.sum(dim=-1) / 200).sqrt() / truth.norm(dim=-1)
    curve = convergence(integrand, PAIR, context, [200], 40, truth, generator=generator(4), test=False)
    covered = ((curve.low[0] < exact) & (exact < curve.high[0])).double().mean()
    assert 0.85 < float(covered) <= 1.0


def test_float32() -> None:
    context = contexts(50, dtype=torch.float32)
    for heuristic in HEURISTICS:
        for model in ("multi", "one"):
            result = run(4096, context=context, integrand=TwoLobes(torch.float32), heuristic=heuristic, model=model)
            fields = (result.value, result.standard_error, result.largest_weight, result.consistency_p_value)
            assert all(field.dtype == torch.float32 and bool(torch.isfinite(field).all()) for field in fields)
            z = (result.value - TwoLobes(torch.float32).integral(context).detach()) / result.standard_error
            assert float(z.abs().max()) < 5


@pytest.mark.parametrize("model", ["multi", "one"])
@pytest.mark.parametrize("heuristic", ["balance", "power", "optimal"])
def test_gradients_flow_on_request(heuristic: str, model: str) -> None:
    """d/da of the estimate has the known derivative as its mean; the gradient by the proposal's exponent has mean 0."""
    context, integrand, lobe = contexts(64), TwoLobes(), Lobe(6.0)
    result = run(
        128, context=context, proposals=[lobe, Sphere()], integrand=integrand, heuristic=heuristic, model=model,
        differentiable=True, test=False,
    )  # fmt: skip
    by_a, by_k = [], []
    for value in result.value[:, 1]:
        grads = torch.autograd.grad(value, [integrand.a, lobe.exponent], retain_graph=True)
        by_a.append(grads[0][1])
        by_k.append(grads[1])
    by_a, by_k = torch.stack(by_a), torch.stack(by_k)
    truth = torch.autograd.grad(integrand.integral(context)[0, 1], integrand.a)[0][1]
    assert abs(float((by_a.mean() - truth) / (by_a.std() / 8))) < 4
    assert abs(float(by_k.mean() / (by_k.std() / 8))) < 4 and float(by_k.std()) > 1e-4


def test_gradient_by_finite_differences() -> None:
    context, u = contexts(2), [uniforms((20, 2), 2, generator=generator(s)) for s in range(2)]

    def value(exponent: Tensor) -> Tensor:
        lobe = Lobe(6.0)
        del lobe.exponent
        lobe.exponent = exponent
        return multi_sample(TwoLobes(), [lobe(context), Sphere()(context)], context, u, "power").sum()

    assert torch.autograd.gradcheck(value, torch.tensor(5.0, dtype=torch.float64, requires_grad=True), atol=1e-6)


class Scaled(Distribution):
    """Uniform sphere whose densities and the integrand are given far outside of what float64 can hold."""

    dimension = 2

    def __init__(self, context: Context, log_scale: float) -> None:
        self.sphere, self.log_scale, self.batch_shape = SphereDistribution(context), log_scale, context.batch_shape

    def sample_with_log_prob(self, u: Tensor) -> tuple[Tensor, Tensor]:
        omega = self.sphere.sample(u)
        return omega, self.log_prob(omega)

    def log_prob(self, omega: Tensor) -> Tensor:
        return self.sphere.log_prob(omega) + self.log_scale


@pytest.mark.parametrize("log_scale", [-1000.0, -690.8, 690.8, 1000.0])
def test_densities_from_1e_minus_434_to_1e434(log_scale: float) -> None:
    context, part = contexts(3), 690.8 if log_scale > 0 else -690.8
    exponent = torch.tensor(part, dtype=torch.float64)

    def integrand(omega: Tensor, context: Context) -> Tensor:
        return (1 + omega[..., :1].sin()) * torch.exp(exponent)

    def proposal(context: Context) -> Distribution:
        return Scaled(context, log_scale)

    result = run(context=context, integrand=integrand, proposals=[proposal, proposal])
    expected = 12.566 * torch.exp(torch.tensor(part - log_scale, dtype=torch.float64))
    assert bool((abs(result.value / expected - 1) < 0.2).all()) and bool(torch.isfinite(result.standard_error).all())


class Broken(Sphere):
    """Density wrong at some samples."""

    def __init__(self, bad: float) -> None:
        super().__init__()
        self.bad = bad

    def forward(self, context: Context) -> Distribution:
        law = super().forward(context)
        fine = law.log_prob
        law.log_prob = lambda omega: torch.where(omega[..., 0] > 1.0, self.bad, fine(omega))
        return law


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("model", ["multi", "one"])
def test_weights_that_are_not_finite_name_the_strategy(bad: float, model: str) -> None:
    with pytest.raises(InputError, match=r"proposals\[1\] \(Broken\)"):
        run(proposals=[Lobe(6.0), Broken(bad)] if bad != -float("inf") else [Broken(0.0), Broken(bad)], model=model)


def test_zero_density_with_zero_integrand_is_fine() -> None:
    def integrand(omega: Tensor, context: Context) -> Tensor:
        return torch.where(omega[..., :1] > 1.0, 0.0, 1.0)

    for model in ("multi", "one"):
        for heuristic in ("balance", "power", "maximum", "cutoff"):  # optimal needs densities that integrate to 1
            result = run(4096, proposals=[Broken(-float("inf")), Lobe(1.0)], integrand=integrand, heuristic=heuristic,
                         model=model)  # fmt: skip
            truth = 2 * torch.pi * (1 + torch.sin(torch.tensor(1.0)))
            assert float(((result.value - truth) / result.standard_error).abs().max()) < 4.5


def test_integrand_that_is_not_finite_or_misshaped() -> None:
    with pytest.raises(InputError, match="integrand at"):
        run(integrand=lambda omega, context: torch.where(omega[..., :1] > 1, torch.nan, 1.0))
    with pytest.raises(InputError, match="integrand"):
        run(integrand=lambda omega, context: torch.ones(7, 1))


def test_largest_weight_is_that_of_the_mixture() -> None:
    """Uniform sphere, F = 1 + (1 + mu)^6: sup F / (p I) is reached near mu = 1."""
    context = contexts(20)
    result = run(2**14, context=context, proposals=Sphere())
    axis = torch.stack([context.theta_r, context.phi_r], dim=-1)
    bound = TwoLobes()(axis, context).norm(dim=-1) * 12.566 / TwoLobes().integral(context).norm(dim=-1)
    assert bool((result.largest_weight < 1.25 * bound).all() and (result.largest_weight > 0.8 * bound).all())
    doubled = run(2**14, context=context, proposals=[Sphere(), Sphere()])
    torch.testing.assert_close(doubled.largest_weight, result.largest_weight, rtol=0.2, atol=0)


@pytest.mark.parametrize("kind", ["random", "sobol"])
@pytest.mark.parametrize("model", ["multi", "one"])
def test_consistency_p_values(kind: str, model: str) -> None:
    """Right densities: never too small. Without overlap or with one strategy: blocks. Without the test: nan."""
    context = contexts(400)
    three = [Lobe(6.0), Lobe(2.0, half=True, tangent=True), Sphere()]
    p = run(2048, context=context, proposals=three, uniforms=kind, model=model).consistency_p_value
    assert stats.kstest(p.numpy(), "uniform", alternative="greater").pvalue > 0.005
    alone = run(2048, context=context, proposals=Sphere(), uniforms=kind, model=model).consistency_p_value
    assert stats.kstest(alone.numpy(), "uniform", alternative="greater").pvalue > 0.005
    assert bool(run(uniforms=kind, model=model, test=False).consistency_p_value.isnan().all())


@pytest.mark.parametrize(
    ("options", "field"),
    [
        ({"samples": 0}, "samples"),
        ({"samples": 1}, "samples"),
        ({"samples": 20, "uniforms": "sobol"}, "samples"),
        ({"samples": 3, "heuristic": "optimal"}, "samples"),
        ({"heuristic": "balanced"}, "heuristic"),
        ({"model": "two"}, "model"),
        ({"uniforms": "halton"}, "uniforms"),
        ({"allocation": [-10, 650]}, "allocation"),
        ({"allocation": [10, 20]}, "allocation"),
        ({"allocation": [0.5, 0.4]}, "allocation"),
        ({"allocation": [1.0]}, "allocation"),
        ({"allocation": "best"}, "allocation"),
        ({"allocation": {"kind": "equal", "pilot": 3}}, "allocation 'equal' parameter"),
        ({"allocation": {"kind": "optimal", "pilot": 1}}, "allocation.pilot"),
        ({"chunk": 0}, "chunk"),
        ({"replicates": 0}, "replicates"),
        ({"replicates": 1, "uniforms": "sobol"}, "replicates"),
        ({"proposals": []}, "proposals"),
    ],
)
def test_bad_input(options: dict, field: str) -> None:
    with pytest.raises(InputError) as error:
        run(**options)
    assert error.value.field == field


def test_bad_generator_and_reference() -> None:
    with pytest.raises(InputError, match="generator"):
        estimate(TwoLobes(), PAIR, contexts(2), 10, generator=None)
    truth = torch.zeros(2, 3, dtype=torch.float64)
    with pytest.raises(InputError, match="reference"):
        convergence(TwoLobes(), PAIR, contexts(2), [10], 2, truth, generator=generator(0))
    with pytest.raises(InputError, match="repeats"):
        convergence(TwoLobes(), PAIR, contexts(2), [10], 1, truth, generator=generator(0))
