"""dsfit.special against 50-digit arithmetic: values and first derivatives, both modes, both dtypes, all regimes."""

from __future__ import annotations

import math

import mpmath as mp
import numpy as np
import pytest
import torch
from torch import Tensor
from torch.func import jacfwd, jacrev, vmap

from dsfit import special

mp.mp.dps = 50
INF = float("inf")


def mass(a: float, b: float) -> mp.mpf:
    """Phi(b) - Phi(a) without cancellation."""
    a, b = mp.mpf(a), mp.mpf(b)
    root = mp.sqrt(2)
    if a > 0:
        return (mp.erfc(a / root) - mp.erfc(b / root)) / 2
    if b < 0:
        return mass(-b, -a)
    return 1 - mp.erfc(-a / root) / 2 - mp.erfc(b / root) / 2


def f64(values: object) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def windows() -> list[tuple[float, float]]:
    """From the centre to 1e4 standard deviations, from 1e-8 to 1e4 wide."""
    rng = np.random.default_rng(3)
    found = [
        (3, 5),
        (30, 31),
        (37, 50),
        (1e3, 1e3 + 1e-3),
        (8, 9),
        (-5, -3),
        (-1, 1e-9),
        (0, 1),
        (-INF, 2),
        (4, INF),
        (-INF, INF),
    ]
    for _ in range(250):
        centre, width = rng.choice([-1, 1]) * 10 ** rng.uniform(-3, 4), 10 ** rng.uniform(-8, 4)
        start = centre - width * rng.uniform()
        found.append((start, start + width))
    return [(float(a), float(b)) for a, b in found]


def test_log_normal_mass_reference_values() -> None:
    """Values computed with 60 digits."""
    a, b = f64([3, 30, 37, 1e3, 8]), f64([5, 31, 50, 1e3 + 1e-3, 9])
    expected = f64([-6.60793859459689, -454.3212439563433, -689.0305855768906, -500008.2853690846, -35.01361859343715])
    torch.testing.assert_close(special.log_normal_mass(a, b), expected, rtol=1e-14, atol=0)


def test_log_normal_mass_value_and_gradient() -> None:
    cases = windows()
    a, b = (f64(column).requires_grad_() for column in zip(*cases, strict=True))
    value = special.log_normal_mass(a, b)
    grad_a, grad_b = torch.autograd.grad(value.sum(), (a, b))
    for i, (low, high) in enumerate(cases):
        z = mass(low, high)
        truth = mp.log(z)
        assert abs(value[i].item() - truth) <= 4e-15 * max(1, abs(truth)), (low, high)
        for end, got, slope in ((low, grad_a[i], -mp.npdf(low) / z), (high, grad_b[i], mp.npdf(high) / z)):
            if abs(slope) > 1e-290:  # exp(-z^2 / 2) itself is conditioned like z^2 eps
                assert abs(got.item() / slope - 1) < 4e-15 + 3e-16 * min(end**2, 700), (low, high)
            else:
                assert abs(got.item()) < 1e-280


def test_log_normal_mass_modes_agree_and_empty_windows() -> None:
    a, b = (f64(column) for column in zip(*windows(), strict=True))
    forward = jacfwd(lambda x: special.log_normal_mass(x, b).nansum(dim=-1))(a)
    reverse = jacrev(lambda x: special.log_normal_mass(x, b).nansum(dim=-1))(a)
    torch.testing.assert_close(forward, reverse, rtol=1e-10, atol=1e-14)
    mapped = vmap(torch.func.grad(special.log_normal_mass))(a, b)
    torch.testing.assert_close(mapped, reverse, rtol=1e-10, atol=1e-14)
    second = torch.func.hessian(special.log_normal_mass)(f64(2.0), f64(3.0))
    step = 1e-5
    slope = jacrev(special.log_normal_mass)
    torch.testing.assert_close(second, (slope(f64(2 + step), f64(3.0)) - slope(f64(2 - step), f64(3.0))) / (2 * step))
    x = f64([1.0, 2.0]).requires_grad_()
    empty = special.log_normal_mass(x, f64([1.0, 1.0]))
    assert bool((empty == -INF).all())
    assert torch.autograd.grad(empty.sum(), x)[0].isfinite().all()


