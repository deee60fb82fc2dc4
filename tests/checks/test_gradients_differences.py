"""Extrapolated differences: their error estimate is a bound where it claims to be one, and says so where it is not."""

from __future__ import annotations

import math

import pytest
import torch

from dsfit.checks.gradients.compare import CLEAR, check_derivative
from dsfit.checks.gradients.differences import SAFETY, complex_step, derivative

COUNT = 20_000


def points(low: float, high: float, seed: int = 0) -> torch.Tensor:
    return low + (high - low) * torch.rand(COUNT, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def bell(width: float):  # noqa: ANN201
    return (
        lambda x: torch.exp(-0.5 * (x / width) ** 2),
        lambda x: -x / width**2 * torch.exp(-0.5 * (x / width) ** 2),
        (-4 * width, 4 * width),
    )


SMOOTH = {
    "waves": (lambda x: torch.exp(torch.sin(3 * x)), lambda x: 3 * torch.cos(3 * x) * torch.exp(torch.sin(3 * x)),
              (-2, 2)),
    "cubic": (lambda x: x**3, lambda x: 3 * x * x, (-2, 2)),
    "line": (lambda x: 3 * x, lambda x: torch.full_like(x, 3), (-2, 2)),
    "logarithm": (torch.log, lambda x: 1 / x, (0.15, 2)),
    "step of width 1/20": (lambda x: torch.atan(20 * x), lambda x: 20 / (1 + 400 * x * x), (-1, 1)),
    "root beside its end": (torch.sqrt, lambda x: 0.5 / torch.sqrt(x), (0.101, 2)),
    "erfc": (torch.special.erfc, lambda x: -2 / math.sqrt(math.pi) * torch.exp(-x * x), (-5, 5)),
    "bend": (lambda x: x * x.abs(), lambda x: 2 * x.abs(), (-0.5, 0.5)),
    "bell 0.3": bell(0.3),
    "bell 0.03": bell(0.03),
    "bell 0.003": bell(0.003),
    "rough": (lambda x: (torch.sin(x) + 1e5) - 1e5, torch.cos, (-2, 2)),
}  # fmt: skip


@pytest.mark.parametrize("name", SMOOTH)
def test_the_error_estimate_is_a_bound_and_small(name: str) -> None:
    function, slope, (low, high) = SMOOTH[name]
    x = points(low, high)
    found = derivative(lambda t: function(x + t), torch.full_like(x, 0.1), at_once=True)
    error = (found.value - slope(x)).abs()
    assert bool((error <= 0.5 * SAFETY * found.error).all()), float((error / found.error).max())
    relative = found.error / (found.value.abs() + found.scale)
    assert float(relative.quantile(0.9)) < (1e-9 if name != "rough" else 1e-6)


def test_kinks_and_jumps_are_seen_by_their_error() -> None:
    """Right where the nearest kink is further than the smallest step, and without a verdict where it is nearer."""
    x = points(-0.01, 0.01)
    x[:3] = torch.tensor([0.0, 1e-9, -1e-12])
    for function, slope in ((torch.abs, torch.sign), (lambda t: torch.sin(t) + (t > 0), torch.cos)):
        found = derivative(lambda t, f=function: f(x + t), torch.full_like(x, 0.1), at_once=True)
        clear = found.error <= CLEAR * (found.value.abs() + found.scale)
        assert not bool(clear[:3].any()) and 0.9 < float(clear.double().mean()) < 1
        assert bool(((found.value - slope(x)).abs() <= SAFETY * found.error)[clear].all())
    spike = derivative(lambda t: torch.exp(-0.5 * ((t + 1e-7) / 1e-6) ** 2), 0.1)
    assert float(spike.error) > CLEAR * float(spike.value.abs() + spike.scale)


def test_values_that_are_not_finite_are_no_derivative() -> None:
    found = derivative(lambda t: torch.log(torch.tensor([1.0, -1.0], dtype=torch.float64) + t), 0.1)
    assert abs(float(found.value[0]) - 1) < 1e-10 and math.isnan(float(found.value[1]))
    assert float(found.error[1]) == math.inf


def test_complex_step_is_exact_or_says_why_not() -> None:
    x = points(0.2, 1.2)
    found = complex_step(lambda t: torch.exp(torch.sin(t)) / t**3, x)
    assert found.value is not None
    exact = torch.exp(torch.sin(x)) * (torch.cos(x) / x**3 - 3 / x**4)
    torch.testing.assert_close(found.value, exact, rtol=1e-14, atol=0)
    for refusing in (lambda t: t.clamp_min(0.3), torch.special.erfc, lambda t: torch.maximum(t, t), lambda t: t.abs()):
        found = complex_step(refusing, x)
        assert found.value is None and found.refused


FAULTS = {
    "right": lambda x: torch.sin(2 * x),
    "detached factor": lambda x: torch.sin(x) * 2 * torch.cos(x.detach()),
    "sign": lambda x: torch.sin(2 * x.detach()) * 2 - torch.sin(2 * x),
    "one part in a million": lambda x: torch.sin(2 * x) + 1e-6 * (x - x.detach()),
}


@pytest.mark.parametrize("name", FAULTS)
@pytest.mark.parametrize("own", [True, False])
def test_a_planted_fault_is_rejected(name: str, own: bool) -> None:
    x = points(-2, 2)[: 200 if own else 3]
    scale = torch.linspace(0.5, 1.5, 7, dtype=torch.float64)

    def function(values: dict[str, torch.Tensor]) -> torch.Tensor:
        value = FAULTS[name](values["x"])
        return value if own else scale * value.sum()

    check = check_derivative(function, {"x": x}, "x", own=own)
    assert check.forward is not None and check.apart < 1e-14 and check.unclear_share == 0
    assert (check.worst < 1) if name == "right" else (check.worst > 1e3)


def test_modes_that_disagree_are_seen() -> None:
    class Lopsided(torch.autograd.Function):
        """Right in reverse mode, twice as large in forward mode."""

        @staticmethod
        def forward(x):  # noqa: ANN001, ANN205
            return x.exp()

        @staticmethod
        def setup_context(ctx, inputs, output):  # noqa: ANN001, ANN205
            ctx.save_for_backward(output)
            ctx.save_for_forward(output)

        @staticmethod
        def backward(ctx, slope):  # noqa: ANN001, ANN205
            return slope * ctx.saved_tensors[0]

        @staticmethod
        def jvp(ctx, tangent):  # noqa: ANN001, ANN205
            return 2 * tangent * ctx.saved_tensors[0]

    check = check_derivative(lambda v: Lopsided.apply(v["x"]), {"x": points(-1, 1)[:20]}, "x", own=True)
    assert check.apart > 0.1 and check.worst > 1e3
