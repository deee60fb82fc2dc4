"""The stability atlas: the library's functions within their limits; naive ones, and wrong ones, found out."""

from __future__ import annotations

import dataclasses
import math

import mpmath as mp
import pytest
import torch
from torch import Tensor

from dsfit import special
from dsfit.arguments import check_uniforms
from dsfit.checks.finding import Finding
from dsfit.checks.stability import CLASSES, Function, atlas, findings, measure, parts, run
from dsfit.checks.stability.function import class_of
from dsfit.checks.stability.measure import rounded
from dsfit.context import Context
from dsfit.errors import InputError
from dsfit.mis.heuristics import Balance, Cutoff, Maximum
from dsfit.proposals.azimuth import WrappedGaussianLaw
from dsfit.proposals.split_lobe import SplitGaussianInclination
from dsfit.scene.lights.lobes import VonMisesFisherLights

QUICK = ("special.log_mills", "special.log_gauss", "mis.balance", "mass.gaussian_lobe", "cosine_azimuth.sample")


def failed(found: list[Finding]) -> list[Finding]:
    return [finding for finding in found if finding.verdict(0.01) != "pass"]


def named(name: str) -> Function:
    return atlas.functions()[name]


def checked(function: Function, dtype: str = "float64") -> list[Finding]:
    """All findings of an entry in one dtype."""
    return [f for regime in function.regimes for f in findings(function, measure(function, regime, dtype))]


@pytest.mark.parametrize("name", QUICK)
def test_a_few_functions_are_within_their_limits(name: str) -> None:
    found = run(name, seed=1).findings
    assert not failed(found), [(f.case, f.detail) for f in failed(found)]
    assert {f.data["dtype"] for f in found} == {"float64", "float32"}
    assert all(math.isfinite(f.value) for f in found)


@pytest.mark.slow
@pytest.mark.parametrize("name", parts())
def test_every_function_is_within_its_limits(name: str) -> None:
    found = run(name, seed=1).findings
    assert not failed(found), [(f.case, f.detail) for f in failed(found)]


def test_the_atlas_is_well_formed() -> None:
    """Every regime is of a class and has points of the right length, limits are those of a dtype, names are unique."""
    for name, function in atlas.functions().items():
        assert function.name == name
        assert set(function.gradients or ()) <= set(function.arguments)
        for regime, points in function.regimes.items():
            assert class_of(regime) in CLASSES
            assert points and all(len(point) == len(function.arguments) for point in points)
            for dtype in ("float64", "float32"):
                value, gradient = function.limit(regime, dtype)
                assert 0 < value < 1 and 0 < gradient
        for exception in function.loose:
            assert exception in CLASSES or exception in function.regimes, (name, exception)


def test_names_are_checked() -> None:
    assert parts(functions=["mis.power"]) == ["mis.power"]
    with pytest.raises(InputError, match="functions"):
        parts(functions=["mis.nothing"])
    with pytest.raises(InputError, match="function"):
        run("mis.nothing", seed=1)


# ---- negative controls ----


@pytest.mark.parametrize(
    ("name", "dtype"),
    [
        ("special.log_mills", "float64"),
        ("special.log_normal_mass", "float64"),
        ("special.log_gauss", "float32"),
        ("special.wrapped_normal_log_prob", "float64"),
        ("light.sample", "float64"),
        ("light.log_normaliser", "float64"),
        ("mis.balance", "float64"),
        ("wrapped_azimuth.log_prob", "float64"),
        ("frame.theta_there_and_back", "float64"),
    ],
)
def test_naive_formulas_passed_off_as_the_library_fail(name: str, dtype: str) -> None:
    function = named(name)
    assert function.naive is not None
    found = failed(checked(dataclasses.replace(function, compute=function.naive, naive=None), dtype))
    values = [f for f in found if f.data["quantity"] == "value"]
    assert values and max(f.value / f.bound for f in values) > 1e3


