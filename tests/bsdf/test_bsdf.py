"""Properties of the BSDF that hold whatever the oracle says: energy, symmetry, shares, gradients, batches."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

import dsfit
from dsfit.bsdf import CONSISTENT, PRINTED
from dsfit.bsdf.azimuthal import support_edges
from dsfit.bsdf.backscatter import back_shift, back_width, backscatter_albedo
from dsfit.frame import cos_inclination
from dsfit.quadrature import gauss_legendre, panel_points

DEG = math.pi / 180
PRESETS = dsfit.Fiber.presets()


def directions(count: int, seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    g = torch.Generator().manual_seed(seed)
    theta_i, theta_r = ((torch.rand(count, generator=g, dtype=torch.float64) * 2 - 1) * 1.5 for _ in range(2))
    return theta_i, theta_r, (torch.rand(count, generator=g, dtype=torch.float64) * 2 - 1) * math.pi


@pytest.mark.parametrize("model", ["marschner", "raw", "simplified"])
@pytest.mark.parametrize("name", ["nonabsorbing", "brown"])
def test_scattered_azimuth_keeps_the_energy(name: str, model: str) -> None:
    """int N^G dphi = int N dphi for every lobe, by quadrature in phi that follows the edges."""
    bsdf = dsfit.DualScattering(dsfit.Fiber.preset(name), azimuthal=model)
    diff = torch.tensor([0.0, 0.4, 0.95, 1.4], dtype=torch.float64)
    edges = support_edges(bsdf.fiber, diff)
    shifted = torch.cat([(edges - math.pi / 2).abs(), math.pi - (edges - math.pi / 2).abs()], dim=-1)
    breaks = torch.cat([edges, shifted, torch.tensor([0.0, 0.25, 0.5, 0.75, 1.0]).expand(4, -1) * math.pi], dim=-1)
    breaks = torch.sort(breaks, dim=-1).values
    s, w = panel_points(torch.linspace(0, 1, breaks.shape[-1], dtype=torch.float64), 24)
    cell = (s * (breaks.shape[-1] - 1)).long()
    t = s * (breaks.shape[-1] - 1) - cell
    width = breaks[:, cell + 1] - breaks[:, cell]
    phi = breaks[:, cell] + width * torch.sin(math.pi / 2 * t) ** 2
    weight = w * (breaks.shape[-1] - 1) * width * (math.pi / 2) * torch.sin(math.pi * t)
    plain = (bsdf.azimuthal(diff[:, None], phi) * weight[..., None, None]).sum(1)
    averaged = (bsdf.azimuthal_scattered(diff[:, None], phi) * weight[..., None, None]).sum(1)
    torch.testing.assert_close(averaged, plain, rtol=2e-6, atol=1e-9)


@pytest.mark.parametrize("name", PRESETS)
def test_energy_and_back_scattering_are_bounded(name: str) -> None:
    bsdf = dsfit.DualScattering(dsfit.Fiber.preset(name))
    average = bsdf.averages(torch.linspace(-1.5707, 1.5707, 501, dtype=torch.float64))
    assert bool((average.a_f + average.a_b <= 1).all()) and bool((average.a_f > 0).all())
    assert bool((average.A_b >= 0).all()) and bool((average.A_b <= 0.625).all())
    assert bool((average.sigma_b > 0).all())


def test_single_scattering_is_reciprocal() -> None:
    """S(theta_i, theta_r, phi) = S(theta_r, theta_i, -phi): theta_h is symmetric, theta_diff and phi enter evenly."""
    bsdf = dsfit.DualScattering(dsfit.Fiber.preset("blond"))
    theta_i, theta_r, phi = directions(200)
    torch.testing.assert_close(bsdf.single(theta_i, theta_r, phi), bsdf.single(theta_r, theta_i, -phi))


def test_shares_and_limits() -> None:
    bsdf = dsfit.DualScattering(dsfit.Fiber.preset("blond"))
    theta_i, theta_r, phi = directions(100)
    cosine = cos_inclination(theta_i)[:, None]
    direct, deep = bsdf.direct(theta_i, theta_r, phi), bsdf.scatter(theta_i, theta_r, phi, 4.0)
    torch.testing.assert_close(bsdf(theta_i, theta_r, phi), direct * cosine)
    torch.testing.assert_close(bsdf(theta_i, theta_r, phi, 4.0), deep * cosine)
    mixed = bsdf(theta_i, theta_r, phi, 4.0, 0.3)
    torch.testing.assert_close(mixed, (0.3 * direct + 0.7 * deep) * cosine)
    assert bool((mixed >= 0).all())
    without = bsdf.replace(d_b=0.0).direct(theta_i, theta_r, phi)
    torch.testing.assert_close(without, bsdf.single(theta_i, theta_r, phi))
    back = bsdf.back_scattering(theta_i, theta_r, phi)
    torch.testing.assert_close(direct - without, 0.7 * back, atol=1e-14, rtol=1e-9)
    # n is real: the transmittance is a power, and n = 0 is 1 even for a black fibre
    power = bsdf.transmittance(theta_i, torch.full_like(theta_i, 2.5))
    torch.testing.assert_close(power, 0.7 * bsdf.averages(theta_i).a_f ** 2.5)
    dark = dsfit.DualScattering(dsfit.Fiber.preset("black", sigma_a=[1e4]))
    assert torch.equal(dark.transmittance(theta_i, torch.zeros(100)), torch.full((100, 1), 0.7, dtype=torch.float64))


@pytest.mark.parametrize(("n", "v"), [(0.0, 1.0), (2.5, 0.0), (7.0, 0.4)])
def test_gradients_of_angles_and_scene(n: float, v: float) -> None:
    bsdf = dsfit.DualScattering(dsfit.Fiber.preset("blond"))
    theta_i, theta_r, phi = directions(12, seed=4)
    inputs = [theta_i * 0.8, theta_r * 0.8, phi, torch.full_like(phi, n + 0.5), torch.full_like(phi, v * 0.9 + 0.05)]
    leaves = tuple(x.clone().requires_grad_() for x in inputs)
    assert torch.autograd.gradcheck(lambda *x: bsdf(*x), leaves, eps=1e-6, atol=1e-6, rtol=1e-4)


def _local(parameters: dict[str, Tensor]) -> Tensor:
    """Single scattering and N^G of an eccentric fibre: no averages in it, so it is quick."""
    theta_i, theta_r, phi = (x[:6] * 0.8 for x in directions(6, seed=9))
    angle = torch.full_like(phi, 0.4)
    total: Tensor | float = 0.0
    for model in ("marschner", "simplified"):
        bsdf = dsfit.DualScattering(dsfit.Fiber(**parameters), azimuthal=model, d_b=0.0)
        total = total + bsdf.direct(theta_i, theta_r, phi, phi_h=angle).sum()
        total = total + bsdf.azimuthal_scattered((theta_r - theta_i) / 2, phi, phi_h=angle).sum()
    return torch.as_tensor(total)


def _whole(parameters: dict[str, Tensor]) -> Tensor:
    """All of F, with its averages."""
    theta_i, theta_r, phi = (x[:6] * 0.8 for x in directions(6, seed=9))
    return dsfit.DualScattering(dsfit.Fiber(**parameters))(theta_i, theta_r, phi, 1.5, 0.5).sum()


@pytest.mark.parametrize(
    ("total", "eccentricity", "names"),
    [
        (_local, 0.93, tuple(dsfit.Fiber.preset("blond").parameters())),
        (_whole, 1.0, ("sigma_a", "eta", "alpha", "beta")),
    ],
    ids=["local", "whole"],
)
def test_gradients_of_every_fiber_parameter(total, eccentricity: float, names: tuple[str, ...]) -> None:  # noqa: ANN001
    """Central differences against autograd, one parameter at a time."""
    base = dsfit.Fiber.preset("blond", eccentricity=eccentricity).parameters()
    leaves = {name: base[name].clone().requires_grad_() for name in names}
    found = torch.autograd.grad(total({**base, **leaves}), list(leaves.values()))
    for name, gradient in zip(names, found, strict=True):
        assert bool(gradient.isfinite().all()), name
        step = torch.zeros_like(base[name])
        step.view(-1)[-1] = 1e-5
        with torch.no_grad():
            up, down = (total({**base, name: base[name] + sign * step}) for sign in (1, -1))
        numeric = (up - down) / 2e-5
        torch.testing.assert_close(gradient.reshape(-1)[-1], numeric, rtol=2e-4, atol=2e-6, msg=lambda m, n=name: n + m)


@pytest.mark.parametrize("n", [0.0, 3.0])
def test_float32_follows_float64(n: float) -> None:
    bsdf = dsfit.DualScattering(dsfit.Fiber.preset("brown"))
    angles = directions(500, seed=2)
    exact = bsdf(*angles, n)
    single = bsdf(*(x.float() for x in angles), n)
    assert single.dtype == torch.float32
    assert float((single - exact).abs().max() / exact.max()) < 1e-5


def test_batches_of_fibers() -> None:
    names = ("blond", "brown")
    sigma_a = torch.stack([dsfit.Fiber.preset(name).sigma_a for name in names])[:, None]
    eta = torch.tensor([[1.55], [1.4]], dtype=torch.float64)
    both = dsfit.DualScattering(dsfit.Fiber(sigma_a=sigma_a, eta=eta))
    theta_i, theta_r, phi = directions(20)
    for n in (0.0, 2.0):
        found = both(theta_i, theta_r, phi, n)
        assert found.shape == (2, 20, 3)
        for k, name in enumerate(names):
            one = dsfit.DualScattering(dsfit.Fiber.preset(name, eta=eta[k, 0]))
            torch.testing.assert_close(found[k], one(theta_i, theta_r, phi, n), rtol=1e-9, atol=1e-13)


EXTREMES = {
    "needle": {"beta": [0.01 * DEG] * 3},
    "broad": {"beta": [60 * DEG] * 3},
    "opaque": {"sigma_a": [1e4] * 3},
    "thin": {"eta": 1.01},
    "dense": {"eta": 3.0},
    "tilted": {"alpha": [-60 * DEG, 30 * DEG, 80 * DEG]},
    "sharp glint": {"caustic_width": 0.1 * DEG},
}


@pytest.mark.parametrize("overrides", EXTREMES.values(), ids=EXTREMES)
def test_extremes_stay_finite_with_finite_gradients(overrides: dict) -> None:
    bsdf = dsfit.DualScattering(dsfit.Fiber.preset("blond", **overrides))
    edge = 89.999 * DEG
    grid = torch.tensor([-edge, -1.0, 0.0, 0.7, edge], dtype=torch.float64)
    azimuths = torch.tensor([-math.pi, -1.3, 0.0, 0.33, 2.5, math.pi], dtype=torch.float64)
    for n in (0.0, 0.3, 1e4):
        leaves = [x.flatten().clone().requires_grad_() for x in torch.meshgrid(grid, grid, azimuths, indexing="ij")]
        value = bsdf(*leaves, n, 0.5)
        assert bool(value.isfinite().all()) and bool((value >= 0).all())
        for gradient in torch.autograd.grad(value.sum(), leaves):
            assert bool(gradient.isfinite().all())


def test_back_scattering_limits() -> None:
    """A series by hand, the bound 5/8 at a_f -> 1, and a_b = 0."""
    a_f, a_b = torch.tensor(0.7, dtype=torch.float64), torch.tensor(0.2, dtype=torch.float64)
    one = sum(a_b * a_f ** (2 * i) for i in range(1, 200))
    three = sum(
        a_b**3 * a_f ** (2 * (i - j - 1 + k)) for i in range(1, 60) for j in range(i) for k in range(j + 1, 120)
    )
    torch.testing.assert_close(backscatter_albedo(a_f, a_b), one + three, rtol=1e-9, atol=0)
    for gap in (2.0**-10, 2.0**-30, 2.0**-52):
        close = torch.tensor(1.0 - gap, dtype=torch.float64)
        assert abs(float(backscatter_albedo(close, torch.tensor(gap, dtype=torch.float64))) - 0.625) < 2 * gap
    zero = torch.zeros((), dtype=torch.float64)
    beta = torch.tensor(0.1, dtype=torch.float64)
    assert float(backscatter_albedo(a_f, zero)) == 0
    torch.testing.assert_close(back_width(a_f, zero, beta, beta, 0.0), math.sqrt(3) * beta)
    torch.testing.assert_close(back_shift(a_f, zero, beta, zero), 2 * beta / (1 - a_f**2))


def test_conventions() -> None:
    assert dsfit.Convention.named("printed") is not None and dsfit.Convention.named(PRINTED) == PRINTED
    assert dsfit.Convention.named("consistent", shift_sign="plus") != CONSISTENT
    for bad in ({"shift_sign": "up"}, {"nonsense": 1}, {"density_power": 3}, {"inverse_cos2": "yes"}):
        with pytest.raises(dsfit.InputError):
            dsfit.Convention.named("consistent", **bad)
    with pytest.raises(dsfit.InputError, match="convention"):
        dsfit.DualScattering(dsfit.Fiber.preset("blond"), convention="literal")


def test_bad_fibers_are_named() -> None:
    for field, value in {
        "sigma_a": [-0.1, 0, 0], "eta": 1.0, "beta": [0.1, 0.0, 0.1], "eccentricity": 0.7, "alpha": [0.1, 0.2],
        "gamma_tt": float("nan"), "caustic_max_offset": 2.0, "sigma_a ": 1,
    }.items():  # fmt: skip
        with pytest.raises(dsfit.InputError, match="fiber"):
            dsfit.Fiber.preset("blond", **{field: value})
    with pytest.raises(dsfit.InputError, match="blonde"):
        dsfit.Fiber.preset("blonde")


def test_gauss_legendre_is_cached_and_exact() -> None:
    x, w = gauss_legendre(12)
    torch.testing.assert_close((w * x**22).sum(), torch.tensor(2 / 23, dtype=torch.float64))
