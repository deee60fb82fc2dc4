"""Exact crossings against closed forms, a Poisson field of lines, and walking along the ray."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dsfit.errors import InputError
from dsfit.render import Strands
from dsfit.render import exact_counts as module
from dsfit.render.exact_counts import exact_crossings
from dsfit.render.geometry import block


def polylines(*curves: list[list[float]], radius: float = 0.1) -> Strands:
    points = torch.tensor([point for curve in curves for point in curve], dtype=torch.float64)
    first = torch.tensor([0, *torch.tensor([len(curve) for curve in curves]).cumsum(0).tolist()])
    return Strands(points, first, torch.full((len(points),), radius, dtype=torch.float64))


def ray(*numbers: float) -> torch.Tensor:
    return torch.tensor(numbers, dtype=torch.float64)


def lines(middle: torch.Tensor, axis: torch.Tensor, half: float, radius: float, pieces: int) -> Strands:
    """Straight strands of several segments."""
    s = torch.linspace(-half, half, pieces + 1, dtype=torch.float64)
    points = middle[:, None] + s[:, None] * axis[:, None]
    first = torch.arange(len(middle) + 1) * (pieces + 1)
    return Strands(points.reshape(-1, 3), first, torch.full((points.numel() // 3,), radius, dtype=torch.float64))


def unit(count: int, generator: torch.Generator) -> torch.Tensor:
    vector = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    return vector / vector.norm(dim=-1, keepdim=True)


@pytest.mark.parametrize("pieces", [1, 7, 20])
def test_lattice_of_parallel_cylinders(pieces: int) -> None:
    """Cylinders along y at integer (x, z), radius 0.2: a ray in the plane at slope k meets those with
    |x k - z + c| < 0.2 sqrt(1 + k^2), whatever its slope along y."""
    side = 12
    x, z = torch.meshgrid(torch.arange(side), torch.arange(side), indexing="ij")
    middle = torch.stack([x.flatten(), torch.zeros(side**2), z.flatten()], -1).double()
    cylinders = lines(middle, ray(0, 1, 0).expand(len(middle), 3), 40.0, 0.2, pieces)
    generator = torch.Generator().manual_seed(3)
    slope = torch.rand(200, generator=generator, dtype=torch.float64) * 2 - 1
    start = torch.rand(200, generator=generator, dtype=torch.float64) * side
    climb = torch.rand(200, generator=generator, dtype=torch.float64) * 2 - 1
    origin = torch.stack([torch.full_like(start, -5.0), torch.zeros_like(start), start - 5 * slope], -1)
    direction = torch.stack([torch.ones_like(slope), climb, slope], -1)
    distance = (middle[:, 0] * slope[:, None] - middle[:, 2] + start[:, None]).abs() / (1 + slope[:, None] ** 2).sqrt()
    expected = (distance < 0.2).sum(-1)
    assert torch.equal(exact_crossings(cylinders, origin, direction), expected)
    assert expected.max() > 5


@pytest.mark.parametrize("isotropic", [False, True])
def test_poisson_field_of_lines(isotropic: bool) -> None:
    """Mean and variance are length density x 2r x sin(angle) x length of the ray: crossings are Poisson counts."""
    generator = torch.Generator().manual_seed(8)
    count, reach, radius, length = 3000, 3.0, 0.06, 2.0
    axis = unit(count, generator) if isotropic else ray(0, 0.6, 0.8).expand(count, 3)
    # lines with uniform offsets in the disc of radius `reach` across them: length density count / (pi reach^2)
    helper = unit(count, generator)
    u = torch.linalg.cross(axis, helper)
    u = u / u.norm(dim=-1, keepdim=True)
    w = torch.linalg.cross(axis, u)
    out = reach * torch.rand(count, generator=generator, dtype=torch.float64).sqrt()[:, None]
    turn = 2 * math.pi * torch.rand(count, generator=generator, dtype=torch.float64)[:, None]
    field = lines(out * (turn.cos() * u + turn.sin() * w), axis, 4.0, radius, 4)
    rays = 250
    direction = ray(1.0, 0.0, 0.0).expand(rays, 3) if isotropic else ray(0.0, 1.0, 0.0).expand(rays, 3)
    origin = torch.rand(rays, 3, generator=generator, dtype=torch.float64) * 2 - 1
    origin = origin - direction * length / 2
    far = exact_crossings(field, origin + direction * length, direction)
    found = (exact_crossings(field, origin, direction) - far).double()  # from one end of the segment to the other
    sine = math.pi / 4 if isotropic else 0.8
    mean = count / (math.pi * reach**2) * 2 * radius * sine * length
    assert mean > 15
    error = math.sqrt(mean / rays) * 2  # rays see partly the same fibres
    assert float(found.mean()) == pytest.approx(mean, abs=4 * error)
    assert float(found.var()) == pytest.approx(mean, rel=0.35)


def walked(strands: Strands, origin: torch.Tensor, direction: torch.Tensor, reach: float, steps: int) -> int:
    """Crossings by small steps along the ray: how often a point comes to be inside a strand."""
    t = torch.linspace(0, reach, steps, dtype=torch.float64)
    points = origin + t[:, None] * direction / direction.norm()
    total = 0
    for strand in range(len(strands)):
        inside = torch.zeros(steps, dtype=torch.bool)
        low, high = int(strands.first[strand]), int(strands.first[strand + 1])
        for k in range(low, high - 1):
            a, b = strands.points[k], strands.points[k + 1]
            radius = (strands.radius[k] + strands.radius[k + 1]) / 2
            s = ((points - a) @ (b - a)) / (b - a).square().sum()
            near = (points - a - s.clamp(0, 1)[:, None] * (b - a)).norm(dim=-1) < radius
            if k == low:
                near &= s >= 0
            if k == high - 2:
                near &= s <= 1
            inside |= near
        total += int((inside[1:] & ~inside[:-1]).sum())
    return total


def test_tangle_against_walking_along_the_ray() -> None:
    """Bent strands of changing radius that cross themselves, rays from inside the tangle in all directions."""
    generator = torch.Generator().manual_seed(5)
    curves = torch.randn(40, 9, 3, generator=generator, dtype=torch.float64).cumsum(1) * 0.3
    radius = 0.05 + 0.15 * torch.rand(40 * 9, generator=generator, dtype=torch.float64)
    tangle = Strands(curves.reshape(-1, 3), torch.arange(41) * 9, radius)
    direction = unit(25, generator)
    origin = torch.randn(25, 3, generator=generator, dtype=torch.float64) * 0.3
    found = exact_crossings(tangle, origin, direction)
    expected = [walked(tangle, o, d, 8.0, 5_000) for o, d in zip(origin, direction, strict=True)]
    assert found.tolist() == expected
    assert max(expected) >= 5


def test_joints_count_once_and_hairpins_twice() -> None:
    bent = polylines([[0, -1, 0], [0, 0, 0], [0.02, 1, 0]])
    assert exact_crossings(bent, ray(-3, 0, 0), ray(1, 0, 0)) == 1
    assert exact_crossings(bent, ray(-3, 0.01, 0), ray(1, -0.01, 0)) == 1
    sharp = polylines([[0, 0, 0], [1, 0, 0], [0.5, 0.8, 0]])  # the outside of the bend is round, without a gap
    assert exact_crossings(sharp, ray(1.05, -0.02, -3), ray(0, 0, 1)) == 1
    hairpin = polylines([[0, 0, 0], [0, 5, 0], [1, 5, 0], [1, 0, 0]])
    assert exact_crossings(hairpin, ray(-3, 2, 0), ray(2, 0, 0)) == 2
    assert exact_crossings(hairpin, ray(-3, 5, 0), ray(2, 0, 0)) == 1


def test_a_strand_that_runs_through_itself_is_entered_once() -> None:
    weave = [[0, 0, 0], [10, 0, 0], [8, 4, 0], [8, -4, 0], [5, -4, 0], [5, 4, 0], [2, 4, 0], [2, -4, 0]]
    inside = polylines([[float(x) for x in point] for point in weave], radius=0.5)
    assert exact_crossings(inside, ray(-3, 0.1, 0), ray(1, 0, 0)) == 1
    assert exact_crossings(inside, ray(-3, 2, 0), ray(1, 0, 0)) == 3  # the slanted piece overlaps the one at x = 8


def test_only_the_fibre_at_the_origin_is_left_out() -> None:
    hairpin = polylines([[0, 0, 0], [0, 5, 0], [1, 5, 0], [1, 0, 0]], [[2, 0, 0], [2, 5, 0]])
    direction = ray(1, 0, 0)
    for offset in (-0.1, -0.05, 0.0, 0.05, 0.1):
        assert exact_crossings(hairpin, ray(offset, 2, 0), direction, own=0) == 2  # the other arm, and strand 1
        assert exact_crossings(hairpin, ray(0.05, 2, 0.9 * offset), direction, torch.tensor(0)) == 2
    outside = ray(-0.11, 2, 0)
    assert exact_crossings(hairpin, outside, direction) == 3
    assert exact_crossings(hairpin, outside, direction, own=1) == 3
    assert exact_crossings(hairpin, outside, direction, own=0) == 2
    assert exact_crossings(hairpin, ray(-3, 2, 0), direction, own=0) == 3


def test_half_line_and_ends() -> None:
    one = polylines([[0, -1, 0], [0, 1, 0]])
    assert exact_crossings(one, ray(-3, 0, 0), ray(-1, 0, 0)) == 0
    assert exact_crossings(one, ray(-3, 0.999, 0), ray(1, 0, 0)) == 1
    assert exact_crossings(one, ray(-3, 1.001, 0), ray(1, 0, 0)) == 0  # cut off flat
    assert exact_crossings(one, ray(0.05, -3, 0), ray(0, 1, 0)) == 1  # along the axis
    assert exact_crossings(one, ray(0.15, -3, 0), ray(0, 1, 0)) == 0
    assert exact_crossings(one, ray(0, 0, 0), ray(1, 0, 0)) == 0  # not entered


def test_repeated_points_are_no_segments() -> None:
    twice = polylines([[0, -1, 0], [0, 0, 0], [0, 0, 0], [0, 1, 0]])
    origin = torch.tensor([[-3, y, 0.03] for y in (-0.5, 0.0, 0.5, 2.0)], dtype=torch.float64)
    assert exact_crossings(twice, origin, ray(1, 0, 0)).tolist() == [1, 1, 1, 0]


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**31), st.floats(1e-3, 1e3), st.floats(-100, 100))
def test_unit_of_length_and_place_do_not_matter(seed: int, factor: float, shift: float) -> None:
    hair = block(seed=seed, strands=40, points=6, radius=0.05)
    generator = torch.Generator().manual_seed(seed)
    own = torch.randint(40, (30,), generator=generator)
    origin, direction = hair.points[own * 6 + 2], unit(30, generator)
    here = exact_crossings(hair, origin, direction, own)
    moved = Strands((hair.points + shift) * factor, hair.first, hair.radius * factor)
    assert torch.equal(exact_crossings(moved, (origin + shift) * factor, direction * 7, own), here)


def test_pieces_do_not_change_the_count(monkeypatch: pytest.MonkeyPatch) -> None:
    hair = block(strands=100, points=20, radius=0.05)
    generator = torch.Generator().manual_seed(1)
    origin, direction = hair.points[:60].reshape(3, 20, 3), unit(60, generator).reshape(3, 20, 3)
    whole = exact_crossings(hair, origin, direction)
    assert whole.shape == (3, 20) and whole.dtype == torch.int64 and whole.max() > 2
    monkeypatch.setattr(module, "_PAIRS", 1)
    assert torch.equal(exact_crossings(hair, origin, direction), whole)
    single = exact_crossings(hair, origin.float(), direction.float())
    assert torch.equal(exact_crossings(hair, origin.float().double(), direction.float().double()), single)


@pytest.mark.parametrize(
    ("origin", "direction", "own", "field"),
    [
        (ray(0, 0), ray(1, 0, 0), -1, "origin"),
        (ray(0, 0, math.nan), ray(1, 0, 0), -1, "origin"),
        (ray(0, 0, 0), ray(0, 0, 0), -1, "direction"),
        (ray(0, 0, 0), ray(1, math.inf, 0), -1, "direction"),
        (ray(0, 0, 0), torch.tensor([1, 0, 0]), -1, "direction"),
        (ray(0, 0, 0), ray(1, 0, 0), 1, "own"),
        (ray(0, 0, 0), ray(1, 0, 0), -2, "own"),
        (ray(0, 0, 0), ray(1, 0, 0), torch.tensor(0.0), "own"),
        (ray(0, 0, 0).expand(2, 3), ray(1, 0, 0).expand(3, 3), -1, "exact_crossings"),
    ],
)
def test_bad_rays(origin: torch.Tensor, direction: torch.Tensor, own: object, field: str) -> None:
    with pytest.raises(InputError, match=field):
        exact_crossings(polylines([[0, 0, 0], [1, 0, 0]]), origin, direction, own)  # type: ignore[arg-type]
