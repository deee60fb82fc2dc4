"""n and v of hits, hints, and the table of directions."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from dsfit import DualScattering, Fiber, Integrand
from dsfit.context import Context
from dsfit.errors import InputError
from dsfit.frame import to_vector
from dsfit.render import HitContext
from dsfit.render.geometry import block
from dsfit.render.grid import DensityGrid, DirectionalTable, GridScattering
from dsfit.render.grid.table import directions
from tests.render.grid_cases import F64, hits_at, homogeneous, normal, uneven, uniform

HITS = 12


def _grid(**options: object) -> DensityGrid:
    return uneven((6, 5, 7), **options)


def _positions(grid: DensityGrid, count: int = HITS) -> Tensor:
    return grid.low + (grid.high - grid.low) * uniform(count, 3, seed=4)


def _omega(*shape: int) -> Tensor:
    u = uniform(*shape, 2, seed=7)
    return torch.stack([torch.asin(2 * u[..., 0] - 1), 2 * math.pi * u[..., 1] - math.pi], dim=-1)


def _context(hit: Tensor, dtype: torch.dtype = F64) -> HitContext:
    return HitContext(torch.zeros(hit.shape, dtype=dtype) + 0.2, 0.3, hit=hit)


@pytest.mark.parametrize("mode", ["eager", "auto"])
def test_rays_start_at_the_hits_and_turn_with_their_frames(mode: str) -> None:
    grid = _grid(mode=mode, max_n=1e9)
    hits = hits_at(_positions(grid), radius=0.02)
    hit, omega = torch.tensor([[3, 3, 0], [11, 5, 1]]), _omega(5, 2, 3)
    n, v = GridScattering(grid, hits)(omega, _context(hit))
    assert n.shape == v.shape == (5, 2, 3)
    for s, i, j in ((0, 0, 0), (2, 1, 1), (4, 0, 2), (3, 1, 0)):
        one = hit[i, j]
        world = hits.frame[one].T @ to_vector(omega[s, i, j])
        wanted = _grid(mode="eager", max_n=1e9).crossings(hits.position[one], world, 0.02)
        assert float(n[s, i, j]) == pytest.approx(float(wanted), rel=1e-5, abs=1e-5)
    assert torch.allclose(v, torch.exp(-n))


def test_rules_for_the_lit_share() -> None:
    grid = homogeneous(torch.eye(3, dtype=F64) * 0.2)
    hits = hits_at(_positions(grid))
    omega, context = _omega(40, HITS), _context(torch.arange(HITS))
    n, v = GridScattering(grid, hits, "threshold")(omega, context)
    assert torch.equal(v, (n <= 0.5).to(F64)) and 0 < float(v.mean()) < 1
    n, v = GridScattering(grid, hits, 0.25)(omega, context)
    assert torch.equal(v, torch.where(n == 0, 1.0, 0.25).to(F64))


def test_works_in_an_integrand_and_with_gradients() -> None:
    grid = _grid()
    hits = hits_at(_positions(grid))
    bsdf = DualScattering(Fiber.preset("brown"), precision="table")
    integrand = Integrand(bsdf, scattering=GridScattering(grid, hits))
    context = _context(torch.arange(HITS))
    omega = _omega(8, HITS)
    plain = integrand(omega, context)
    leaf = omega.clone().requires_grad_()
    graded = integrand(leaf, context)
    (gradient,) = torch.autograd.grad(graded.sum(), leaf)
    assert torch.allclose(plain, graded.detach(), rtol=1e-3, atol=1e-6) and bool(gradient.isfinite().all())
    assert float(gradient.abs().max()) > 0
    part = integrand(omega[:, 2:5], context[2:5])  # contexts know their hits
    assert torch.allclose(part, plain[:, 2:5])


def test_dtypes() -> None:
    grid = _grid()
    scattering = GridScattering(grid, hits_at(_positions(grid)))
    for dtype in (torch.float32, torch.float64):
        n, v = scattering(_omega(3, HITS).to(dtype), _context(torch.arange(HITS), dtype))
        assert n.dtype == v.dtype == dtype


def test_contexts_without_hits_are_refused() -> None:
    grid = _grid()
    scattering = GridScattering(grid, hits_at(_positions(grid)))
    with pytest.raises(InputError, match="HitContext"):
        scattering(_omega(1), Context(torch.zeros(1, dtype=F64)))
    for hit in (HITS, -1):
        with pytest.raises(InputError, match="context.hit"):
            scattering(_omega(1), _context(torch.tensor([hit])))
    with pytest.raises(InputError, match="v"):
        GridScattering(grid, hits_at(_positions(grid)), "lit")


def test_directions_cover_the_sphere_evenly() -> None:
    d = directions(16, 32).reshape(-1, 3)
    assert torch.allclose(d.norm(dim=-1), torch.ones(len(d), dtype=F64))
    assert torch.allclose(d.mean(0), torch.zeros(3, dtype=F64), atol=1e-12)
    assert torch.allclose(d.T @ d / len(d), torch.eye(3, dtype=F64) / 3, atol=2e-3)


def test_table_holds_n_at_its_points() -> None:
    grid = _grid(mode="eager")
    table = DirectionalTable.of(grid, lattice=5, rows=3, columns=6)
    x, y, z = table.n.shape[:3]
    points = [torch.linspace(float(grid.low[a]), float(grid.high[a]), k, dtype=F64) for a, k in enumerate((x, y, z))]
    place, d = torch.stack([points[0][1], points[1][2], points[2][3]]), directions(3, 6)
    wanted = grid.crossings(place, d, 0.0)
    assert torch.allclose(table.at(place), wanted, rtol=1e-4, atol=1e-4)
    assert torch.allclose(table.crossings(place.expand(3, 6, 3), d), wanted, rtol=1e-4, atol=1e-4)
    half = torch.stack([(points[0][1] + points[0][2]) / 2, points[1][2], points[2][3]])
    other = torch.stack([points[0][2], points[1][2], points[2][3]])
    assert torch.allclose(table.at(half), (table.at(place) + table.at(other)) / 2)
    assert table.at(place.float().expand(4, 3)).shape == (4, 3, 6)


def test_table_is_close_to_the_march_in_hair() -> None:
    strands = block(seed=1, strands=1500)
    grid = DensityGrid.of(strands, 24)
    origin = strands.points[torch.arange(0, len(strands.points), 37)]
    d = normal(len(origin), 3, seed=2)
    n, table = grid.crossings(origin, d, 0.0), grid.directional(lattice=12, rows=8, columns=16)
    found = table.crossings(origin, d)
    assert float((found - n).abs().mean()) < 0.2 * float(n.mean())
    assert float((found - n).square().mean()) < 0.2 * float(n.var())


def test_hints_are_the_sphere_averages_of_scattering() -> None:
    grid = homogeneous(torch.eye(3, dtype=F64) * 0.3, (12, 10, 8), mode="auto")
    # where no ray leaves at once: at the border n jumps, and with it v of the third rule
    position = 0.7 * _positions(grid) + 0.3 * (grid.low + grid.high) / 2
    table = grid.directional(lattice=20, rows=16, columns=32)
    for rule in ("poisson", "threshold", 0.25):
        n, v = table.hints(position, rule)
        exact = GridScattering(grid, hits_at(position, radius=1e-9), rule).hints(_context(torch.arange(HITS)))
        assert torch.allclose(n, exact.n, rtol=0.03, atol=0.01)
        # n jumps over 1/2 in whole rows and columns of directions
        assert torch.allclose(v, exact.v, rtol=0.03, atol=0.04 if rule == "threshold" else 0.01)


def test_hints_everywhere() -> None:
    grid = _grid()
    for dtype in (torch.float32, torch.float64):
        n, v = grid.hints(torch.cat([_positions(grid), grid.low - 5.0 * torch.eye(3, dtype=F64)]).to(dtype))
        assert n.dtype == v.dtype == dtype and n.shape == (HITS + 3,)
        assert bool((n >= 0).all()) and bool(((v >= 0) & (v <= 1)).all())
    empty = DensityGrid(torch.zeros(2, 2, 2, 6), (0, 0, 0), 1.0)
    n, v = empty.hints(torch.rand(5, 3))
    assert bool((n == 0).all()) and bool((v == 1).all())
    assert grid.table is grid.table and grid.table.memory == 4 * grid.table.n.numel()


def test_bad_lookups_are_refused() -> None:
    grid = _grid()
    for options, field in (({"lattice": 1}, "lattice"), ({"rows": 0}, "rows"), ({"columns": 2.0}, "columns")):
        with pytest.raises(InputError) as error:
            grid.directional(**options)
        assert error.value.field == field
    with pytest.raises(InputError, match="position"):
        grid.hints(torch.tensor([[0.0, float("nan"), 0.0]]))
    with pytest.raises(InputError, match="v"):
        grid.hints(torch.zeros(1, 3), "lit")
    with pytest.raises(InputError, match="v"):
        grid.hints(torch.zeros(1, 3), 1.5)
