"""The density of fibres in voxels, and crossings where they are known in closed form."""

from __future__ import annotations

import math

import pytest
import torch

from dsfit.errors import InputError
from dsfit.render import Strands
from dsfit.render.exact_counts import exact_crossings
from dsfit.render.geometry import double_block
from dsfit.render.grid import DensityGrid
from dsfit.render.grid.march import crossing_rate
from tests.render.grid_cases import F64, homogeneous, normal, packed, polylines, tangle, uniform, unit

RATES = pytest.mark.parametrize("step", [1.0, 0.25])


@pytest.mark.parametrize("resolution", [1, 7, 32])
def test_length_times_diameter_is_conserved(resolution: int) -> None:
    strands = tangle()
    grid = DensityGrid.of(strands, resolution)
    a = strands.starts
    length = (strands.points[a + 1] - strands.points[a]).norm(dim=-1)
    total = (length * (strands.radius[a] + strands.radius[a + 1])).sum()
    assert max(grid.shape) == resolution
    assert float(grid.moments[..., :3].sum()) * grid.voxel**3 == pytest.approx(float(total), rel=1e-12)


def test_each_voxel_gets_its_own_pieces() -> None:
    strands, fine = tangle(20, 6), 4000
    grid = DensityGrid.of(strands, 9)
    assert len(set(grid.shape)) == 3  # so that no two axes can be mistaken for one another
    a = strands.starts
    along = (strands.points[a + 1] - strands.points[a])[:, None]
    t = ((torch.arange(fine, dtype=F64) + 0.5) / fine)[None, :, None]
    points = strands.points[a][:, None] + t * along
    weight = torch.lerp(strands.radius[a][:, None], strands.radius[a + 1][:, None], t[..., 0]) * 2 / fine
    outer = (along[..., :, None] * along[..., None, :] / along.norm(dim=-1)[..., None, None]).expand(-1, fine, 3, 3)
    x, y, z = ((points - grid.low) / grid.voxel).long().unbind(-1)
    wanted = torch.zeros(*grid.shape, 6, dtype=F64)
    wanted.index_put_((x, y, z), packed(outer) * weight[..., None] / grid.voxel**3, accumulate=True)
    piece = 2 * 0.03 * float(along.norm(dim=-1).max()) / fine / grid.voxel**3  # the most that one fine piece weighs
    assert float((wanted - grid.moments).abs().max()) < 10 * piece < 0.05 * float(wanted.max())


def test_segments_in_faces_and_of_no_length_are_kept_whole() -> None:
    one, two = [[0.0, 1, 1], [4, 1, 1], [4, 1, 1], [4, 3, 1]], [[0.0, 0, 0], [4, 4, 4], [4, 4, 0], [0, 4, 0]]
    points = torch.tensor([one, two])
    grid = DensityGrid.of(polylines(points.to(F64), torch.full((2, 4), 1e-9, dtype=F64)), 4)
    total = grid.moments[..., :3].sum((0, 1, 2)) * grid.voxel**3 / 2e-9
    root = 4 * math.sqrt(3) / 3
    wanted = [4 + root + 4, 2 + root, root + 4]
    assert total.tolist() == pytest.approx(wanted, rel=1e-9)


@RATES
def test_isotropic_box(step: float) -> None:
    grid = homogeneous(torch.eye(3, dtype=F64) * 2.0, step=step)  # trace 6, rate 6 pi / 4; sides of length 3
    centre = grid.low + 1.5
    tilted = unit(torch.tensor([[1.0, 0, 0], [0, -1, 0], [0.2, 0.3, 1], [-1, 0.4, -0.1], [0.1, 1, -0.5]], dtype=F64))
    chord = 1.5 / tilted.abs().amax(-1)
    found = grid.crossings(centre, tilted) / (6 * math.pi / 4)
    assert found.tolist() == pytest.approx(chord.tolist(), rel=2e-2 if step == 1.0 else 2e-3)


