"""Expected crossings against analytic chords, rules for the lit share, hints."""

from __future__ import annotations

import math

import pytest
import torch
from scipy.special import expn
from torch import Tensor

from dsfit.context import Context
from dsfit.errors import InputError
from dsfit.frame import HALF_PI, to_angles, to_vector
from dsfit.scene import ConstantScattering, SlabScattering, SphereScattering

CONTEXT = Context(0.3, 1.0, n=2.5, v=0.25)


def directions(count: int = 500, seed: int = 0) -> Tensor:
    g = torch.Generator().manual_seed(seed)
    v = torch.randn(count, 3, generator=g, dtype=torch.float64)
    return to_angles(v / v.norm(dim=-1, keepdim=True))


SCATTERINGS = {
    "constant": lambda: ConstantScattering(3.0, "poisson"),
    "slab": lambda: SlabScattering(2.0, 0.5, 3.0, (1.0, 2.0, -0.5)),
    "slab surface": lambda: SlabScattering(2.0, 0.0, 3.0, (1.0, 0.0, 0.0)),
    "half-space": lambda: SlabScattering(math.inf, 0.5, 3.0, aligned=True),
    "empty half-space": lambda: SlabScattering(math.inf, 0.5, 0.0),
    "sphere": lambda: SphereScattering(1.5, 2.0, (0.3, -0.9, 0.4)),
    "sphere surface": lambda: SphereScattering(1.0, 2.0, (0.0, 0.6, 0.8), aligned=True),
    "sphere centre": lambda: SphereScattering(1.0, 2.0, v="threshold"),
}


def test_slab_is_distance_over_cosine_away_from_the_horizon() -> None:
    omega = directions()
    normal = torch.tensor([1.0, 2.0, -0.5], dtype=torch.float64)
    cosine = to_vector(omega) @ (normal / normal.norm())
    truth = 3.0 * torch.where(cosine > 0, 0.5, 1.5) / cosine.abs()
    n, v = SlabScattering(2.0, 0.5, 3.0, normal, max_n=1e5)(omega, CONTEXT)
    near = truth < 100
    assert torch.allclose(n[near], truth[near], rtol=1e-6)
    assert torch.allclose(v, torch.exp(-n))
    # The documented price of the limit, to leading order.
    capped, _ = SlabScattering(2.0, 0.5, 3.0, normal, max_n=1e2)(omega, CONTEXT)
    assert torch.allclose(capped, truth / torch.sqrt(1 + (truth / 100) ** 2), rtol=1e-12)
    assert capped.max() <= 100


def test_slab_is_smooth_through_the_horizon() -> None:
    slab = SlabScattering(2.0, 0.5, 3.0, (1.0, 0.0, 0.0), max_n=50.0)
    theta = torch.tensor([-1e-6, -1e-9, 0.0, 1e-9, 1e-6], dtype=torch.float64, requires_grad=True)
    n, _ = slab(torch.stack([theta, torch.zeros_like(theta)], -1), CONTEXT)
    assert torch.allclose(n, torch.full_like(n, 50.0), rtol=1e-8)
    (slope,) = torch.autograd.grad(n.sum(), theta)
    assert slope.abs().max() < 0.1 and slope[2] == 0
    # At the surface n is 0 above the horizon, exactly, and v = 1 there.
    surface = SlabScattering(2.0, 0.0, 3.0, (1.0, 0.0, 0.0))
    n, v = surface(torch.tensor([[0.2, 0.0], [-0.2, 0.0]], dtype=torch.float64), CONTEXT)
    assert n[0] == 0 and v[0] == 1 and n[1] > 20


def test_sphere_chord_ends_on_the_surface() -> None:
    for radius, offset in (
        (1.5, (0.3, -0.9, 0.4)),
        (1.0, (0.0, 0.6, 0.8)),
        (1.0, (0.0, 0.0, 0.0)),
        (1.0, (1 - 1e-12, 0, 0)),
    ):
        omega = directions()
        chord, _ = SphereScattering(radius, 1.0, offset)(omega, CONTEXT)
        end = torch.tensor(offset, dtype=torch.float64) + chord[:, None] * to_vector(omega)
        assert torch.allclose(end.norm(dim=-1), torch.full_like(chord, radius), rtol=1e-12)
        assert (chord >= 0).all()
    # Just below the surface the chord outward is what is left of the radius, to all digits.
    n, _ = SphereScattering(1.0, 1.0, (0.0, 1 - 1e-12, 0.0))(torch.zeros(1, 2, dtype=torch.float64), CONTEXT)
    assert n.item() == pytest.approx(1 - (1 - 1e-12), rel=1e-12)
    # From the surface outward there is nothing; straight through there is a diameter.
    n, v = SphereScattering(1.0, 2.0, (0.0, 1.0, 0.0))(
        torch.tensor([[0.0, 0.0], [0.0, math.pi]], dtype=torch.float64), CONTEXT
    )
    assert n.tolist() == [0.0, 4.0] and v[0] == 1


