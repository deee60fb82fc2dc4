"""Suns, spheres, rectangles and rings: what every sampler is held to, in both dtypes."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from dsfit.context import Context
from dsfit.errors import InputError
from dsfit.frame import to_angles, to_vector
from dsfit.scene import Light, RectangleLight, RingLight, SphereLight
from tests.scene.lights.cases import CONTEXT, EMITTERS, RGB, TINY, cell_edges, cell_mass, total, turn, uniforms
from tests.scene.test_lights import chi_square

SAMPLES = 100_000
SIDAK = 1 - (1 - 0.01) ** (1 / (2 * len(EMITTERS)))
DTYPES = (torch.float64, torch.float32)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", EMITTERS)
def test_samples_follow_the_density(name: str, dtype: torch.dtype) -> None:
    light = EMITTERS[name]()
    dist = light.proposal()(CONTEXT.to(dtype))
    omega, log_prob = dist.sample_with_log_prob(uniforms(SAMPLES, 2, dtype=dtype))
    assert omega.dtype == log_prob.dtype == dtype
    tolerance = 1e-8 if dtype == torch.float64 else 2e-2
    torch.testing.assert_close(dist.log_prob(omega), log_prob, rtol=0, atol=tolerance)
    edges = cell_edges(light)
    mass = cell_mass(light, dist.log_prob, *edges)
    # a ring's density has kinks at the knots of its table, which this quadrature does not follow
    assert abs(float(mass.sum()) - 1) < (3e-5 if name.startswith(("ring", "disc")) else 1e-6)
    assert chi_square(omega, mass, *edges) > SIDAK
    if name not in TINY:
        wrong = cell_mass(light, dist.log_prob, *edges, jacobian=False)
        assert chi_square(omega, wrong, *edges) < 1e-6


@pytest.mark.parametrize("name", ["rectangle close", "ring close", "rectangle grazing", "ring around"])
def test_samples_uniform_in_area_are_rejected(name: str) -> None:
    """The Jacobian left out: points drawn evenly on the emitter, taken for even in solid angle."""
    light = EMITTERS[name]()
    u = uniforms(SAMPLES, 2)
    if isinstance(light, RectangleLight):
        point = light.corner + (u * light.sides) @ light.axes[:2]
    else:
        assert isinstance(light, RingLight)
        r = torch.sqrt(light.inner**2 + u[:, :1] * (light.outer**2 - light.inner**2))
        psi = 2 * math.pi * u[:, 1:]
        point = light.center + r * torch.cat([torch.cos(psi), torch.sin(psi), 0 * psi], dim=-1)
    omega = to_angles(light.to_fibre(point))
    assert (light(omega) > 0).all()
    edges = cell_edges(light)
    assert chi_square(omega, cell_mass(light, light.proposal()(CONTEXT).log_prob, *edges), *edges) < 1e-6


def places(count: int) -> tuple[Tensor, Tensor]:
    """Positions near and far, in planes and on axes, with frames."""
    g = torch.Generator().manual_seed(9)
    position = torch.randn(count, 3, generator=g, dtype=torch.float64)
    position = position * 10 ** (4 * torch.rand(count, 1, generator=g, dtype=torch.float64) - 2)
    position[: count // 8, 2] = 1e-4 * position[: count // 8, 2]
    position[:4] = torch.tensor([[0.0, 0, 0], [0, 0, 1.0], [3.0, 0.2, 0], [0.3, 0.1, 1e-9]], dtype=torch.float64)
    q, r = torch.linalg.qr(torch.randn(count, 3, 3, generator=g, dtype=torch.float64))
    return position, q * torch.sign(torch.linalg.det(q))[:, None, None]


NEARBY = {
    "sphere": lambda: SphereLight([0.1, 0.2, 0.3], 0.4, RGB),
    "sphere small": lambda: SphereLight([0.1, 0.2, 0.3], 1e-5, RGB),
    "rectangle": lambda: RectangleLight([-0.5, -0.5, 0.0], [1, 0, 0], [0, 2, 0], RGB, two_sided=True),
    "rectangle small": lambda: RectangleLight([-0.5, -0.5, 0.0], [1e-5, 0, 0], [0, 1e-3, 0], RGB, two_sided=True),
    "ring": lambda: RingLight([0.0, 0.0, 0.0], [0, 0, 1], 0.5, 1.0, RGB, two_sided=True),
    "ring small": lambda: RingLight([0.1, 0.0, 0.0], [0, 0, 1], 1e-5, 3e-5, RGB, two_sided=True),
    "total": total,
}


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", NEARBY)
def test_what_is_drawn_is_lit(name: str, dtype: torch.dtype) -> None:
    """After rounding too: finite weights, and no radiance where the density is zero, from 2000 points."""
    position, frame = places(2000)
    light = NEARBY[name]().placed(position, frame)
    dist = light.proposal()(Context(torch.zeros(2000, dtype=dtype)))
    u = uniforms(40, 2000, dist.dimension, dtype=dtype)
    u[:20] = torch.round(u[:20] * 4) / 4  # ends and middle of the range
    omega, log_prob = dist.sample_with_log_prob(u)
    again = dist.log_prob(omega)
    radiance = light(omega)
    assert bool(log_prob.isfinite().all()) and bool(again.isfinite().all())
    dark = (radiance == 0).all(-1)
    seen = dist.log_prob(torch.zeros_like(omega)).exp() < 0.0795774  # in the plane all directions have 1 / (4 pi)
    seen = seen | (dist.log_prob(torch.full_like(omega, 1.0)).exp() < 0.0795774)
    assert not bool((dark & seen).any())
    assert float((again - log_prob).abs().double().mean()) < (1e-9 if dtype == torch.float64 else 1e-3)
    # directions about those drawn, across the edges
    beside = omega + 1e-6 * (2 * uniforms(*omega.shape, seed=4, dtype=dtype) - 1)
    lit = (light(beside) > 0).any(-1)
    assert bool(dist.log_prob(beside)[lit].isfinite().all())


@pytest.mark.parametrize("name", NEARBY)
def test_a_batch_is_its_parts(name: str) -> None:
    position, frame = places(12)
    whole = NEARBY[name]().placed(position, frame)
    dist = whole.proposal()(Context(torch.zeros(12, dtype=torch.float64)))
    u = uniforms(30, 12, dist.dimension)
    omega, log_prob = dist.sample_with_log_prob(u)
    picked = dist.select(lambda x: x.reshape(-1)[torch.tensor([7, 4, 4])])
    assert picked is not None and picked.batch_shape == (3,)
    again, log_again = picked.sample_with_log_prob(u[:, [7, 4, 4]])
    torch.testing.assert_close((again, log_again), (omega[:, [7, 4, 4]], log_prob[:, [7, 4, 4]]))
    for k in range(12):
        alone = NEARBY[name]().placed(position[k], frame[k])
        drawn, log_drawn = alone.proposal()(Context(0.0)).sample_with_log_prob(u[:, k])
        torch.testing.assert_close((drawn, log_drawn), (omega[:, k], log_prob[:, k]), rtol=1e-9, atol=1e-9)
        torch.testing.assert_close(alone(omega[:, k]), whole(omega)[:, k])
        # a frame turns what the world shows
        world = NEARBY[name]().placed(position[k], torch.eye(3, dtype=torch.float64))
        turned = to_angles(to_vector(drawn) @ frame[k])
        assert float(((world(turned) - alone(drawn)).abs() > 1e-12).double().mean()) < 0.04  # edges round otherwise
    with pytest.raises(InputError, match="rotation|position"):
        whole.breakpoints()


def power_at(light: Light, position: Tensor) -> Tensor:
    return light.placed(position, turn(1)).power()


@pytest.mark.parametrize("name", NEARBY)
def test_gradients_are_finite_everywhere(name: str) -> None:
    position, frame = places(64)
    position = torch.cat([position, torch.tensor([[0.1, 0.2, 0.3], [0.5, 0.2, 0.3], [0.1, 0.6, 0.3]]).double()])
    frame = torch.cat([frame, frame[:3]])
    position.requires_grad_()
    light = NEARBY[name]().placed(position, frame)
    dist = light.proposal()(Context(torch.zeros(67, dtype=torch.float64)))
    u = uniforms(5, 67, dist.dimension).requires_grad_()
    omega, log_prob = dist.sample_with_log_prob(u)
    for value in (omega.sum(), log_prob.sum(), dist.log_prob(omega.detach()).sum(), light.power().sum()):
        found = torch.autograd.grad(value, [position, u], retain_graph=True, allow_unused=True)
        assert all(bool(x.isfinite().all()) for x in found if x is not None)


def test_gradients_of_power_and_radiance() -> None:
    """Solid angles against finite differences in the position; radiance passes straight through."""
    for name in ("sphere", "rectangle", "ring"):
        place = torch.tensor([0.7, -0.3, 1.1], dtype=torch.float64, requires_grad=True)
        assert torch.autograd.gradcheck(lambda x, name=name: power_at(NEARBY[name](), x), place)
    radiance = torch.tensor(RGB, dtype=torch.float64, requires_grad=True)
    light = SphereLight([0.0, 1.0, 2.0], 0.5, radiance)
    omega = light.proposal()(CONTEXT).sample(uniforms(10, 2))
    (gradient,) = torch.autograd.grad(light(omega).sum(), radiance)
    torch.testing.assert_close(gradient, torch.full_like(gradient, 10.0))


def test_density_gradient_in_the_position() -> None:
    """log p at a direction well inside moves with the position as the solid angle does."""
    place = torch.tensor([0.2, -0.3, 1.1], dtype=torch.float64, requires_grad=True)
    for name in ("sphere", "rectangle", "ring"):
        inside = NEARBY[name]().placed(place.detach(), turn(1)).proposal()(CONTEXT).sample(uniforms(8, 2))

        def log_prob(x: Tensor, name: str = name, inside: Tensor = inside) -> Tensor:
            return NEARBY[name]().placed(x, turn(1)).proposal()(CONTEXT).log_prob(inside)

        assert torch.autograd.gradcheck(log_prob, place, eps=1e-7, atol=1e-5)
