"""Irradiances and solid angles that have closed forms; points where the forms degenerate."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from dsfit.errors import InputError
from dsfit.frame import to_vector
from dsfit.scene import Light, RectangleLight, RingLight, SphereLight, SunLight
from tests.scene.lights.cases import CONTEXT, RGB, uniforms

EYE = torch.eye(3, dtype=torch.float64)
SOBOL = torch.quasirandom.SobolEngine(2, scramble=True, seed=3).draw(2**14, dtype=torch.float64)


def irradiance(light: Light, normal: list[float]) -> Tensor:
    """int L max(w . n, 0) domega by light sampling."""
    omega, log_prob = light.proposal()(CONTEXT).sample_with_log_prob(SOBOL)
    cosine = (to_vector(omega) @ torch.tensor(normal, dtype=torch.float64)).clamp_min(0.0)
    return (light(omega) * (cosine / torch.exp(log_prob))[:, None]).mean(0)


@pytest.mark.parametrize("distance", [1.0, 1.0001, 2.0, 100.0, 1e6])
def test_irradiance_of_a_sphere(distance: float) -> None:
    light = SphereLight([0.0, 0.0, distance], 1.0, RGB)
    wanted = math.pi * torch.tensor(RGB, dtype=torch.float64) / distance**2
    torch.testing.assert_close(irradiance(light, [0, 0, 1.0]), wanted, rtol=2e-3, atol=0)
    solid = 2 * math.pi * (1 - math.sqrt(1 - distance**-2)) if distance < 1e4 else math.pi / distance**2
    assert float(light.power()) == pytest.approx(solid * sum(RGB) / 3, rel=1e-9)


@pytest.mark.parametrize("radius", [1e-6, 4.65e-3, 0.3, math.pi / 2])
def test_irradiance_of_a_sun(radius: float) -> None:
    light = SunLight([0.0, 0.0, 1.0], radius, irradiance=[3.0, 2.0, 1.0])
    wanted = torch.tensor([3.0, 2.0, 1.0], dtype=torch.float64)
    torch.testing.assert_close(irradiance(light, [0, 0, 1.0]), wanted, rtol=2e-3, atol=0)
    peak = float(light(light.proposal()(CONTEXT).sample(uniforms(1, 2)))[0, 0])
    assert peak == pytest.approx(3.0 / (math.pi * math.sin(radius) ** 2), rel=1e-12)


def corner_sum(x0: float, x1: float, y0: float, y1: float, z: float) -> float:
    """Solid angle as the four arc tangents of x y / (z r)."""

    def term(x: float, y: float) -> float:
        return math.atan2(x * y, z * math.sqrt(x * x + y * y + z * z))

    return term(x1, y1) - term(x0, y1) - term(x1, y0) + term(x0, y0)


@pytest.mark.parametrize(
    "box", [(-1.0, 2.0, -0.5, 1.0, 2.0), (0.5, 3.0, 1.0, 2.0, 0.7), (-1.0, 1.0, -1.0, 1.0, 1e-6), (0, 1, 0, 2, 0.1)]
)
def test_solid_angle_of_a_rectangle(box: tuple[float, ...]) -> None:
    x0, x1, y0, y1, z = box
    light = RectangleLight([x0, y0, z], [x1 - x0, 0, 0], [0, y1 - y0, 0], 1.0, two_sided=True)
    assert float(light.power()) == pytest.approx(corner_sum(*box), rel=1e-12)


def test_small_solid_angles_keep_their_digits() -> None:
    """Where the sum of arc tangents has none left: area x cosine / distance^2 to the size of the emitter."""
    for size, place in ((1e-7, [0.3, 0.4, 1.2]), (1e-7, [3.0, 0.4, 1e-3]), (1.0, [3e7, 4e7, 1.0])):
        x, y, z = place
        flat = 0.5 * size
        distance = math.sqrt(x * x + y * y + z * z)
        sheet = RectangleLight([x - flat, y - flat, z], [size, 0, 0], [0, size, 0], 1.0, two_sided=True)
        ring = RingLight(place, [0, 0, 1], flat, size, 1.0, two_sided=True)
        assert float(sheet.power()) == pytest.approx(size**2 * z / distance**3, rel=1e-6)
        wanted = 0.75 * math.pi * size**2 * z / distance**3
        assert float(ring.seen_ring()[0].solid_angle) == pytest.approx(wanted, rel=1e-6)


@pytest.mark.parametrize("height", [1e-3, 0.1, 1.0, 50.0])
def test_a_ring_is_the_difference_of_two_discs(height: float) -> None:
    def disc(radius: float) -> float:
        return 2 * math.pi * radius**2 / (math.hypot(height, radius) * (math.hypot(height, radius) + height))

    ring = RingLight([0, 0, height], [0, 0, 1], 0.5, 1.0, 1.0, two_sided=True)
    assert float(ring.seen_ring()[0].solid_angle) == pytest.approx(disc(1.0) - disc(0.5), rel=1e-9)
    # anywhere: the ring and the disc in its hole are the larger disc
    for place in ([0.3, 0.2, height], [2.0, -1.0, height], [0.75, 0.0, height]):
        parts = [RingLight(place, [0, 0, 1], a, b, 1.0, two_sided=True) for a, b in ((0, 0.5), (0.5, 1.0), (0, 1.0))]
        hole, rest, whole = (float(light.seen_ring()[0].solid_angle) for light in parts)
        assert float(parts[1].power()) == pytest.approx(rest, rel=0.05)
        assert hole + rest == pytest.approx(whole, rel=1e-9 if height > 0.01 else 1e-3)


def test_the_ring_covers_what_its_discs_do() -> None:
    omega = RingLight([0.4, 0.1, 0.8], [0.1, 0, 1], 0.0, 1.2, 1.0, two_sided=True).proposal()(CONTEXT)
    drawn = omega.sample(uniforms(20_000, 2))
    radii = ((0.0, 0.7), (0.7, 1.2), (0.0, 1.2))
    hole, rest, whole = (RingLight([0.4, 0.1, 0.8], [0.1, 0, 1], *r, 1.0, two_sided=True)(drawn) for r in radii)
    assert bool((whole == 1).all()) and bool((hole + rest == 1).all()) and 0.2 < float(hole.mean()) < 0.6


def test_inside_a_sphere_light_comes_from_everywhere() -> None:
    light = SphereLight([0.1, 0.2, 0.0], 1.0, RGB)
    omega = torch.stack([uniforms(1000, 2)[:, 0] * 3 - 1.5, uniforms(1000, 2)[:, 1] * 6 - 3], dim=-1)
    assert bool((light(omega) == torch.tensor(RGB, dtype=torch.float64)).all())
    assert bool((light.proposal()(CONTEXT).log_prob(omega).exp() - 1 / (4 * math.pi)).abs().max() < 1e-15)
    assert light.covers() and not SphereLight([0.0, 0.0, 1.0], 1.0).covers()


def test_in_the_plane_and_from_behind() -> None:
    omega = torch.stack([uniforms(4000, 2)[:, 0] * 3 - 1.5, uniforms(4000, 2)[:, 1] * 6 - 3], dim=-1)
    for make in (
        lambda z, two: RectangleLight([1, -1, z], [1, 0, 0], [0, 2, 0], RGB, two),
        lambda z, two: RingLight([1.5, 0.0, z], [0, 0, 1], 0.2, 1.0, RGB, two),
    ):
        flat, behind, front, both = make(0.0, True), make(1.0, False), make(-1.0, False), make(1.0, True)
        assert not bool((flat(omega) > 0).any()) and float(flat.power()) == 0
        assert not bool((behind(omega) > 0).any()) and float(behind.power()) == 0
        assert float(front.power()) == pytest.approx(float(both.power()), rel=1e-12)
        for light in (flat, behind, front):
            drawn, log_prob = light.proposal()(CONTEXT).sample_with_log_prob(uniforms(100, 2))
            assert bool(log_prob.isfinite().all()) and bool((light(drawn) > 0).all()) == (light is front)
        assert flat.breakpoints() == behind.breakpoints() == ([], [])


@pytest.mark.parametrize(
    ("build", "field"),
    [
        (lambda: SunLight([0, 0, 0], 0.1, 1.0), "direction"),
        (lambda: SunLight([[0, 0, 1], [0, 1, 0]], 0.1, 1.0), "direction"),
        (lambda: SunLight([0, 0, 1], 2.0, 1.0), "angular_radius"),
        (lambda: SunLight([0, 0, 1], 0.1), "irradiance"),
        (lambda: SunLight([0, 0, 1], 0.1, 1.0, radiance=2.0), "irradiance"),
        (lambda: SunLight([0, 0, 1], 0.1, -1.0), "irradiance"),
        (lambda: SphereLight([0, 0], 1.0), "center"),
        (lambda: SphereLight([0, 0, 1e13], 1.0), "center"),
        (lambda: SphereLight([0, 0, 1], 0.0), "radius"),
        (lambda: SphereLight([0, 0, 1], 1.0, position=[0.0, 1.0]), "position"),
        (lambda: SphereLight([0, 0, 1], 1.0, [[1.0]]), "radiance"),
        (lambda: RectangleLight([0, 0, 1], [1, 0, 0], [0.1, 1, 0]), "edge_v"),
        (lambda: RectangleLight([0, 0, 1], [0, 0, 0], [0, 1, 0]), "length of edge_u"),
        (lambda: RectangleLight([0, 0, 1], [1, 0, 0], [0, 1, 0], two_sided=1), "two_sided"),
        (lambda: RingLight([0, 0, 1], [0, 0, 0], 0.5, 1.0), "normal"),
        (lambda: RingLight([0, 0, 1], [0, 0, 1], 1.0, 1.0), "inner"),
        (lambda: RingLight([0, 0, 1], [0, 0, 1], -0.1, 1.0), "inner"),
    ],
)
def test_bad_input_is_named(build, field: str) -> None:
    with pytest.raises(InputError) as caught:
        build()
    assert caught.value.field == field
