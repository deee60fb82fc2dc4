"""Derivatives of the BSDF and of proposals, the user's included, through fits, and of second order."""

from __future__ import annotations

import inspect
import math

import pytest
import torch

import dsfit
from dsfit.checks import gradients
from dsfit.checks.finding import judge
from dsfit.checks.gradients import functions as fn
from dsfit.checks.gradients.compare import check_derivative
from dsfit.checks.gradients.derivative_findings import proposal_checks
from dsfit.checks.gradients.formulas import check_formulas
from dsfit.checks.gradients.moment import learnable
from dsfit.checks.gradients.second_order import second_derivatives
from dsfit.checks.gradients.through_fit import derivatives_through_fit, fiber_family, nodes_of_family
from dsfit.checks.subject import Subject
from dsfit.experiment.check_schema import GradientsOptions
from dsfit.fit.objectives import Target
from dsfit.proposals import (
    CosineHalf,
    FromDensity,
    GaussianLobe,
    Lobe,
    Mixture,
    Product,
    ScatteredLobe,
    UniformAzimuth,
    UniformSphere,
    WrappedGaussian,
    chapter_proposals,
)
from dsfit.special import truncated_normal_icdf, truncated_normal_log_prob

FIBER = dsfit.Fiber.preset("blond")
CONTEXT = dsfit.Context(0.5, 0.2, 2.0)


def generator(seed: int = 1) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def target() -> Target:
    """Nodes of a light, as an integrand that takes no time."""
    u = torch.rand(300, 2, generator=generator(), dtype=torch.float64)
    omega = torch.stack([torch.asin(2 * u[:, 0] - 1), 2 * math.pi * u[:, 1] - math.pi], dim=-1)
    value = torch.exp(torch.cos(omega[:, 1]) - 2 * omega[:, 0] ** 2)
    return Target.from_nodes(CONTEXT, omega, torch.full((300,), 4 * math.pi / 300, dtype=torch.float64), value[:, None])


@pytest.mark.parametrize("model", ["marschner", "simplified"])
def test_bsdf_in_every_field_of_the_fiber(model: str) -> None:
    bsdf = dsfit.DualScattering(FIBER, azimuthal=model)
    seen = {}
    for check in fn.bsdf_in_fiber(bsdf, fn.directions(12, generator(2))):
        assert check.worst <= 1 and check.apart < 1e-10 and check.unclear_share <= 0.1, check.name
        assert check.forward is not None and check.sharpness < 1e-9
        seen[check.name] = float(check.numeric.abs().nan_to_num().max())
    unused = {"caustic_width", "glint_scale", "caustic_fade", "caustic_max_offset"} if model == "simplified" else set()
    assert set(seen) == set(FIBER.parameters()) and {name for name, size in seen.items() if size == 0} == unused


def test_a_fiber_at_the_end_of_its_ranges() -> None:
    """No absorption and no glint: nothing can be subtracted, so the derivatives are taken a little inside."""
    fiber = dsfit.Fiber.preset("nonabsorbing", glint_scale=0.0, caustic_max_offset=1.0)
    for check in fn.bsdf_in_fiber(dsfit.DualScattering(fiber), fn.directions(5, generator(2))):
        assert check.worst <= 1 and check.unclear_share <= 0.1, check.name


def test_bsdf_in_directions() -> None:
    bsdf = dsfit.DualScattering(FIBER, d_b=0.0)
    at = fn.directions(200, generator(3))
    at = {**at, "n": 0 * at["n"] + 1.0, "v": 0 * at["v"] + 0.5}

    class Direct(dsfit.DualScattering):
        """Without what takes the averages' seconds."""

        def __call__(self, theta_i, theta_r, phi, n=0.0, v=None, *, phi_h=None):  # noqa: ANN001, ANN204
            return n[..., None] ** 2 * v[..., None] * self.direct(theta_i, theta_r, phi)

    for check in fn.bsdf_in_directions(Direct(FIBER, d_b=0.0), at):
        assert check.worst <= 1 and check.apart < 1e-10 and check.unclear_share < 0.05, check.name
        assert float(check.numeric.abs().nan_to_num().max()) > 1e-3
    assert bsdf.channels == 3