def test_aligned_strands_are_crossed_by_the_sine_of_the_angle() -> None:
    omega = directions()
    for make in (lambda a: SphereScattering(1.5, 2.0, (0.3, -0.9, 0.4), aligned=a),):
        assert torch.allclose(make(True)(omega, CONTEXT)[0], make(False)(omega, CONTEXT)[0] * torch.cos(omega[:, 0]))
    slab = [SlabScattering(2.0, 0.5, 3.0, max_n=1e9, aligned=a)(omega, CONTEXT)[0] for a in (True, False)]
    assert torch.allclose(slab[0], slab[1] * torch.cos(omega[:, 0]), rtol=1e-6)


def test_rules_for_the_lit_share() -> None:
    omega = directions()
    for rule, truth in (
        ("poisson", lambda n: torch.exp(-n)),
        ("threshold", lambda n: (n <= 0.5).double()),
        (0.3, lambda n: 0.3 + 0.7 * (n == 0).double()),
    ):
        n, v = SphereScattering(1.0, 0.5, (0.0, 1.0, 0.0), v=rule)(omega, CONTEXT)
        assert torch.allclose(v, truth(n), rtol=1e-15) and (v[n == 0] == 1).all() and (n == 0).any()


def test_constant_scattering_and_the_hints_of_the_context() -> None:
    omega = directions(7)
    for scattering, n, v in (
        (ConstantScattering(), 2.5, 0.25),
        (ConstantScattering(4.0), 4.0, 0.0),
        (ConstantScattering(0.0), 0.0, 1.0),
        (ConstantScattering(4.0, 0.5), 4.0, 0.5),
        (ConstantScattering(None, 0.5), 2.5, 0.5),
        (ConstantScattering(None, "poisson"), 2.5, math.exp(-2.5)),
    ):
        got = scattering(omega, CONTEXT)
        assert got[0].shape == got[1].shape == (7,)
        assert torch.allclose(got[0], torch.full_like(got[0], n)) and torch.allclose(got[1], torch.full_like(got[1], v))
    n, v = ConstantScattering(None, 0.5)(omega[:, None], Context(torch.zeros(3), n=torch.tensor([0.0, 1.0, 2.0])))
    assert n.shape == (7, 3) and v[0].tolist() == [1.0, 0.5, 0.5]


@pytest.mark.parametrize("name", SCATTERINGS)
def test_hints(name: str) -> None:
    scattering = SCATTERINGS[name]()
    context = Context(
        torch.tensor([[0.3, -1.0, 0.0]], dtype=torch.float64), torch.tensor([[1.0], [2.0]], dtype=torch.float64)
    )
    for how in ("transmitted", "mean", "forward"):
        hinted = scattering.hints(context, how)
        assert hinted.batch_shape == (2, 3) and torch.equal(hinted.theta_r, context.theta_r)
        if name in ("constant", "sphere centre", "empty half-space"):
            n, v = scattering(directions(1), CONTEXT)
            assert torch.allclose(hinted.n, n, rtol=1e-12) and torch.allclose(hinted.v, v, rtol=1e-12)
    forward = scattering.hints(context, "forward")
    n, v = scattering(to_angles(-to_vector(torch.stack([context.theta_r, context.phi_r], -1))), context)
    assert torch.allclose(forward.n, n, rtol=1e-9) and torch.allclose(forward.v, v, rtol=1e-9)


def test_transmitted_hint_is_the_mean_transmittance() -> None:
    """Below a half-space, the mean of exp(-tau / cos) over the sphere is E_2(tau) / 2."""
    hinted = SlabScattering(math.inf, 0.5, 2.0, (1.0, 0.0, 0.0), max_n=1e4).hints(Context(0.1))
    assert hinted.n.item() == pytest.approx(-math.log(expn(2, 1.0) / 2), rel=2e-3)
    assert hinted.v.item() == pytest.approx(expn(2, 1.0) / 2, rel=2e-3)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("name", SCATTERINGS)
def test_values_and_gradients_are_finite_everywhere(name: str, dtype: torch.dtype) -> None:
    scattering = SCATTERINGS[name]()
    special = [
        [HALF_PI, 0.0],
        [-HALF_PI, 0.0],
        [0.0, math.pi],
        [0.0, HALF_PI],
        [0.0, 0.0],
        [0.0, -HALF_PI],
        [0.3, HALF_PI],
    ]
    omega = torch.cat([directions(), torch.tensor(special, dtype=torch.float64)]).to(dtype).requires_grad_()
    n, v = scattering(omega, CONTEXT.to(dtype))
    assert n.dtype == v.dtype == dtype and (n >= 0).all() and ((v >= 0) & (v <= 1)).all() and (v[n == 0] == 1).all()
    assert torch.isfinite(n).all()
    if n.requires_grad:
        (gradient,) = torch.autograd.grad((n + v).sum(), omega)
        assert torch.isfinite(gradient).all()
    if dtype == torch.float32:
        exact, _ = SCATTERINGS[name]()(omega.detach().double(), CONTEXT)
        assert torch.allclose(n.double(), exact, rtol=1e-4, atol=1e-5)