def test_slab_is_crossed_in_inverse_proportion_to_the_cosine() -> None:
    grid = homogeneous(torch.eye(3, dtype=F64), (48, 8, 48), step=0.125)
    angle = torch.linspace(0.0, 1.2, 7, dtype=F64)
    direction = torch.stack([angle.sin(), angle.cos(), 0 * angle], dim=-1)
    below = grid.low + torch.tensor([3.0, -1.0, 6.0], dtype=F64)  # outside: all of the slab is crossed
    assert grid.crossings(below, direction).tolist() == pytest.approx(
        (3 * math.pi / 4 * 2.0 / angle.cos()).tolist(), rel=1e-3
    )


def test_aligned_bundle_at_all_angles() -> None:
    tangent = unit(torch.tensor([1.0, 2.0, -0.5], dtype=F64))
    grid = homogeneous(5 * tangent[:, None] * tangent, step=0.125)
    direction = unit(torch.cat([normal(40, 3), tangent[None], -tangent[None]]))
    sine = torch.linalg.cross(direction, tangent.expand_as(direction)).norm(dim=-1)
    chord = grid.crossings(grid.low + 1.5, direction) / 5
    around = homogeneous(torch.eye(3, dtype=F64), step=0.125).crossings(grid.low + 1.5, direction) / (3 * math.pi / 4)
    assert chord.tolist() == pytest.approx((sine * around).tolist(), rel=1e-9, abs=1e-6)


@pytest.mark.parametrize(("spread", "error"), [(0.05, 0.002), (0.2, 0.01), (0.5, 0.01), (1e6, 0.005)])
def test_rate_of_spread_tangents(spread: float, error: float) -> None:
    axis = torch.tensor([1.0, 0.0, 0.0], dtype=F64)
    tangent = unit(axis + spread * normal(40_000, 3, seed=3))
    moments = packed((tangent[:, :, None] * tangent[:, None]).mean(0))
    direction = unit(torch.cat([normal(100, 3), axis[None]]))
    exact = torch.sqrt((1 - (direction @ tangent.T) ** 2).clamp_min(0)).mean(-1)
    found = crossing_rate(moments[:, None], direction)
    assert float((found - exact).square().mean().sqrt() / exact.mean()) < error
    # the root of the mean square alone, which the term for the spread improves on
    root = torch.sqrt(1 - (direction @ tangent.T).square().mean(-1))
    assert float((found - exact).square().mean()) < 0.5 * float((root - exact).square().mean())


def test_a_fibre_adds_its_own_crossings() -> None:
    left = []
    for seed in range(8):
        tangent = unit(normal(3, seed=seed))
        inside = 16.5 * torch.linspace(-1, 1, 3000, dtype=F64)[:, None] * tangent + uniform(3, seed=seed)
        fibre = polylines(inside[None], torch.full((1, 3000), 0.01, dtype=F64))
        grid = DensityGrid.of(fibre, 30, step=0.125, mode="eager")
        origin = uniform(3, seed=seed) + 2 * grid.voxel * (uniform(40, 1, seed=9) - 0.5) * tangent
        direction = unit(normal(150, 3, seed=seed + 20))
        inside = direction[torch.linalg.cross(direction, tangent.expand_as(direction)).norm(dim=-1) > 0.15]
        left.append(grid.crossings(origin[:, None], inside, 0.0).mean() / grid.own_crossings(torch.tensor(0.01)))
    assert float(torch.stack(left).mean()) == pytest.approx(1.0, abs=0.08)  # spreads by 0.08, over eight