@pytest.mark.slow
def test_bsdf_through_the_averages() -> None:
    bsdf = dsfit.DualScattering(FIBER)
    for check in fn.bsdf_in_averages(bsdf, fn.directions(4, generator(4)), 1, levels=4):
        assert check.worst <= 1 and check.apart < 1e-10 and check.unclear_share < 0.2, check.name


def proposals() -> dict[str, dsfit.proposals.Proposal]:
    lobes = chapter_proposals(FIBER)
    scattered = Product(ScatteredLobe(0.1, 0.2, 0.1), UniformAzimuth())
    return {
        "TT": lobes["TT"],
        "scattered TT": Lobe("TT", 0.1, 0.1, 0.5, beta_f=lambda context: 0.05 + 0.1 * torch.cos(context.theta_r)),
        "mixture of many": Mixture([*list(lobes.values())[:6], scattered]),
        "nothing to learn": UniformSphere(),
    }


@pytest.mark.parametrize("name", proposals())
def test_proposals(name: str) -> None:
    proposal = learnable(proposals()[name])
    count = 0
    for function, checks in proposal_checks(proposal, target(), 12, generator(5)):
        for check in checks:
            count += 1
            assert check.worst <= 1 and check.apart < 1e-10, (function, check.name, check.worst)
            assert check.unclear_share < 0.1 and check.forward is not None, (function, check.name)
    assert count >= 7


class Wrong(Product):
    """A lobe whose density forgets how its normalisation, or its centre, depends on the parameters."""

    def __init__(self, fault: str) -> None:
        super().__init__(GaussianLobe(0.1, 0.3), CosineHalf())
        self.fault = fault

    def forward(self, context):  # noqa: ANN001, ANN201
        found = super().forward(context)
        right, std = found.log_prob, self.longitudinal.std(context)

        def log_prob(omega: torch.Tensor) -> torch.Tensor:
            value = right(omega)
            if self.fault == "sign":
                return 2 * value.detach() - value
            if self.fault == "normalisation":
                return value + torch.log(std) - torch.log(std).detach()
            return right(omega.detach()) if self.fault == "detached omega" else value

        found.log_prob = log_prob
        return found


@pytest.mark.parametrize("fault", ["none", "sign", "normalisation", "detached omega"])
def test_wrong_proposals_are_rejected(fault: str) -> None:
    """Values are right in all of them; only derivatives are wrong."""
    worst = 0.0
    for _, checks in proposal_checks(Wrong(fault), target(), 12, generator(6)):
        worst = max(worst, *(check.worst for check in checks))
    assert worst <= 1 if fault == "none" else worst > 1e6


def test_a_wrong_element_among_many_is_found_and_named() -> None:
    many = Mixture([Product(GaussianLobe(0.1 * k, 0.3), WrappedGaussian(0.5)) for k in range(4)])
    values = {name: p.detach() for name, p in many.named_parameters()}
    omega = target().omega[:10]
    right = fn.log_prob_of(many, CONTEXT, omega)
    name = "components.2.azimuthal.std.raw"

    def wrong(at: dict[str, torch.Tensor]) -> torch.Tensor:
        return right({**at, name: at[name].detach()})

    checks = list(fn.in_parameters(wrong, many, ways=2))
    assert len(checks) == 2 + len(values)
    assert all(check.worst > 1e6 for check in checks[:2])
    assert [check.name for check in checks[2:] if check.worst > 1] == [name]
    assert len(list(fn.in_parameters(right, many, ways=2))) == 2


