"""Every solver on problems with known answers, on degenerate ones, and on functions that misbehave."""

from __future__ import annotations

import math
import threading

import pytest
import torch

from dsfit.errors import InputError
from dsfit.fit.solvers import SOLVERS, minimise

pytest.importorskip("jax")
ALL = list(SOLVERS)
SECOND_ORDER = ["optimistix.lm", "optimistix.gauss_newton", "optimistix.dogleg", "optimistix.bfgs", "torch.lbfgs"]
NEEDS_RESIDUALS = [name for name in ALL if SOLVERS[name].least_squares]


def vector(*x):
    return torch.tensor(x, dtype=torch.float64)


def rosenbrock(y):
    return torch.stack([10 * (y[1] - y[0] ** 2), 1 - y[0]])


G = torch.Generator().manual_seed(1)
A = torch.randn(40, 4, generator=G, dtype=torch.float64)
B = torch.randn(40, generator=G, dtype=torch.float64)
BEST = torch.linalg.lstsq(A, B[:, None]).solution[:, 0]
LEAST = float((A @ BEST - B).square().sum())


def linear(y):
    return A @ y - B


def options_for(name, **more):
    return {**({"rate": 0.2, "max_steps": 3000} if name == "torch.adam" else {}), **more}


@pytest.mark.parametrize("name", ALL)
def test_linear_least_squares(name):
    result = minimise(linear, torch.zeros(4, dtype=torch.float64), name, **options_for(name))
    assert result.converged, result.reason
    assert result.value == pytest.approx(LEAST, rel=1e-5)
    torch.testing.assert_close(result.y, BEST, rtol=0, atol=1e-2)
    assert result.gap is not None and result.gap < 1e-5


@pytest.mark.parametrize("name", ALL)
def test_rosenbrock(name):
    start = vector(-1.2, 1.0)
    result = minimise(rosenbrock, start, name, **options_for(name))
    assert result.value < (1e-8 if name != "torch.adam" else 1e-2), result
    if name != "torch.adam":
        assert result.converged
        torch.testing.assert_close(result.y, vector(1.0, 1.0), rtol=0, atol=1e-3)
    assert torch.equal(start, vector(-1.2, 1.0))
    assert result.value == pytest.approx(float(rosenbrock(result.y).square().sum()), rel=1e-9, abs=1e-30)


@pytest.mark.parametrize("name", [n for n in ALL if not SOLVERS[n].least_squares])
def test_rosenbrock_as_a_scalar(name):
    result = minimise(lambda y: rosenbrock(y).square().sum(), vector(-1.2, 1.0), name, **options_for(name))
    assert result.value < (1e-4 if name != "torch.adam" else 1e-2), result
    assert result.gap is None


@pytest.mark.parametrize("name", [n for n in ALL if n != "torch.adam"])
def test_badly_scaled(name):
    units = vector(1e6, 1.0, 1e-3, 1e3)
    result = minimise(lambda y: linear(units * y), torch.zeros(4, dtype=torch.float64), name)
    assert result.converged, result.reason
    assert result.value == pytest.approx(LEAST, rel=1e-5)


def singular(y):
    return torch.stack([y[0] + y[1] - 1, 2 * (y[0] + y[1]) - 2.5, (y[0] + y[1]) ** 2 - 1])


@pytest.mark.parametrize("name", ALL)
def test_singular_jacobian(name):
    result = minimise(singular, vector(3.0, -1.0), name, **options_for(name))
    assert result.converged, result.reason
    s = torch.linspace(0.5, 1.5, 200001, dtype=torch.float64)
    least = float(((s - 1) ** 2 + (2 * s - 2.5) ** 2 + (s**2 - 1) ** 2).min())
    assert result.value == pytest.approx(least, rel=1e-4)


@pytest.mark.parametrize("name", ALL)
def test_flat(name):
    result = minimise(lambda y: torch.ones(5, dtype=torch.float64) + 0 * y.sum(), vector(1.0, 2.0, 3.0), name)
    assert result.converged and result.value == 5.0
    assert result.steps <= 60
    assert torch.isfinite(result.y).all()


