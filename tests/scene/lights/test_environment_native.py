"""Environment maps in C++ against the torch code, in float64 on the same float32 numbers."""

from __future__ import annotations

import copy
import math
import pickle

import pytest
import torch
from torch import Tensor

from dsfit.context import Context
from dsfit.frame import to_angles, to_vector
from dsfit.scene import EnvironmentLight
from dsfit.scene.lights import environment_native
from dsfit.scene.lights.environment_native import Prepared
from tests.scene.lights.cases import turn, uniforms

SIZES = [(1, 1, 1), (1, 7, 3), (2, 3, 3), (5, 1, 4), (3, 4, 2), (16, 33, 6), (40, 80, 3), (64, 128, 1)]


@pytest.fixture(autouse=True)
def compiler() -> None:
    if environment_native.library() is None:
        pytest.skip("no C++ compiler")


def picture(height: int, width: int, channels: int = 3, seed: int = 0) -> Tensor:
    return 0.05 + uniforms(height, width, channels, seed=seed).float() ** 4


def black_rows() -> Tensor:
    image = picture(12, 20)
    image[:3] = image[5:7] = image[11:] = 0.0
    image[7, 4:] = 0.0
    return image


def one_texel() -> Tensor:
    image = torch.zeros(30, 60, 3)
    image[11, 59] = 3.0
    return image


def bright_texel() -> Tensor:
    image = picture(60, 120)
    image[0, 3], image[20, 70] = 1e4, 1e6
    return image


MAPS = {
    **{f"{h} x {w} x {c}": picture(h, w, c) for h, w, c in SIZES},
    "black rows": black_rows(),
    "one texel": one_texel(),
    "bright texel": bright_texel(),
}


def frames(count: int) -> Tensor:
    return torch.stack([turn(seed) for seed in range(count)]).float()


def sphere(*shape: int, seed: int = 3) -> Tensor:
    u = uniforms(*shape, 2, seed=seed)
    return torch.stack([torch.asin(2 * u[..., 0] - 1), math.pi * (2 * u[..., 1] - 1)], dim=-1).float()


def is_compiled(light: EnvironmentLight) -> bool:
    held = light.prepared.held
    return held is not None and held[1] is not None


def separation(a: Tensor, b: Tensor) -> Tensor:
    return (to_vector(a.double()) - to_vector(b.double())).norm(dim=-1)


@pytest.mark.parametrize("name", MAPS)
def test_radiance_and_density(name: str) -> None:
    image = MAPS[name]
    light = EnvironmentLight(image, 2.5).rotated(frames(7))
    omega = sphere(500, 7)
    value = light(omega)
    assert is_compiled(light) and value.dtype == torch.float32
    truth = light(omega.double())
    assert value.shape == truth.shape
    # float32 rounds what is between neighbours to 1e-6 of the larger: of the largest here
    assert (value - truth).abs().max() <= 1e-6 * truth.max()
    context = Context(torch.zeros(7))
    found = light.proposal()(context).log_prob(omega)
    known = light.proposal()(context).log_prob(omega.double())
    lit = torch.isfinite(known)
    assert torch.equal(torch.isfinite(found), lit) and torch.equal((value > 0).any(-1), lit) and lit.any()
    assert (found[lit] - known[lit]).abs().max() < 1e-5


@pytest.mark.parametrize("name", MAPS)
def test_the_same_uniforms_give_the_same_directions(name: str) -> None:
    light = EnvironmentLight(MAPS[name]).rotated(frames(7))
    distribution = light.proposal()(Context(torch.zeros(7)))
    u = uniforms(600, 7, 3, seed=2).float()
    u[0], u[1], u[2, :, 0], u[2, :, 1] = 0.0, 1.0, 1.0, 0.0
    omega, log_prob = distribution.sample_with_log_prob(u)
    assert is_compiled(light) and omega.dtype == log_prob.dtype == torch.float32
    clamped = u.double().clamp(torch.finfo(torch.float32).eps / 4, 1 - torch.finfo(torch.float32).eps / 2)
    assert separation(omega, distribution.sample(clamped)).max() < 1e-6
    # the density is that of the direction returned
    assert torch.equal(log_prob, distribution.log_prob(omega))
    known = distribution.log_prob(omega.double())
    assert torch.isfinite(known).all() and (log_prob - known).abs().max() < 1e-5


def test_frames_that_broadcast() -> None:
    """One frame, batches of two dimensions, of one that repeats, and more frames than directions."""
    light = EnvironmentLight(picture(9, 14))
    turns = frames(6)
    shapes = [((), (5, 4)), ((6,), (5, 6)), ((2, 3), (4, 2, 3)), ((2, 1), (4, 2, 3)), ((6,), ()), ((6,), (40, 1))]
    for batch, samples in shapes:
        rotation = turns[: max(math.prod(batch), 1)].reshape(*batch, 3, 3)
        placed = light.rotated(rotation)
        omega = sphere(*samples)
        assert placed(omega).shape == placed(omega.double()).shape
        assert torch.allclose(placed(omega).double(), placed(omega.double()), rtol=0, atol=2e-6)
    strided = sphere(3, 50).transpose(0, 1)
    placed = light.rotated(turns[:3].double())
    assert torch.allclose(placed(strided).double(), light.rotated(turns[:3])(strided.double()), rtol=0, atol=2e-6)
    assert placed(omega[:0, :].expand(0, 3, 2)).shape == (0, 3, 3)
    assert is_compiled(placed)


