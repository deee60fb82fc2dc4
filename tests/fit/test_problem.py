"""Compressed least squares: the same norm, gradient, normal matrix and steps as the full problem."""

from __future__ import annotations

import pytest
import torch

from dsfit.fit.problem import FunctionProblem, compress, forward_jacobian, gauss_newton_gap


def random_system(n, p, seed=0):
    g = torch.Generator().manual_seed(seed)
    jacobian = torch.randn(n, p, generator=g, dtype=torch.float64)
    return torch.randn(n, generator=g, dtype=torch.float64), jacobian


@pytest.mark.parametrize("n, p, rows", [(2000, 7, 65536), (2000, 7, 100), (2000, 7, 3), (4, 7, 65536), (1, 1, 10)])
def test_compression_keeps_norm_gradient_and_normal_matrix(n, p, rows):
    r, j = random_system(n, p)
    r_, j_ = compress(r, j, rows=rows)
    assert r_.shape == (p + 1,) and j_.shape == (p + 1, p)
    torch.testing.assert_close(r_.square().sum(), r.square().sum(), rtol=1e-13, atol=0)
    torch.testing.assert_close(j_.T @ r_, j.T @ r, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(j_.T @ j_, j.T @ j, rtol=1e-12, atol=1e-12)


def test_compression_gives_the_same_damped_steps_and_predictions():
    r, j = random_system(500, 6)
    r_, j_ = compress(r, j)
    for damping in (1e-6, 1.0, 1e4):
        steps = []
        for a, b in ((r, j), (r_, j_)):
            rows = torch.cat([b, damping**0.5 * torch.eye(6, dtype=torch.float64)])
            step = torch.linalg.lstsq(rows, -torch.cat([a, torch.zeros(6, dtype=torch.float64)])).solution
            steps.append((step, (a + b @ step).square().sum()))
        torch.testing.assert_close(steps[0], steps[1], rtol=1e-11, atol=1e-13)


def test_compression_is_continuous_and_columns_of_any_size_survive():
    r, j = random_system(300, 4)
    scale = torch.tensor([1e-9, 1.0, 1e9, 1e-3], dtype=torch.float64)
    r_, j_ = compress(1e-6 * r, j * scale)
    r0, j0 = compress(r, j)
    torch.testing.assert_close(j_ / scale, j0, rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(1e6 * r_, r0, rtol=1e-9, atol=1e-9)
    moved, _ = compress(r + 1e-9, j + 1e-9)
    assert float((moved - r0).abs().max()) < 1e-6


def test_compression_of_non_finite_input_is_non_finite():
    r, j = random_system(10, 2)
    j[3, 1] = float("nan")
    assert not torch.isfinite(compress(r, j)[0]).any()


def test_gap_is_what_gauss_newton_gains():
    r, j = random_system(50, 3)
    step = torch.linalg.lstsq(j, -r[:, None]).solution[:, 0]
    gain = r.square().sum() - (r + j @ step).square().sum()
    units = torch.tensor([1e-8, 1.0, 1e8], dtype=torch.float64)
    for extra in (j, j * units, torch.cat([j, j[:, :1] + j[:, 1:2]], 1)):
        assert gauss_newton_gap(*compress(r, extra)) == pytest.approx(float(gain), rel=1e-9)
    assert gauss_newton_gap(r, torch.zeros(50, 2, dtype=torch.float64)) == 0.0


def function(y):
    x = torch.linspace(0, 1, 30, dtype=torch.float64)
    return torch.sin(y[0] * x + y[1]) * torch.exp(y[2] * x)


@pytest.mark.parametrize("chunk", [None, 1, 2, 3, 10])
def test_forward_jacobian_in_chunks(chunk):
    y = torch.tensor([1.0, -0.3, 0.5], dtype=torch.float64)
    value, jacobian = forward_jacobian(function, y, chunk)
    torch.testing.assert_close(value, function(y))
    torch.testing.assert_close(jacobian, torch.func.jacrev(function)(y))


@pytest.mark.parametrize("reverse", [None, False, True])
def test_function_problem(reverse):
    y = torch.tensor([1.0, -0.3, 0.5], dtype=torch.float64)
    problem = FunctionProblem(function, y, reverse=reverse, chunk=2)
    assert problem.least_squares and problem.size == 3
    r, j = problem.linearise(y)
    value, gradient = problem.gradient(y)
    assert problem.value(y) == pytest.approx(value, rel=1e-14) == pytest.approx(float(r.square().sum()), rel=1e-13)
    torch.testing.assert_close(2 * j.T @ r, gradient, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(torch.func.grad(lambda y: function(y).square().sum())(y), gradient)


def test_scalar_problem_and_constant_function():
    y = torch.zeros(2, dtype=torch.float64)
    problem = FunctionProblem(lambda y: y.square().sum() + 1, y)
    assert not problem.least_squares
    assert problem.gradient(y + 1)[0] == 3.0
    constant = FunctionProblem(lambda y: torch.ones(3, dtype=torch.float64), y)
    assert constant.gradient(y) == (3.0, pytest.approx([0.0, 0.0]))


@pytest.mark.parametrize("reach", [1e-3, 0.1, 1.0])
def test_gap_within_reach_is_the_best_that_a_short_step_can_do(reach):
    r, j = random_system(60, 4)
    j = j * torch.tensor([1.0, 1e-2, 1e-4, 1e-6], dtype=torch.float64)  # the full step is long
    promise = gauss_newton_gap(r, j, reach=reach)
    assert 0 < promise < gauss_newton_gap(r, j)
    # No step in the box does better, and the ball about it is used up.
    g = torch.Generator().manual_seed(1)
    steps = reach * (2 * torch.rand(20000, 4, generator=g, dtype=torch.float64) - 1)
    toward = torch.linalg.lstsq(torch.cat([j, 1e-3 * torch.eye(4).double()]), torch.cat([-r, torch.zeros(4).double()]))
    steps = torch.cat([steps, reach * toward.solution.reshape(1, -1) / toward.solution.abs().max()])
    gain = r.square().sum() - (r + steps @ j.T).square().sum(-1)
    assert float(gain.max()) <= promise * (1 + 1e-9)
    along = torch.linalg.solve(j.T @ j + 1e-18 * torch.eye(4).double(), -j.T @ r)
    assert along.abs().max() > reach


def test_gap_within_reach_forgets_a_parameter_at_infinity():
    r, j = random_system(60, 3)
    dead = j.clone()
    dead[:, 2] *= 1e-12  # say, the logit of a share of 1e-12
    assert gauss_newton_gap(r, dead) == pytest.approx(gauss_newton_gap(r, j), rel=1e-9)
    assert gauss_newton_gap(r, dead, reach=100.0) == pytest.approx(gauss_newton_gap(r, j[:, :2]), rel=1e-6)