def test_log_normal_mass_float32() -> None:
    cases = [(a, b) for a, b in windows() if abs(a) < 1e4 and b - a > 1e-3 * max(1, abs(a))]
    a, b = (torch.tensor(column, dtype=torch.float32).requires_grad_() for column in zip(*cases, strict=True))
    value = special.log_normal_mass(a, b)
    assert value.dtype == torch.float32
    exact = special.log_normal_mass(a.detach().double(), b.detach().double())
    torch.testing.assert_close(value.double(), exact, rtol=1e-6, atol=2e-5)
    assert all(g.isfinite().all() for g in torch.autograd.grad(value.sum(), (a, b)))
    thirty = special.log_normal_mass(torch.tensor(30.0), torch.tensor(31.0))
    assert abs(thirty.item() + 454.3212) < 1e-3


def test_log_mills_derivatives_do_not_cancel() -> None:
    """d log M / da = a - 1 / M, about -1/a: the difference has lost all digits at 1e8."""
    for a in (0.0, 0.5, 5.0, 7.999, 8.0, 100.0, 1e4, 1e8):
        x = f64(a).requires_grad_()
        (slope,) = torch.autograd.grad(special.log_mills(x), x)
        mills = mp.sqrt(mp.pi / 2) * mp.exp(mp.mpf(a) ** 2 / 2) * mp.erfc(mp.mpf(a) / mp.sqrt(2)) if a < 1e3 else None
        truth = a - 1 / mills if mills is not None else -1 / mp.mpf(a) + 2 / mp.mpf(a) ** 3
        assert abs(slope.item() / truth - 1) < 3e-14, a


def truncated_cases(count: int = 200) -> list[tuple[float, ...]]:
    """(u, mean, std, low, high) as the longitudinal laws meet them, and far beyond."""
    rng = np.random.default_rng(5)
    rows = [(0.5, 0.0, 1e-4, 0.8, 2.3), (0.3, 1.5, 1e-4, -1.5, 0.0), (0.9, 0.1, 100.0, -0.7, 0.8)]
    while len(rows) < count:
        std, mean, low = 10 ** rng.uniform(-4, 2), rng.uniform(-1.5, 1.5), rng.uniform(-1.5, 0.7)
        high = low + rng.choice([1.5, 10 ** rng.uniform(-6, 0)])
        u = rng.choice([rng.uniform(), 10 ** rng.uniform(-12, 0), 1 - 10 ** rng.uniform(-12, 0)])
        rows.append((u, mean, std, low, high))
    return [tuple(float(x) for x in row) for row in rows]


def exact_root(u: mp.mpf, a: mp.mpf, b: mp.mpf, z: mp.mpf) -> mp.mpf:
    """Newton from a good start, in 50 digits."""
    whole = mass(a, b)
    for _ in range(60):
        step = ((mass(a, z) / whole if u < 0.5 else 1 - mass(z, b) / whole) - u) * whole / mp.npdf(z)
        z = min(max(z - max(min(step, 1), -1), a), b)
        if abs(step) < mp.mpf(10) ** -35:
            break
    return z