def test_a_wrong_value_is_found() -> None:
    """One that is off by 1e-13, fifty times its limit."""
    function = named("special.log_gauss")
    off = dataclasses.replace(function, compute=lambda x, std: special.log_gauss(x, std) + 1e-13, naive=None)
    assert failed(checked(off))


class _WrongSlope(torch.autograd.Function):
    """exp, whose derivative is claimed to be 1e-6 too large."""

    @staticmethod
    def forward(context, x: Tensor) -> Tensor:  # noqa: ANN001
        value = torch.exp(x)
        context.save_for_backward(value)
        return value

    @staticmethod
    def backward(context, gradient: Tensor) -> Tensor:  # noqa: ANN001
        return gradient * context.saved_tensors[0] * (1 + 1e-6)


def _exponential(compute, **fields) -> Function:  # noqa: ANN001, ANN003
    regimes = {"ordinary": [(0.3,), (-2.0,)], "small": [(-720.0,), (-800.0,)]}
    return Function("test.exp", ("x",), compute, mp.exp, regimes, **fields)


def test_a_wrong_gradient_is_found_though_the_value_is_right() -> None:
    good = checked(_exponential(torch.exp))
    bad = failed(checked(_exponential(_WrongSlope.apply)))
    assert not failed(good)
    assert bad and {f.data["quantity"] for f in bad} == {"gradient"}


def test_numbers_that_are_none_and_negative_densities_are_counted() -> None:
    nan = measure(_exponential(lambda x: torch.exp(x) + torch.sqrt(x) * 0), "ordinary", "float64")
    assert nan.value.nan == 1 and nan.value.worst == math.inf
    negative = measure(_exponential(lambda x: torch.exp(x) - 1e-300, density=True), "small", "float64")
    assert negative.value.negative == 2 and negative.value.worst == math.inf
    infinite = measure(_exponential(lambda x: torch.exp(x) * 1e308 * 1e308), "ordinary", "float64")
    assert infinite.value.infinite == 2
    zero = measure(_exponential(lambda x: torch.exp(x) * 0), "ordinary", "float64")
    assert zero.value.zero == 2 and zero.value.worst == 1


def test_underflow_is_right_where_the_dtype_has_nothing_smaller() -> None:
    """exp(-720) is denormal and exp(-800) is nothing: neither is an error, nor is an overflow of the exact value."""
    found = measure(_exponential(lambda x: torch.where(x < -700, 0.0, torch.exp(x))), "small", "float64")
    assert found.value.worst == 0 and found.value.zero == 0
    large = dataclasses.replace(_exponential(torch.exp), regimes={"wide": [(1000.0,)]})
    assert measure(large, "wide", "float64").value.worst == 0


def test_arguments_are_rounded_before_the_twin_sees_them() -> None:
    """float32 of 0.1 has an error of 1.5e-9; exp of it would be blamed for that otherwise."""
    (point,) = rounded([(0.1,)], torch.float32)
    assert point[0] == torch.tensor(0.1, dtype=torch.float32).item() != 0.1
    assert rounded([(1e300,)], torch.float32) == []
    assert rounded([(math.inf,)], torch.float32) == [(math.inf,)]


def test_points_outside_the_domain_are_left_out() -> None:
    """cos(theta) of float32's pi / 2 is negative; no regime is judged by it, and none is judged by nothing."""
    function = named("frame.phi_there_and_back")
    empty = measure(function, "grazing: theta = 90 deg", "float32")
    assert empty.points == 0 and findings(function, empty) == []
    assert measure(function, "grazing: theta = 90 deg", "float64").points == 6


# ---- what the atlas found in the library ----


