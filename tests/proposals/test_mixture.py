"""Mixtures: selection, weights, the defensive share, -inf, batches of weights, and input errors."""

from __future__ import annotations

import copy
import math

import pytest
import torch
from torch import Tensor
from torch.func import vmap

from dsfit.context import Context
from dsfit.errors import InputError
from dsfit.proposals import BackHalf, FrontHemisphere, Lobe, Mixture, Product, UniformInclination, UniformSphere
from dsfit.proposals.base import Distribution, Proposal
from dsfit.proposals.mixture import log_sum_exp
from dsfit.proposals.split_lobe import SplitGaussianLobe
from dsfit.proposals.uniform import UniformAzimuth
from tests.proposals.cases import ALPHA, BETA, BETA_F, GAMMA


def lobes() -> list[Proposal]:
    return [
        Lobe(name, ALPHA[name], BETA[name], GAMMA, beta_f=b) for name, b in (("R", None), ("TT", BETA_F), ("TRT", None))
    ]


def uniforms(*shape: int) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64).clamp(1e-9, 1 - 1e-9)


def test_log_sum_exp_handles_minus_infinity() -> None:
    x = torch.tensor([[0.3, -math.inf, -800.0], [-math.inf] * 3, [-1000.0, -1000.0, -1001.0]], dtype=torch.float64)
    x.requires_grad_()
    value = log_sum_exp(x)
    torch.testing.assert_close(value[[0, 2]], torch.logsumexp(x.detach(), dim=-1)[[0, 2]])
    assert value[1] == -math.inf
    (gradient,) = torch.autograd.grad(value[[0, 2]].sum() + torch.where(value[1].isfinite(), value[1], 0.0), x)
    assert gradient.isfinite().all()
    torch.testing.assert_close(gradient.sum(dim=-1), torch.tensor([1.0, 0.0, 1.0], dtype=torch.float64))


def test_density_is_the_weighted_sum() -> None:
    parts, weights = lobes(), [1.0, 3.0, 2.0]
    mixture = Mixture(parts, weights, defensive=0.1)
    context = Context([0.2, -1.0])
    omega = mixture(context).sample(uniforms(50, 2, 4))
    density = sum(
        w / 6 * 0.9 * torch.exp(part(context).log_prob(omega)) for w, part in zip(weights, parts, strict=True)
    )
    torch.testing.assert_close(torch.exp(mixture(context).log_prob(omega)), density + 0.1 / (4 * math.pi))
    torch.testing.assert_close(mixture.weights(), torch.tensor([0.15, 0.45, 0.3], dtype=torch.float64))


def test_defensive_share_bounds_the_density_below() -> None:
    mixture = Mixture(lobes(), defensive=0.05)
    omega = (uniforms(200, 2) - 0.5) * math.pi
    floor = math.log(0.05 / (4 * math.pi))
    assert float(mixture(Context(1.2)).log_prob(omega).detach().min()) >= floor - 1e-12


def test_selection_frequencies_and_order_of_samples() -> None:
    mixture = Mixture(lobes(), [1.0, 3.0, 2.0], defensive=0.1)
    distribution = mixture(Context(0.4))
    u = uniforms(20_000, distribution.dimension)
    choice = distribution.selected(u[:, 0])
    expected = torch.tensor([0.15, 0.45, 0.3, 0.1])
    frequency = torch.bincount(choice, minlength=4) / len(u)
    assert bool(((frequency - expected).abs() < 4 * torch.sqrt(expected * (1 - expected) / len(u))).all())
    omega = distribution.sample(u)
    for k, component in enumerate(distribution.components):
        own = choice == k
        torch.testing.assert_close(omega[own], component.sample(u[own, 1 : 1 + component.dimension]), rtol=0, atol=0)


class Opaque(Proposal):
    """A proposal whose distribution does not support `select`."""

    def __init__(self, inner: Proposal) -> None:
        super().__init__()
        self.inner = inner

    def forward(self, context: Context) -> Distribution:
        inner = self.inner(context)

        class Plain(Distribution):
            dimension, batch_shape = inner.dimension, inner.batch_shape
            sample_with_log_prob, log_prob = staticmethod(inner.sample_with_log_prob), staticmethod(inner.log_prob)

        return Plain()