def test_counts_of_the_geometry_on_average() -> None:
    strands = double_block(seed=3, strands=(100, 500))
    grid = DensityGrid.of(strands, 24)
    count = 3000
    segment = strands.starts[torch.randint(len(strands.starts), (count,), generator=torch.Generator().manual_seed(1))]
    origin = torch.lerp(strands.points[segment], strands.points[segment + 1], uniform(count, 1))
    direction = unit(normal(count, 3, seed=5))
    exact = exact_crossings(strands, origin, direction, strands.strand_of_point[segment]).to(F64)
    n = grid.crossings(origin, direction)
    error = float((n - exact).std()) / math.sqrt(count)
    assert float((n - exact).mean()) == pytest.approx(0.0, abs=4 * error + 0.03 * float(exact.mean()))
    # as from a fibre: how many meet none is right to the noise
    free, none = torch.exp(-grid.crossings(origin, direction, strands.radius[segment])), (exact == 0).to(F64)
    error = float((free - none).std()) / math.sqrt(count)
    assert float((free - none).mean()) == pytest.approx(0.0, abs=4 * error + 0.01)
    # Poisson: the spread about n is its root
    thick = n > 0.5
    assert 0.7 < float(((n - exact)[thick] ** 2 / n[thick]).mean()) < 1.4
    # axes taken for one another are seen
    turned = DensityGrid(grid.moments.transpose(0, 1).contiguous(), grid.low, grid.voxel)
    wrong = turned.crossings(origin, direction)
    assert float((wrong - exact).square().mean()) > 1.3 * float((n - exact).square().mean())


def test_sizes() -> None:
    strands = tangle()
    grid = DensityGrid.of(strands, 16, mode="eager")
    low, high = strands.bounds
    assert bool((grid.low <= low + 1e-8).all()) and bool((grid.high >= high - 1e-8).all())
    assert grid.voxel == pytest.approx(float((high - low).max()) / 16)
    assert grid.memory == 6 * 8 * math.prod(grid.shape)
    thin = Strands(torch.tensor([[0.0, 0, 0], [1, 0, 0]]), torch.tensor([0, 2]), torch.tensor([1e-3, 1e-3]))
    assert DensityGrid.of(thin, 8).shape == (8, 1, 1)


@pytest.mark.parametrize(
    ("options", "field"),
    [
        ({"resolution": 0}, "resolution"),
        ({"resolution": 8.0}, "resolution"),
        ({"resolution": True}, "resolution"),
        ({"resolution": 10_000}, "resolution"),
        ({"resolution": 8, "step": 0.0}, "step"),
        ({"resolution": 8, "step": 2.0}, "step"),
        ({"resolution": 8, "max_n": 0.0}, "max_n"),
        ({"resolution": 8, "max_n": float("nan")}, "max_n"),
        ({"resolution": 8, "mode": "fast"}, "mode"),
    ],
)
def test_bad_options_are_refused(options: dict, field: str) -> None:
    with pytest.raises(InputError) as error:
        DensityGrid.of(tangle(), **options)
    assert error.value.field == field


@pytest.mark.parametrize(
    ("moments", "low", "voxel", "field"),
    [
        (torch.zeros(2, 2, 2, 5), (0, 0, 0), 1.0, "moments"),
        (torch.zeros(2, 2, 6), (0, 0, 0), 1.0, "moments"),
        (torch.full((2, 2, 2, 6), float("nan")), (0, 0, 0), 1.0, "moments"),
        (-torch.ones(2, 2, 2, 6), (0, 0, 0), 1.0, "moments"),
        (torch.zeros(600, 1, 1, 6), (0, 0, 0), 1.0, "moments"),
        (torch.zeros(2, 2, 2, 6), (0, 0), 1.0, "low"),
        (torch.zeros(2, 2, 2, 6), (0, 0, float("inf")), 1.0, "low"),
        (torch.zeros(2, 2, 2, 6), (0, 0, 0), 0.0, "voxel"),
    ],
)
def test_bad_grids_are_refused(moments: torch.Tensor, low: tuple, voxel: float, field: str) -> None:
    with pytest.raises(InputError) as error:
        DensityGrid(moments, low, voxel)
    assert error.value.field == field