def test_truncated_normal_icdf_value_and_gradient() -> None:
    rows = truncated_cases()
    args = [f64(column).requires_grad_() for column in zip(*rows, strict=True)]
    x = special.truncated_normal_icdf(*args)
    grads = torch.autograd.grad(x.sum(), args)
    for i, row in enumerate(rows):
        u, mean, std, low, high = map(mp.mpf, row)
        assert low <= x[i].item() <= high
        a, b, got = (low - mean) / std, (high - mean) / std, (mp.mpf(x[i].item()) - mean) / std
        whole = mass(a, b)
        rounding = mp.npdf(got) / whole / std * abs(x[i].item()) * 2.3e-16  # of x itself
        assert abs(mass(a, got) / whole - u) < 5e-13 + rounding, row
        z = exact_root(u, a, b, got)
        along_a, along_b = (1 - u) * mp.npdf(a) / mp.npdf(z), u * mp.npdf(b) / mp.npdf(z)
        truth = (std * whole / mp.npdf(z), 1 - along_a - along_b, z - along_a * a - along_b * b, along_a, along_b)
        for name, gradient, exact in zip(("u", "mean", "std", "low", "high"), grads, truth, strict=True):
            assert abs(gradient[i].item() - exact) < 1e-9 * (1 + abs(exact)), (name, row)


def test_truncated_normal_icdf_modes_agree() -> None:
    args = tuple(f64(column) for column in zip(*truncated_cases(60), strict=True))
    for k in range(5):
        forward = jacfwd(lambda *t: special.truncated_normal_icdf(*t).sum(), argnums=k)(*args)
        reverse = jacrev(lambda *t: special.truncated_normal_icdf(*t).sum(), argnums=k)(*args)
        mapped = vmap(torch.func.grad(special.truncated_normal_icdf, argnums=k))(*args)
        torch.testing.assert_close(forward, reverse, rtol=1e-8, atol=1e-12)
        torch.testing.assert_close(forward, mapped, rtol=1e-8, atol=1e-12)
    with torch.no_grad():
        plain = special.truncated_normal_icdf(*args)
    tracked = special.truncated_normal_icdf(*(t.clone().requires_grad_() for t in args))
    assert torch.equal(plain, tracked.detach())
    assert torch.equal(plain, vmap(special.truncated_normal_icdf)(*args))


def test_truncated_normal_log_prob_value_and_gradient() -> None:
    rows = truncated_cases()
    u, *args = (f64(column).requires_grad_() for column in zip(*rows, strict=True))
    x = special.truncated_normal_icdf(u, *args).detach().requires_grad_()
    value = special.truncated_normal_log_prob(x, *args)
    grads = torch.autograd.grad(value.sum(), (x, *args))
    for i, row in enumerate(rows):
        _, mean, std, low, high = map(mp.mpf, row)
        a, b, z = (low - mean) / std, (high - mean) / std, (mp.mpf(x[i].item()) - mean) / std
        whole = mass(a, b)
        truth = mp.log(mp.npdf(z) / whole / std)
        assert abs(value[i].item() - truth) < 2e-12 * (1 + abs(truth)), row
        pa, pb = mp.npdf(a) / whole, mp.npdf(b) / whole
        exact = (-z / std, (z - pa + pb) / std, (z * z - 1 - a * pa + b * pb) / std, pa / std, -pb / std)
        for name, gradient, slope in zip(("x", "mean", "std", "low", "high"), grads, exact, strict=True):
            assert abs(gradient[i].item() - slope) < 1e-9 * (1 + abs(slope)), (name, row)


def test_truncated_normal_log_prob_outside_is_minus_infinity_with_zero_gradient() -> None:
    points, mean = f64([-2.0, 0.0, 2.0]), f64(0.1).requires_grad_()
    value = special.truncated_normal_log_prob(points, mean, f64(0.3), f64(-1.0), f64(1.0))
    assert value[0] == -INF and value[2] == -INF and value[1].isfinite()
    slopes = [torch.autograd.grad(v, mean, retain_graph=True)[0].item() for v in value]
    assert slopes[0] == 0 and slopes[2] == 0 and slopes[1] != 0