@pytest.mark.parametrize("name", ["2 x 3 x 3", "16 x 33 x 6", "black rows", "bright texel"])
def test_chi_square(name: str) -> None:
    """Counts in cells of equal solid angle against the density's integral over each, by a fine midpoint rule."""
    light = EnvironmentLight(MAPS[name].clamp_max(20.0), rotation=turn(5))
    distribution = light.proposal()(Context(0.0))
    count, rows, columns, fine = 400_000, 12, 24, 24

    def cell(omega: Tensor) -> Tensor:
        i = ((torch.sin(omega[..., 0].double()) + 1) / 2 * rows).long().clamp(0, rows - 1)
        j = ((omega[..., 1].double() / (2 * math.pi) + 0.5) * columns).long().clamp(0, columns - 1)
        return i * columns + j

    z = (torch.arange(rows * fine, dtype=torch.float64) + 0.5) / (rows * fine) * 2 - 1
    phi = ((torch.arange(columns * fine, dtype=torch.float64) + 0.5) / (columns * fine) - 0.5) * 2 * math.pi
    grid = torch.stack(torch.meshgrid(torch.asin(z), phi, indexing="ij"), dim=-1)
    density = torch.exp(distribution.log_prob(grid)) * (4 * math.pi / (len(z) * len(phi)))
    expected = torch.zeros(rows * columns, dtype=torch.float64).index_add(0, cell(grid).flatten(), density.flatten())
    assert expected.sum().item() == pytest.approx(1.0, abs=2e-3)
    omega = distribution.sample(uniforms(count, 2, seed=11).float())
    assert is_compiled(light)
    counts = torch.bincount(cell(omega), minlength=rows * columns).double()
    expected = expected / expected.sum() * count
    used = expected > 20
    statistic = ((counts - expected) ** 2 / expected)[used].sum().item()
    freedom = int(used.sum()) - 1
    assert abs(statistic - freedom) < 6 * math.sqrt(2 * freedom), (statistic, freedom)


def test_poles_and_seam() -> None:
    light = EnvironmentLight(picture(8, 16))
    edge = torch.tensor([[0.0, 1, 0], [0, -1, 0], [0, 0, -1], [1e-8, 0, -1], [-1e-8, 0, -1], [1e-7, 1, 1e-7]])
    omega = torch.cat([to_angles(edge), torch.tensor([[math.pi / 2, 0.3], [-math.pi / 2, 3.0], [0.1, 9.0]])])
    assert (light(omega) - light(omega.double())).abs().max() < 2e-6
    pole = light.image[0].amin(0), light.image[0].amax(0)
    assert (light(omega)[0] >= pole[0] - 1e-6).all() and (light(omega)[0] <= pole[1] + 1e-6).all()
    distribution = light.proposal()(Context(0.0))
    assert (distribution.log_prob(omega) - distribution.log_prob(omega.double())).abs().max() < 1e-5


def test_where_torch_serves(monkeypatch: pytest.MonkeyPatch) -> None:
    """float64, gradients, transforms, images beyond float32, and no compiler."""
    light, omega = EnvironmentLight(picture(6, 9)), sphere(20)
    light(omega.double())
    assert light.prepared.held is None
    asked = omega.clone().requires_grad_()
    light(asked).sum().backward()
    assert asked.grad is not None and asked.grad.abs().max() > 0 and light.prepared.held is None
    each = torch.func.vmap(light)(omega)
    assert light.prepared.held is None
    expected = light(omega)
    assert is_compiled(light) and torch.allclose(each, expected, atol=2e-5)
    large = EnvironmentLight(torch.full((2, 2, 1), 1e300, dtype=torch.float64))
    assert torch.isinf(large(omega)).all() and not is_compiled(large)
    environment_native.library.cache_clear()
    monkeypatch.setenv("CXX", "/nowhere/compiler")
    try:
        other = EnvironmentLight(picture(6, 9))
        assert torch.allclose(other(omega), expected, atol=2e-5) and not is_compiled(other)
        u = uniforms(50, 2).float()
        lone, pair = (x.proposal()(Context(0.0)).sample(u) for x in (other, light))
        assert separation(lone, pair).max() < 1e-5
    finally:
        environment_native.library.cache_clear()


def test_what_is_compiled_follows_the_light() -> None:
    """Shared by rotated lights, made anew for copies, for other tables and for tables that were changed."""
    light, omega = EnvironmentLight(picture(6, 9)), sphere(20)
    first = light(omega)
    held = light.prepared.held
    turned = light.rotated(turn(1).float())
    assert torch.allclose(turned(omega).double(), turned(omega.double()), atol=2e-6)
    assert light.prepared.held is held
    for other in (copy.deepcopy(light), pickle.loads(pickle.dumps(light))):
        assert other.prepared.held is None and torch.equal(other(omega), first)
    assert isinstance(copy.deepcopy(light).prepared, Prepared)
    with torch.inference_mode():
        assert torch.equal(EnvironmentLight(picture(6, 9))(omega), first)
    light.load_state_dict(EnvironmentLight(picture(6, 9, seed=8)).state_dict())
    assert torch.equal(light(omega), EnvironmentLight(picture(6, 9, seed=8))(omega))