def test_sampling_where_selected_equals_sampling_everywhere() -> None:
    context = Context(torch.linspace(-1.5, 1.5, 6, dtype=torch.float64).reshape(2, 3), 0.3, 2.0)
    selectable, opaque = Mixture(lobes()), Mixture([Opaque(part) for part in lobes()])
    distribution = selectable(context)
    u = uniforms(5, 4, 2, 3, distribution.dimension)
    everywhere = distribution._sample_everywhere(u, distribution.selected(u[..., 0]))
    torch.testing.assert_close(distribution.sample(u), everywhere, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(opaque(context).sample(u), everywhere, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(vmap(distribution.sample)(u), everywhere, rtol=1e-12, atol=1e-12)


def test_gradient_reaches_the_parameters_of_the_selected_component_only() -> None:
    mixture = Mixture(lobes(), defensive=0.0)
    distribution = mixture(Context([0.1, 0.9]))
    u = uniforms(30, 2, distribution.dimension)
    u[..., 0] = 0.1  # always the first
    gradients = torch.autograd.grad(
        distribution.sample(u).sum(), list(mixture.components.parameters()), allow_unused=True
    )
    names = [name for name, _ in mixture.components.named_parameters()]
    for name, gradient in zip(names, gradients, strict=True):
        moved = gradient is not None and bool(gradient.abs() > 1e-6)
        assert moved == name.startswith("0."), name


def test_components_without_support_somewhere() -> None:
    """Front and back half spheres: each is -inf where the other is not; no NaN in value or gradient."""
    halves = Mixture([FrontHemisphere(), Product(UniformInclination(), BackHalf())], [1.0, 3.0], defensive=0.0)
    omega = torch.tensor([[0.2, 0.1], [0.2, 3.0]], dtype=torch.float64)
    value = halves(Context(0.0, dtype=torch.float64)).log_prob(omega)
    torch.testing.assert_close(torch.exp(value), torch.tensor([0.75, 0.25], dtype=torch.float64) / (2 * math.pi))
    (gradient,) = torch.autograd.grad(value.sum(), halves.logits)
    torch.testing.assert_close(gradient, torch.tensor([0.5, -0.5], dtype=torch.float64))
    front = Mixture([FrontHemisphere()], defensive=0.0)
    nowhere = front(Context(0.0, dtype=torch.float64)).log_prob(omega[:1])
    assert nowhere.item() == -math.inf
    (gradient,) = torch.autograd.grad(nowhere.sum(), front.logits)
    assert gradient.isfinite().all()


def test_weights_per_context() -> None:
    weights = torch.tensor([[1.0, 3.0, 2.0], [5.0, 1.0, 1.0]], dtype=torch.float64)
    context = Context([0.2, -1.0])
    together = Mixture(lobes(), weights)(context)
    u = uniforms(40, 2, together.dimension)
    omega, log_prob = together.sample_with_log_prob(u)
    for k in range(2):
        one, one_log = Mixture(lobes(), weights[k])(context[k]).sample_with_log_prob(u[:, k])
        torch.testing.assert_close(one, omega[:, k], rtol=1e-12, atol=1e-12)
        torch.testing.assert_close(one_log, log_prob[:, k], rtol=1e-12, atol=1e-12)
    nested = Mixture([Mixture(lobes(), weights), UniformSphere()])(context)
    u = uniforms(40, 2, nested.dimension)
    everywhere = nested._sample_everywhere(u, nested.selected(u[..., 0]))
    torch.testing.assert_close(nested.sample(u), everywhere, rtol=1e-12, atol=1e-12)


def test_copies_are_independent() -> None:
    mixture = Mixture(lobes())
    copied = copy.deepcopy(mixture)
    with torch.no_grad():
        copied.logits.add_(torch.tensor([1.0, 0.0, 0.0]))
    assert not torch.equal(mixture.weights(), copied.weights())


def test_input_errors() -> None:
    with pytest.raises(InputError, match="components"):
        Mixture([])
    with pytest.raises(InputError, match="defensive"):
        Mixture(lobes(), defensive=1.0)
    with pytest.raises(InputError, match="weights"):
        Mixture(lobes(), [1.0, 2.0])
    with pytest.raises(InputError, match="weights"):
        Mixture(lobes(), [1.0, 0.0, 2.0])


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_masses_taken_together_are_those_of_each_lobe(batch: tuple[int, ...]) -> None:
    shapes = ((0.1, 0.2, 0.4), (-1.2, 0.01, 0.02), (0.7, 1.5, 0.1))  # the second mostly out of reach
    mixture = Mixture([Product(SplitGaussianLobe(*shape), UniformAzimuth()) for shape in shapes])
    context = Context(torch.linspace(-1.2, 1.4, math.prod(batch), dtype=torch.float64).reshape(batch))
    found = mixture(context)
    omega = found.sample(uniforms(50, *batch, found.dimension))
    alone = torch.stack(torch.broadcast_tensors(*(c.log_prob(omega) for c in found.components)), dim=-1)
    together = found.component_log_probs(omega)
    torch.testing.assert_close(together, alone, rtol=1e-13, atol=1e-13)
    leaf = mixture.components[1].longitudinal.mode
    for_both = [torch.autograd.grad(x[..., 1].sum(), leaf.raw, retain_graph=True)[0] for x in (together, alone)]
    torch.testing.assert_close(*for_both, rtol=1e-10, atol=1e-10)


def test_a_mixture_still_rejects_directions_that_are_not_finite() -> None:
    found = Mixture(lobes())(Context(0.2))
    with pytest.raises(InputError, match="finite"):
        found.log_prob(torch.tensor([[0.1, 0.2], [math.nan, 0.0]], dtype=torch.float64))


@pytest.mark.parametrize("value", [-math.inf, math.inf, math.nan])
def test_contexts_reject_numbers_that_are_not_finite(value: float) -> None:
    for field in ("theta_r", "phi_r", "n", "v"):
        with pytest.raises(InputError, match=f"context.{field}"):
            Context(**{"theta_r": 0.2, field: torch.tensor([0.1, value], dtype=torch.float64)})
