"""Rays through the grid: odd rays, gradients, and the compiled march against the one in torch."""

from __future__ import annotations

import copy
import math
import pickle

import pytest
import torch
from torch import Tensor

from dsfit.errors import InputError
from dsfit.render.grid import DensityGrid, march
from dsfit.render.grid.native import NoCompiler, library
from tests.render.grid_cases import F64, homogeneous, normal, uneven, uniform, unit


def _modes() -> list[str]:
    try:
        library()
    except NoCompiler:
        return ["eager"]
    return ["eager", "compiled"]


MODES = _modes()
modes = pytest.mark.parametrize("mode", MODES)
compiled = pytest.mark.skipif("compiled" not in MODES, reason="no C++ compiler")


def _rays(grid: DensityGrid, count: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Rays from in and around the grid, a few of them parallel to axes."""
    size = grid.high - grid.low
    origin = grid.low + size * (2 * uniform(count, 3, seed=seed) - 0.5)
    direction = normal(count, 3, seed=seed + 1)
    direction[: count // 8, 0] = 0.0
    direction[: count // 16, 1] = -0.0
    return origin, direction


def _brute(grid: DensityGrid, origin: Tensor, direction: Tensor) -> float:
    """One ray step by step, in plain Python: trilinear interpolation written out."""
    d, total = unit(direction).tolist(), 0.0
    start = ((origin - grid.low) / grid.voxel - 0.5).tolist()
    near, far = 0.0, math.inf
    for a in range(3):
        if d[a]:
            ends = sorted(((-1 - start[a]) / d[a], (grid.shape[a] - start[a]) / d[a]))
            near, far = max(near, ends[0]), min(far, ends[1])
        elif not -1 <= start[a] <= grid.shape[a]:
            return 0.0
    for k in range(max(0, math.ceil((far - near) / grid.step)) if far > near else 0):
        place = [start[a] + (near + (k + 0.5) * grid.step) * d[a] for a in range(3)]
        cell = [math.floor(x) for x in place]
        moments = torch.zeros(6, dtype=F64)
        for corner in range(8):
            index, weight = [], 1.0
            for a in range(3):
                upper = corner >> a & 1
                index.append(cell[a] + upper)
                weight *= place[a] - cell[a] if upper else 1 - (place[a] - cell[a])
            if all(0 <= i < n for i, n in zip(index, grid.shape, strict=True)):
                moments += weight * grid.moments[tuple(index)]
        total += float(march.crossing_rate(moments, torch.tensor(d, dtype=F64)))
    return total * grid.step * grid.voxel


@pytest.mark.parametrize("step", [1.0, 0.3])
def test_against_plain_python(step: float) -> None:
    grid = uneven(step=step, mode="eager", max_n=1e9)
    origin, direction = _rays(grid, 48)
    wanted = [_brute(grid, *ray) for ray in zip(origin, direction, strict=True)]
    assert 12 < sum(x > 0 for x in wanted) < 40
    assert grid.crossings(origin, direction).tolist() == pytest.approx(wanted, rel=1e-11, abs=1e-12)


@compiled
@pytest.mark.parametrize("step", [1.0, 0.3])
def test_compiled_agrees_to_float32_rounding(step: float) -> None:
    grid = uneven((19, 11, 14), step=step, max_n=1e9)
    assert grid.backend == "compiled"
    origin, direction = _rays(grid, 4000)
    eager = DensityGrid(grid.moments, grid.low, grid.voxel, step=step, max_n=1e9, mode="eager")
    exact, single = eager.crossings(origin, direction), eager.crossings(origin.float(), direction.float())
    found = grid.crossings(origin.float(), direction.float())
    assert found.dtype == single.dtype == torch.float32
    assert exact.dtype == grid.crossings(origin, direction).dtype == F64
    scale = float(exact.max())
    # places are rounded to 1e-6 voxels and moments to 6e-8, and errors of up to 80 steps add
    assert float((single - exact).abs().max()) < 1e-5 * scale
    assert float((found - exact).abs().max()) < 1e-5 * scale
    assert float(((found - exact) / (exact + 1e-3 * scale)).abs().mean()) < 1e-6


@modes
def test_finer_steps_converge(mode: str) -> None:
    origin, direction = _rays(uneven(), 500)
    steps = (1 / 32, 0.25, 0.5, 1.0)
    found = {step: uneven(step=step, mode=mode, max_n=1e9).crossings(origin, direction) for step in steps}
    error = {step: float((n - found[1 / 32]).square().mean().sqrt()) for step, n in found.items()}
    assert error[0.5] < 0.5 * error[1.0] and error[0.25] < 0.5 * error[0.5]
    assert error[1.0] < 0.1 * float(found[1.0].mean())  # of moments that differ by their own size between neighbours


@modes
def test_odd_rays(mode: str) -> None:
    grid = homogeneous(torch.eye(3, dtype=F64), step=0.125, mode=mode)
    rate, low, high, voxel = 3 * math.pi / 4, grid.low, grid.high, grid.voxel
    middle = (low + high) / 2
    axes = torch.cat([torch.eye(3, dtype=F64), -torch.eye(3, dtype=F64)])
    # along each axis: from the middle, through all of it from outside, and away from it
    for origin, wanted in ((middle, 1.5), (middle - 7 * axes, 3.0), (middle + 7 * axes, 0.0)):
        assert grid.crossings(origin, axes).tolist() == pytest.approx([rate * wanted] * 6, abs=1e-4)
    # on a face: all the box inwards, and outwards what interpolation smears over half a voxel
    faces = middle + 1.5 * axes
    assert grid.crossings(faces, -axes).tolist() == pytest.approx([rate * (3 - voxel / 8)] * 6, abs=0.01)
    assert grid.crossings(faces, axes).tolist() == pytest.approx([rate * voxel / 8] * 6, abs=0.01)
    # beside the box, parallel to its faces; and exactly in the faces' plane
    assert grid.crossings(middle + torch.tensor([0.0, 1.7, 0.0]), axes[:1]).tolist() == [0.0]
    inside = grid.crossings(middle + torch.tensor([0.0, 1.5, 0.0], dtype=F64), axes[:1])
    assert float(inside) == pytest.approx(rate * 1.5 / 2, abs=1e-3)  # half the density there
    # a corner, diagonally in and out; far away, towards it
    diagonal = torch.ones(3, dtype=F64)
    out, back = grid.crossings(high, torch.stack([diagonal, -diagonal])).tolist()
    # on the diagonal the density rises as (1/2 + u)^3, u = depth in voxels along each axis, from -1/2 to 1/2
    assert out == pytest.approx(rate * math.sqrt(3) * voxel / 64, rel=0.02)
    assert back == pytest.approx(rate * math.sqrt(3) * (3 - voxel * (2 * (1 / 2 - 15 / 64) - 1 / 64)), rel=1e-4)
    far = grid.crossings(middle - 1e4 * axes[0], axes[0])
    assert float(far) == pytest.approx(rate * 3, rel=1e-2)
    assert float(grid.crossings(middle - 1e4 * axes[0], axes[1])) == 0.0


@modes
def test_lengths_of_directions_do_not_matter(mode: str) -> None:
    grid = uneven(mode=mode)
    origin, direction = _rays(grid, 50)
    n = grid.crossings(origin, unit(direction))
    for scale in (1e-12, 1e12):
        assert grid.crossings(origin, scale * direction).tolist() == pytest.approx(n.tolist(), rel=1e-4, abs=1e-4)


@modes
def test_shapes_broadcast(mode: str) -> None:
    grid = uneven(mode=mode)
    origin, direction = _rays(grid, 6)
    n = grid.crossings(origin[:, None], direction[None])
    assert n.shape == (6, 6)
    assert n[2, 4] == grid.crossings(origin[2], direction[4])
    assert grid.crossings(origin[:0], direction[:0]).shape == (0,)


@modes
def test_n_is_limited(mode: str) -> None:
    origin, direction = _rays(uneven(), 200)
    free = uneven(mode=mode, max_n=1e9).crossings(origin, direction)
    limit = float(free.max()) / 3
    limited = uneven(mode=mode, max_n=limit).crossings(origin, direction)
    assert limited.tolist() == pytest.approx(free.clamp_max(limit).tolist(), rel=1e-6)


@modes
def test_rays_from_fibres_start_later_and_leave_their_own_out(mode: str) -> None:
    grid = uneven(mode=mode)
    origin, direction = _rays(grid, 400)
    inside = ((origin > grid.low) & (origin < grid.high)).all(-1)
    origin, direction = origin[inside][:50], direction[inside][:50]
    plain = grid.crossings(origin + march.START * grid.voxel * unit(direction), direction)
    radius = 0.05 * uniform(len(plain))
    wanted = (plain - radius * 2 * march.SELF / grid.voxel).clamp_min(0)
    assert grid.crossings(origin, direction, radius).tolist() == pytest.approx(wanted.tolist(), abs=2e-5)


@modes
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_empty_grids_are_not_crossed(mode: str, dtype: torch.dtype) -> None:
    grid = DensityGrid(torch.zeros(3, 4, 5, 6, dtype=dtype), (0, 0, 0), 0.5, mode=mode)
    origin, direction = (x.to(dtype) for x in _rays(grid, 50))
    n = grid.crossings(origin, direction)
    assert n.dtype == dtype and bool((n == 0).all())


@pytest.mark.parametrize("step", [1.0, 0.4])
def test_gradients_are_those_of_finite_differences(step: float) -> None:
    grid = uneven((3, 4, 2), step=step)
    size = grid.high - grid.low
    origin = (grid.low + size * (1.6 * uniform(6, 3, seed=2) - 0.3)).requires_grad_()
    direction, moments = normal(6, 3, seed=3).requires_grad_(), grid.moments.requires_grad_()

    def crossings(origin: Tensor, direction: Tensor, moments: Tensor) -> Tensor:
        return DensityGrid(moments, grid.low, grid.voxel, step=step).crossings(origin, direction, 0.001)

    assert torch.autograd.gradcheck(crossings, (origin, direction, moments), eps=1e-6, atol=1e-6, rtol=1e-5)


def _gradients(grid: DensityGrid, origin: Tensor, direction: Tensor) -> list[Tensor]:
    given = [x.detach().clone().requires_grad_() for x in (origin, direction, grid.moments)]
    own = DensityGrid(given[2], grid.low, grid.voxel, step=grid.step)
    return list(torch.autograd.grad(own.crossings(*given[:2]).sum(), given))


@pytest.mark.parametrize("kind", ["empty", "aligned", "isotropic"])
def test_gradients_are_finite_everywhere(kind: str) -> None:
    axis = torch.tensor([0.0, 0.0, 1.0], dtype=F64)
    tensor = {"empty": torch.zeros(3, 3), "aligned": axis[:, None] * axis, "isotropic": torch.eye(3)}[kind].to(F64)
    grid = homogeneous(tensor, (4, 5, 3))
    origin, direction = _rays(grid, 64)
    direction[-16:] = axis  # along the fibres
    origin[-8:] = grid.low
    for dtype in (torch.float64, torch.float32):
        for gradient in _gradients(grid, origin.to(dtype), direction.to(dtype)):
            assert bool(gradient.isfinite().all())


def test_chunks_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    grid = uneven(step=0.5, mode="eager")
    rays = _rays(grid, 60)
    n, gradients = grid.crossings(*rays), _gradients(grid, *rays)
    monkeypatch.setattr(march, "_SAMPLES", 100)
    assert torch.equal(grid.crossings(*rays), n)
    for ours, wanted in zip(_gradients(grid, *rays), gradients, strict=True):
        assert torch.allclose(ours, wanted, rtol=1e-12, atol=1e-14)


@compiled
def test_auto_compiles_unless_gradients_are_asked_for() -> None:
    grid = uneven()
    origin, direction = _rays(grid, 20)
    assert grid.crossings(origin.requires_grad_(), direction).requires_grad
    with torch.no_grad():
        assert not grid.crossings(origin, direction).requires_grad
    with pytest.raises(InputError, match="gradients"):
        uneven(mode="compiled").crossings(origin, direction)


def test_without_a_compiler_torch_serves(monkeypatch: pytest.MonkeyPatch) -> None:
    def none(*_: object) -> None:
        raise NoCompiler("none here")

    monkeypatch.setattr("dsfit.render.grid.density.Compiled", none)
    grid = uneven()
    rays = _rays(grid, 9)
    assert grid.backend == "eager" and torch.equal(grid.crossings(*rays), uneven(mode="eager").crossings(*rays))
    with pytest.raises(InputError, match="none here"):
        uneven(mode="compiled")


def test_copies_and_pickles_give_the_same() -> None:
    grid = uneven()
    rays = _rays(grid, 30)
    n = grid.crossings(*rays)
    for other in (copy.deepcopy(grid), pickle.loads(pickle.dumps(grid))):
        assert torch.equal(other.crossings(*rays), n)


@pytest.mark.parametrize(
    ("origin", "direction", "field"),
    [
        (torch.tensor([0.0, float("nan"), 0.0]), torch.ones(3), "origin"),
        (torch.zeros(3), torch.tensor([1.0, float("inf"), 0.0]), "direction"),
        (torch.zeros(3), torch.zeros(3), "direction"),
        (torch.zeros(3), torch.full((3,), 1e-20), "direction"),
        (torch.zeros(2), torch.ones(3), "origin"),
        (torch.zeros(3), torch.ones(3, dtype=torch.int64), "direction"),
        (torch.zeros(4, 3), torch.ones(5, 3), "origin, direction"),
        ([0.0, 0.0, 0.0], torch.ones(3), "origin"),
    ],
)
def test_bad_rays_are_refused(origin: Tensor, direction: Tensor, field: str) -> None:
    with pytest.raises(InputError) as error:
        uneven().crossings(origin, direction)
    assert error.value.field == field


def test_bad_radii_are_refused() -> None:
    for radius in (-0.1, float("nan")):
        with pytest.raises(InputError, match="radius"):
            uneven().crossings(torch.zeros(3), torch.ones(3), radius)