def wall(y):
    """NaN beyond y0 = 3, minimum at 2.9 beside it, where full steps from 0 overshoot."""
    return torch.stack([y[0] - 2.9, 3 * y[1] - torch.log(3 - y[0])])


@pytest.mark.parametrize("name", ALL)
def test_wall_of_nan(name):
    result = minimise(wall, vector(0.0, 5.0), name, **options_for(name))
    assert result.value < 1e-3, result
    assert torch.isfinite(result.y).all() and result.y[0] < 3


@pytest.mark.parametrize("name", ALL)
def test_start_beside_the_wall_ends_finite_with_a_reason(name):
    def beyond(y):  # minimum at 5 lies behind the wall
        return torch.stack([y[0] - 5 + 0 * torch.sqrt(3 - y[0]), y[1]])

    result = minimise(beyond, vector(2.5, 1.0), name, **options_for(name, max_steps=60))
    assert math.isfinite(result.value) and result.value <= 2.5**2 + 1 and torch.isfinite(result.y).all()
    assert result.reason
    if not result.converged:
        assert "max_steps" in result.reason or "finite" in result.reason or "descent" in result.reason


@pytest.mark.parametrize("name", ALL)
def test_exceptions_mid_way_become_a_reason(name):
    def raises(y):
        if float(y[0].detach()) > 2:
            raise ValueError("outside the domain")
        return torch.stack([y[0] - 5, y[1]])

    result = minimise(raises, vector(0.0, 1.0), name, max_steps=60, **({"rate": 0.5} if "adam" in name else {}))
    assert result.y[0] <= 2 and result.value <= 26 and (name == "optimistix.gauss_newton") == (result.value == 26)
    assert "outside the domain" in result.reason


@pytest.mark.parametrize("name", ["optimistix.lm", "optimistix.nelder_mead", "torch.lbfgs"])
def test_programming_errors_pass_through(name):
    def broken(y):
        if float(y.detach().abs().sum()) > 2.001:
            raise TypeError("a bug, not a number")
        return y - 5

    with pytest.raises(TypeError, match="a bug"):
        minimise(broken, vector(1.0, 1.0), name)


@pytest.mark.parametrize("name", ALL)
def test_max_steps_and_time(name):
    result = minimise(rosenbrock, vector(-1.2, 1.0), name, max_steps=1, tolerance=1e-12)
    assert result.steps == 1 and not result.converged and "max_steps" in result.reason
    assert [e.step for e in result.history] == [0, 1]
    nothing = minimise(rosenbrock, vector(-1.2, 1.0), name, max_steps=0)
    assert nothing.steps == 0 and nothing.value <= 24.2 + 1e-9 and not nothing.converged
    timed = minimise(rosenbrock, vector(-1.2, 1.0), name, max_seconds=0.0, tolerance=1e-12)
    assert timed.steps <= 1 and "max_seconds" in timed.reason


@pytest.mark.parametrize("name", ALL)
def test_history_is_monotone_and_counts(name):
    result = minimise(rosenbrock, vector(-1.2, 1.0), name, max_steps=30, tolerance=1e-12)
    values = [e.value for e in result.history]
    assert values == sorted(values, reverse=True) and values[-1] >= result.value
    assert [e.step for e in result.history] == list(range(result.steps + 1))
    assert all(
        a.seconds <= b.seconds and a.evaluations <= b.evaluations
        for a, b in zip(result.history, result.history[1:], strict=False)
    )
    assert result.evaluations >= result.derivatives
    assert result.seconds >= result.history[-1].seconds


def test_bad_input():
    good = vector(1.0, 2.0)
    for bad, field in [
        (vector(1.0, math.nan), "y0"),
        (vector(math.inf, 0.0), "y0"),
        (vector(), "y0"),
        (torch.zeros(2, 2), "y0"),
    ]:
        with pytest.raises(InputError) as error:
            minimise(linear, bad)
        assert error.value.field == field
    with pytest.raises(InputError, match="finite value"):
        minimise(lambda y: y / 0, good)
    with pytest.raises(InputError, match="optimistix.lm"):
        minimise(rosenbrock, good, "scipy.lm")
    with pytest.raises(InputError, match="options of torch.adam"):
        minimise(rosenbrock, good, "torch.adam", memory=3)
    for name in NEEDS_RESIDUALS:
        with pytest.raises(InputError, match="optimistix.bfgs"):
            minimise(lambda y: y.square().sum(), good, name)