def test_a_users_density_without_batches() -> None:
    """A proposal that takes no batch of parameters is evaluated step by step."""

    class Net(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.matrix = torch.nn.Parameter(torch.eye(2, dtype=torch.float64) * 0.7)

    net = Net()
    users = FromDensity(
        lambda context, x: -0.5 * (x @ net.matrix).square().sum(-1) + torch.linalg.slogdet(net.matrix)[1]
        - math.log(2 * math.pi),
        lambda context, u: torch.special.ndtri(u) @ torch.linalg.inv(net.matrix),
        space="plane",
    )  # fmt: skip
    users.net = net
    for function, checks in proposal_checks(users, target(), 8, generator(7)):
        for check in checks:
            assert check.worst <= 1 and check.apart < 1e-10, (function, check.name)


def test_formulas() -> None:
    found = check_formulas(3)
    assert {x.method for x in found} == {"complex step", "30 digits"}
    for x in found:
        assert x.worst < 1e-12 and bool(x.refused) == (x.method == "30 digits"), x


def test_second_order() -> None:
    low, high = torch.tensor(-0.4, dtype=torch.float64), torch.tensor(0.7, dtype=torch.float64)
    at = {"mean": torch.tensor(0.2, dtype=torch.float64), "std": torch.tensor(0.5, dtype=torch.float64)}
    u = torch.linspace(0.05, 0.95, 9, dtype=torch.float64)

    def sampler(v: dict[str, torch.Tensor]) -> torch.Tensor:
        return truncated_normal_icdf(u, v["mean"], v["std"], low, high)

    def density(v: dict[str, torch.Tensor]) -> torch.Tensor:
        return truncated_normal_log_prob(-0.3 + u, v["mean"], v["std"], low, high)

    for name in at:
        assert second_derivatives(sampler, at, name).status == "absent"
        assert second_derivatives(density, at, name).status == "agrees"
        assert check_derivative(sampler, at, name).worst <= 1
    wrong = second_derivatives(lambda v: v["std"].detach() * v["std"] ** 2, {"std": at["std"]}, "std")
    assert wrong.status == "differs"


def test_through_a_fit() -> None:
    bsdf = dsfit.DualScattering(FIBER, d_b=0.0)
    context = dsfit.Context(0.4)
    integrand = dsfit.Integrand(bsdf)
    right = fiber_family(integrand, context, "beta", 1)
    nodes = nodes_of_family(integrand, right, context, 3e-2)
    lobes = chapter_proposals(FIBER)
    proposal = Mixture([lobes["R"], lobes["TT"]], defensive=0.1)
    found = derivatives_through_fit(proposal, right, nodes, context, levels=4)
    assert max(found.worst) <= 1 and found.alignment < 1e-6 and abs(found.gain) < 1e-9
    assert abs(found.implicit) > 1e-3 and float(found.refitted.error) < 1e-3 * abs(found.implicit)

    def detached(omega: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
        value = right(omega, t.detach())
        return value * (1 + 0.5 * (t - t.detach()))  # a norm alone: right values, wrong derivative

    wrong = derivatives_through_fit(proposal, detached, nodes, context, levels=4)
    assert min(wrong.worst) > 1e3


def test_the_suite_runs_and_its_options_are_the_configs() -> None:
    light = dsfit.scene.VonMisesFisherLights(torch.tensor([[0.3, 1.0]], dtype=torch.float64), [4.0], [[1.0]], 0.2)
    integrand = dsfit.Integrand(dsfit.DualScattering(FIBER, d_b=0.0), light=light)
    lobes = chapter_proposals(FIBER, learnable=False)
    users = Mixture([lobes["TT"], lobes["R"]], defensive=0.2)
    subject = Subject(integrand, dsfit.Context(0.4), {"TRT": lobes["TRT"], "mine": users}, "here", 5)
    said: list[str] = []
    outcome = gradients.run(subject, say=said.append, points=8, samples=10_000, through_fit=False, moments=["TRT"])
    verdicts = judge(outcome.findings)
    assert not [f for f, v in verdicts if v == "fail"]
    assert len({f.subject for f, _ in verdicts}) == len(verdicts) > 60 and said
    assert {f.case for f, _ in verdicts} == {"here"} and {f.suite for f, _ in verdicts} == {"gradients"}
    assert outcome.arrays["names"].tolist() == ["TRT", "mine"]
    assert outcome.arrays["mean_1"].shape == (4, len(outcome.arrays["exact_1"]))
    controls = [f for f, v in verdicts if "control" in f.subject and v == "pass"]
    assert len(controls) >= 4
    parameters = inspect.signature(gradients.run).parameters
    fields = GradientsOptions.model_fields
    assert set(fields) == set(parameters) - {"subject", "say"}
    for name, field in fields.items():
        assert several(field.default) == several(parameters[name].default), name


def several(value: object) -> list[object]:
    """A list of one, unless it is a list or tuple."""
    return list(value) if isinstance(value, list | tuple) else [value]