def test_gradients_reach_the_parameters() -> None:
    omega = directions(6)

    def slab(thickness: Tensor, depth: Tensor, density: Tensor, normal: Tensor) -> Tensor:
        return SlabScattering(thickness, depth, density, normal)(omega, CONTEXT)[0]

    def sphere(radius: Tensor, density: Tensor, offset: Tensor) -> Tensor:
        return SphereScattering(radius, density, offset)(omega, CONTEXT)[1]

    def leaf(value) -> Tensor:
        return torch.tensor(value, dtype=torch.float64, requires_grad=True)

    assert torch.autograd.gradcheck(slab, (leaf(2.0), leaf(0.5), leaf(3.0), leaf([1.0, 2.0, -0.5])))
    assert torch.autograd.gradcheck(sphere, (leaf(1.5), leaf(0.7), leaf([0.3, -0.9, 0.4])))


def test_parameters_follow_the_batch_of_contexts() -> None:
    context = Context(torch.zeros(4, dtype=torch.float64))
    depth = torch.tensor([0.1, 0.2, 0.3, 0.4], dtype=torch.float64)
    normal = torch.randn(4, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    omega = directions(20).reshape(5, 4, 2)
    n, v = SlabScattering(1.0, depth, 2.0, normal)(omega, context)
    offsets = 0.4 * normal / normal.norm(dim=-1, keepdim=True)
    m, _ = SphereScattering(1.0, 2.0, offsets)(omega, context)
    assert n.shape == v.shape == m.shape == (5, 4)
    for k in range(4):
        assert torch.allclose(n[:, k], SlabScattering(1.0, depth[k], 2.0, normal[k])(omega[:, k], CONTEXT)[0])
        assert torch.allclose(m[:, k], SphereScattering(1.0, 2.0, offsets[k])(omega[:, k], CONTEXT)[0])


def test_breakpoints_lie_on_the_horizon() -> None:
    for scattering, axis in (
        (SlabScattering(1.0, 0.5, 1.0, (0.3, 2.0, -0.5)), (0.3, 2.0, -0.5)),
        (SphereScattering(1.0, 1.0, (0.6, -0.5, 0.1)), (0.6, -0.5, 0.1)),
    ):
        thetas, phis = scattering.breakpoints()
        axis = torch.tensor(axis, dtype=torch.float64)
        equator = to_vector(torch.tensor([[0.0, phi] for phi in phis], dtype=torch.float64)) @ axis
        assert (equator.abs() < 1e-12).sum() == 2
        grid = torch.linspace(-math.pi, math.pi, 2001, dtype=torch.float64)
        for theta, sign in ((thetas[0], 1), (thetas[-1], -1)):
            # At its extreme inclination the circle touches that parallel: the dot product has one sign, and reaches 0.
            product = to_vector(torch.stack([torch.full_like(grid, theta), grid], -1)) @ axis
            product = product * sign * (1 if axis[0] < 0 else -1)
            assert product.min().abs() < 1e-5 and product.max() > 0.1
    assert SlabScattering(1.0, 0.5, 1.0, (1.0, 0.0, 0.0)).breakpoints() == ([0.0], [])
    assert SphereScattering(1.0, 1.0).breakpoints() == ([], [])


@pytest.mark.parametrize(
    ("build", "field"),
    [
        (lambda: ConstantScattering(-1.0), "n"),
        (lambda: ConstantScattering(1.0, 1.5), "v"),
        (lambda: ConstantScattering(0.0, 0.5), "v"),
        (lambda: ConstantScattering(1.0, "always"), "v"),
        (lambda: SlabScattering(0.0, 0.0, 1.0), "thickness"),
        (lambda: SlabScattering(math.nan, 0.0, 1.0), "thickness"),
        (lambda: SlabScattering(1.0, 1.5, 1.0), "depth"),
        (lambda: SlabScattering(1.0, 0.5, -1.0), "density"),
        (lambda: SlabScattering(1.0, 0.5, 1.0, (0.0, 0.0, 0.0)), "normal"),
        (lambda: SlabScattering(1.0, 0.5, 1.0, (0.0, 1.0)), "normal"),
        (lambda: SlabScattering(1.0, 0.5, 1.0, max_n=0.0), "max_n"),
        (lambda: SphereScattering(0.0, 1.0), "radius"),
        (lambda: SphereScattering(1.0, math.inf), "density"),
        (lambda: SphereScattering(1.0, 1.0, (1.0, 0.1, 0.0)), "offset"),
        (lambda: SphereScattering(1.0, 1.0).hints(CONTEXT, "best"), "how"),
    ],
)
def test_bad_input_is_named(build, field: str) -> None:
    with pytest.raises(InputError) as caught:
        build()
    assert caught.value.field == field