def test_same_numbers_again_and_in_threads():
    def solve(shift):
        return minimise(lambda y: rosenbrock(y - shift), vector(-1.2, 1.0), "optimistix.lm")

    shifts = [0.0, 0.3, -0.2, 0.7, 1.1, -0.5]
    alone = [solve(s) for s in shifts]
    together = {}
    threads = [threading.Thread(target=lambda s=s: together.__setitem__(s, solve(s))) for s in shifts]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for shift, first in zip(shifts, alone, strict=True):
        assert torch.equal(first.y, together[shift].y) and first.evaluations == together[shift].evaluations


def test_programs_are_compiled_once_for_similar_sizes():
    minimise(linear, torch.zeros(4, dtype=torch.float64), "optimistix.lm")
    wide = torch.randn(40, 7, generator=G, dtype=torch.float64)
    result = minimise(lambda y: wide @ y - B, torch.zeros(7, dtype=torch.float64), "optimistix.lm")
    assert result.converged and result.compile_seconds < 0.3


def test_refused_steps_need_no_jacobian():
    result = minimise(rosenbrock, vector(-1.2, 1.0), "optimistix.lm")
    assert result.derivatives < result.steps


def test_reach_limits_steps():
    seen = []

    def function(y):
        seen.append(y.detach().clone())
        return linear(y)

    start = torch.zeros(4, dtype=torch.float64)
    result = minimise(function, start + 3, "optimistix.lm", reach=0.25, tolerance=1e-10)
    assert result.value == pytest.approx(LEAST, rel=1e-8)
    assert result.steps > 10


def test_float32_start_is_solved_in_float64():
    result = minimise(rosenbrock, torch.tensor([-1.2, 1.0]), "optimistix.lm")
    assert result.y.dtype == torch.float64 and result.value < 1e-14


def test_claims_of_a_solver_are_judged(monkeypatch):
    """A solver that says that it converged after no step at all does not get away with it."""
    from dsfit.fit import optimistix_solvers

    def liar(name, tracker, **options):
        return tracker.result(name, 0, True, "converged, honestly")

    monkeypatch.setattr(optimistix_solvers, "least_squares", liar)
    result = minimise(rosenbrock, vector(-1.2, 1.0), "optimistix.lm")
    assert not result.converged and "yet a Gauss-Newton step" in result.reason
    at_best = minimise(linear, BEST, "optimistix.lm")
    assert at_best.converged


def test_parameter_whose_bound_is_at_infinity_ends_converged():
    """The best value of sigmoid(y0) is 0: reached at no finite y0, but within reach nothing is left to gain."""

    def residuals(y):
        return torch.stack([1 + torch.sigmoid(y[0]), y[1] - 2])

    result = minimise(residuals, vector(0.0, 0.0), "optimistix.lm", reach=2.0, tolerance=1e-6)
    assert result.converged and result.value == pytest.approx(1.0, rel=1e-5)
    with pytest.raises(InputError, match="reach"):
        minimise(residuals, vector(0.0, 0.0), "optimistix.lm", reach=0.0)


def test_adam_on_a_plateau_away_from_the_best_point_does_not_claim_a_zero_gradient():
    def residuals(y):  # flat at 5 beyond 1, and steep before: a first step of 0.6 leaps onto the plateau
        return torch.where(y < 1, 1 + (y - 0.75) ** 2, 5.0 + 0 * y)

    result = minimise(residuals, vector(0.5), "torch.adam", rate=0.6, max_steps=200)
    assert result.value == pytest.approx(1.0, abs=1e-3), result
    assert "gradient is zero" not in result.reason or float(result.y[0]) == pytest.approx(0.75, abs=1e-6)