@pytest.mark.parametrize("std", [1e-4, 1e-2, 0.3, 10.0, 100.0])
def test_float32_truncated_normal(std: float) -> None:
    generator = torch.Generator().manual_seed(0)
    u = torch.rand(2000, generator=generator).clamp(1e-6, 1 - 1e-6)
    low = torch.linspace(-1.57, 0.0, 8)[:, None]
    args = (torch.tensor(-0.13), torch.tensor(std), low, low + math.pi / 2)
    for t in args[:2]:
        t.requires_grad_()
    x = special.truncated_normal_icdf(u, *args)
    assert x.dtype == torch.float32
    exact = special.truncated_normal_icdf(u.double(), *(t.detach().double() for t in args))
    # what an error of u by an ulp does to x, in the flattest place that was drawn
    torch.testing.assert_close(x.detach().double(), exact, rtol=0, atol=2e-6 + 2e-5 * min(std, 1.0))
    value = special.truncated_normal_log_prob(x.detach(), *args)
    for result in (x, value):
        assert all(g.isfinite().all() for g in torch.autograd.grad(result.sum(), args[:2], retain_graph=True))


def test_edges_of_u_stay_finite() -> None:
    for dtype in (torch.float64, torch.float32):
        u = torch.tensor([0.0, torch.finfo(dtype).tiny, 0.5, 1.0], dtype=dtype)
        std = torch.tensor(0.2, dtype=dtype, requires_grad=True)
        end = torch.tensor(1.0, dtype=dtype)
        x = special.truncated_normal_icdf(u, 0 * end, std, -end, end)
        assert x.isfinite().all() and torch.autograd.grad(x.sum(), std)[0].isfinite()


def wrapped(x: float, std: float) -> mp.mpf:
    x, std = mp.mpf(x), mp.mpf(std)
    turns = int(mp.ceil(12 * std / (2 * mp.pi))) + 2
    images = [mp.exp(-((x + 2 * mp.pi * k) ** 2) / (2 * std**2)) for k in range(-turns, turns + 1)]
    return mp.fsum(images) / (std * mp.sqrt(2 * mp.pi))


def test_wrapped_normal_value_and_gradient() -> None:
    stds = [1e-3, 0.05, 0.5, 0.99, 1.0, 1.01, 1.5, 1.99, 2.0, 2.01, 3.0, 10.0, 50.0]
    angles = [-3.14, -2.0, -0.3, 0.0, 1e-3, 1.0, 3.0, 3.1415]
    x, s = (t.reshape(-1).clone().requires_grad_() for t in torch.meshgrid(f64(angles), f64(stds), indexing="ij"))
    value = special.wrapped_normal_log_prob(x, s)
    grads = torch.autograd.grad(value.sum(), (x, s))
    for i in range(len(x)):
        point, std = x[i].item(), s[i].item()
        density = wrapped(point, std)
        truth = mp.log(density)
        assert abs(value[i].item() - truth) < 1e-13 * (1 + abs(truth)), (point, std)
        step, floor = mp.mpf(10) ** -20, 1e-15 + 4e-16 * (math.pi / std**2) ** 2 * abs(point)  # rounding of pi - x
        for gradient, slope in (
            (grads[0][i], (wrapped(point + step, std) - wrapped(point - step, std)) / (2 * step * density)),
            (grads[1][i], (wrapped(point, std + step) - wrapped(point, std - step)) / (2 * step * density)),
        ):
            assert abs(gradient.item() - slope) < 1e-12 * (1 + abs(slope)) + floor, (point, std)
    mapped = vmap(torch.func.grad(special.wrapped_normal_log_prob, argnums=1))(x.detach(), s.detach())
    torch.testing.assert_close(mapped, grads[1], rtol=1e-9, atol=1e-14)
    forward = jacfwd(lambda t: special.wrapped_normal_log_prob(x.detach(), t).sum())(s.detach())
    torch.testing.assert_close(forward, grads[1], rtol=1e-9, atol=1e-14)


def test_log_gauss() -> None:
    x, s = f64([0.0, 0.3, -2.0]), f64([0.1, 1.0, 3.0])
    exact = torch.distributions.Normal(f64(0.0), s).log_prob(x)
    torch.testing.assert_close(special.log_gauss(x, s), exact, rtol=1e-14, atol=1e-14)