def test_two_piece_lobe_keeps_the_digits_of_u_next_to_one_and_its_gradient() -> None:
    """(u - share) / (1 - share) had lost half the digits of 1 - u; clamping to 90 degrees had cut the gradient."""
    for regime in ("ends of u", "ends of u: 1e-300"):
        for dtype in ("float64", "float32"):
            found = measure(named("split_lobe.sample"), regime, dtype)
            assert found.value.worst < (1e-15 if dtype == "float64" else 1e-6)
    u = torch.tensor(1e-30, dtype=torch.float32, requires_grad=True)
    one = torch.tensor(1.0)
    theta = SplitGaussianInclination(-one, 0.1 * one, one, 0.6 * one).sample(u)
    assert torch.autograd.grad(theta, u)[0] == pytest.approx(6.41, rel=1e-2)


def test_narrow_azimuths_keep_their_digits_next_to_pi() -> None:
    """pi - phi in float32 had been off by 8.7e-8, which is 0.1 % of a density of width 0.006 degrees."""
    phi = torch.tensor([3.14129, -3.14129], dtype=torch.float32)
    value = WrappedGaussianLaw(torch.tensor(1e-4)).log_prob(phi, phi)
    x = math.pi - phi[0].item()
    exact = -0.5 * (x / 1e-4) ** 2 - math.log(1e-4 * math.sqrt(2 * math.pi))
    torch.testing.assert_close(value, torch.full_like(value, exact), rtol=0, atol=3e-6)


@pytest.mark.parametrize("rule", [Balance(), Maximum(), Cutoff(0.1)])
def test_weights_of_huge_logs_are_those_of_their_differences(rule: Balance) -> None:
    """Counts were added to logs of 1e6 first, which rounds 3 % away in float32."""
    exact, counts = torch.tensor([[-2.0, 0.25], [0.0, 0.125]]), torch.tensor([1.0, 3.0])
    torch.testing.assert_close(rule.weights(exact - 2.0**20, counts), rule.weights(exact, counts), rtol=1e-6, atol=0)


def test_far_side_of_a_light_lobe_keeps_the_digits_of_u() -> None:
    found = measure(named("light.sample"), "ends of u", "float64")
    assert found.value.worst < 1e-15
    light = VonMisesFisherLights([[0.0, 0.0]], 0.0)
    theta = light.proposal()(Context(0.0)).sample(torch.tensor([0.5, 0.75, 1e-30], dtype=torch.float64))
    assert torch.isfinite(theta).all()


def test_an_exact_zero_among_uniforms_moves_no_other() -> None:
    """It had raised all below eps / 4, and a light's sample from u = 1e-12 changed with the other uniforms."""
    u = torch.tensor([[0.5, 1e-12, 0.25], [0.5, 0.7, 0.0], [0.5, 1.0, 0.3]], dtype=torch.float32)
    moved = check_uniforms(u, 3)
    eps = torch.finfo(torch.float32).eps
    assert moved[0].tolist() == u[0].tolist()
    assert moved[1, 2] == eps / 4 and moved[2, 1] == 1 - eps / 2 and moved.dtype == torch.float32


def test_maps_show_faults_and_limits() -> None:
    from dsfit.experiment.plots.checks.stability import _Grid, figures

    found = [f.to_dict() for name in ("mis.balance", "special.log_mills") for f in run(name, seed=1).findings]
    found[0]["value"] = "inf"  # as JSON has it
    result = {"title": "", "name": "atlas", "cells": [{"suite": "stability", "findings": found}]}
    drawn = dict(figures(None, result))  # type: ignore[arg-type]
    assert list(drawn) == ["stability", "stability-naive-value", "stability-naive-gradient"]
    naive = _Grid(found, ["mis.balance"], "float64", "value", True)
    mine = _Grid(found, ["mis.balance"], "float64", "value", False)
    tail = list(CLASSES).index("tail")
    assert naive.fault[0, tail] == "×" and naive.error[0, tail] == math.inf
    assert mine.fault[0, tail] == "" and mine.error[0, tail] < 1e-14
    assert mine.failed[0, 0] and mine.failed.sum() == 1
