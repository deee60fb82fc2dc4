"""The peers with tables: unbiased, CDFs inverted exactly, the mixture of a grid's tables what it says."""

from __future__ import annotations

import math

import pytest
import torch

import dsfit
from dsfit.proposals.table_2d import Table2D, Tables
from dsfit.proposals.table_2d_grid import GridOfTables
from dsfit.race.peer import Peer
from dsfit.race.peers.table import OwnTable, SharedTables
from tests.race.peers_support import CONTEXTS, estimates, integrand, is_centred, ready, root_mean_square

SMALL = {"views": 17, "depths": 5, "resolution": (48, 24)}


def peers() -> list[Peer]:
    return [OwnTable((48, 24)), SharedTables(**SMALL), SharedTables(**SMALL, blend="nearest")]


@pytest.mark.parametrize("uniforms", ["random", "sobol"])
@pytest.mark.parametrize("k", range(3))
def test_unbiased_and_a_bias_of_a_few_percent_is_seen(k: int, uniforms: str) -> None:
    found = estimates(ready(peers()[k], uniforms))
    assert is_centred(found, resolution=0.01)
    assert not is_centred(1.03 * found, resolution=0.01)


@pytest.mark.parametrize("k", range(2))
def test_masses_of_the_neighbouring_row_are_seen(monkeypatch: pytest.MonkeyPatch, k: int) -> None:
    sampler = ready(peers()[k])
    right_find, right_at = Tables.find, Tables.at

    def find(self: Tables, which: torch.Tensor, u: torch.Tensor) -> tuple[torch.Tensor, ...]:
        theta_i, phi, _ = right_find(self, which, u)
        return theta_i, phi, at(self, which, theta_i, phi)

    def at(self: Tables, which: torch.Tensor, theta_i: torch.Tensor, phi: torch.Tensor) -> torch.Tensor:
        return right_at(self, which, theta_i + math.pi / 48, phi)

    monkeypatch.setattr(Tables, "find", find)
    monkeypatch.setattr(Tables, "at", at)
    assert not is_centred(estimates(sampler, runs=24))


def test_sobol_points_lower_the_error() -> None:
    for k in range(2):
        plain, quasi = (root_mean_square(estimates(ready(peers()[k], kind), runs=24)) for kind in ("random", "sobol"))
        assert bool((quasi < 0.8 * plain).all())


def test_more_cells_and_more_views_come_closer() -> None:
    def variance(proposal: torch.nn.Module) -> torch.Tensor:
        u = torch.rand(4000, 4, 2, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
        with torch.no_grad():
            omega, log_p = proposal(CONTEXTS.to(torch.float64)).sample_with_log_prob(u)
            weight = integrand()(omega, CONTEXTS.to(torch.float64)).norm(dim=-1) * torch.exp(-log_p)
        return weight.var(0) / weight.mean(0) ** 2

    coarse, fine = variance(Table2D(integrand(), (16, 8))), variance(Table2D(integrand(), (64, 64)))
    assert bool((fine < 0.5 * coarse).all()) and bool((fine < 0.03).all())
    grids = [variance(GridOfTables(integrand(), n, (0.0, 2.0, 8.0), (48, 24))) for n in (5, 21)]
    assert bool((grids[1] <= grids[0] * (1 + 1e-9)).all())  # theta_r = 0 is on both grids
    assert bool((grids[1][2:] < 0.1 * grids[0][2:]).all())


def test_a_table_is_drawn_exactly() -> None:
    """Stratified uniforms fill cells in proportion to their masses, and uniformly inside."""
    mass = torch.tensor([[[1.0, 2.0, 0.0], [0.0, 0.0, 0.0], [3.0, 1.0, 5.0]]], dtype=torch.float64)
    tables = Tables.of(mass, 1e-9, even=False)
    line = (torch.arange(600, dtype=torch.float64) + 0.5) / 600
    u = torch.cartesian_prod(line, line)
    theta, phi, log_density = tables.find(torch.zeros(len(u), dtype=torch.int64), u)
    row, column = ((theta / math.pi + 0.5) * 3).long().clamp(0, 2), ((phi / math.pi + 1) * 1.5).long().clamp(0, 2)
    counted = torch.bincount(row * 3 + column, minlength=9).reshape(3, 3) / len(u)
    torch.testing.assert_close(counted.double(), mass[0] / 12, rtol=0, atol=3e-3)
    torch.testing.assert_close(log_density, tables.at(torch.zeros(len(u), dtype=torch.int64), theta, phi))
    area = (math.pi / 3) * (2 * math.pi / 3)
    torch.testing.assert_close(torch.exp(log_density).max() * area, mass.max() / 12, rtol=1e-6, atol=0)
    inside = (theta[row == 2] / math.pi + 0.5) * 3 - 2
    assert abs(float(inside.mean()) - 0.5) < 2e-3


def test_a_table_without_light_is_uniform() -> None:
    tables = Tables.of(torch.zeros(1, 4, 4, dtype=torch.float64), 0.01, even=True)
    torch.testing.assert_close(torch.exp(tables.log_density), torch.full((1, 4, 4), 1 / (2 * math.pi**2)).double())


def test_a_grid_weighs_direct_and_scattered_tables_by_their_light() -> None:
    """At a context of the grid, with v between 0 and 1, the two shares are those of F's two parts."""
    grid = GridOfTables(integrand(), views=9, depths=(0.0, 4.0, 30.0), resolution=(64, 64))
    share = torch.tensor([0.0, 0.3, 1.0], dtype=torch.float64)
    found = torch.exp(grid(dsfit.Context(math.pi / 8, 0.0, 4.0, share)).log_weights)
    lit, unlit = (dsfit.reference(integrand(), dsfit.Context(math.pi / 8, 0.0, 4.0, v), 1e-5).norm for v in (1.0, 0.0))
    expected = share * lit / (share * lit + (1 - share) * unlit)
    torch.testing.assert_close(found[:, :2].sum(-1), expected, rtol=0, atol=5e-3)
    torch.testing.assert_close(found.sum(-1), torch.ones(3, dtype=torch.float64))


def test_integrands_that_are_not_even_get_the_whole_circle() -> None:
    bsdf = dsfit.DualScattering(dsfit.Fiber.preset("brown", eccentricity=0.9), d_b=0.0)
    uneven = dsfit.Integrand(bsdf)
    distribution = Table2D(uneven, (16, 16))(dsfit.Context(0.2))
    assert not distribution.tables.even
    u = torch.rand(200, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    omega, log_p = distribution.sample_with_log_prob(u)
    torch.testing.assert_close(distribution.log_prob(omega), log_p)
    assert bool((omega[:, 1] > 0).any()) and bool((omega[:, 1] < 0).any())


@pytest.mark.parametrize(
    ("make", "field"),
    [
        (lambda: OwnTable((0, 4)), "table_2d.resolution"),
        (lambda: OwnTable("many"), "table_2d.resolution"),
        (lambda: OwnTable(samples=0), "table_2d.samples"),
        (lambda: OwnTable(defensive=0.0), "table_2d.defensive"),
        (lambda: SharedTables(views=1), "table_grid.views"),
        (lambda: SharedTables(depths=1), "table_grid.depths"),
        (lambda: SharedTables(blend="cubic"), "table_grid.blend"),
        (lambda: GridOfTables(integrand(), depths=(1.0, 0.5)), "depths"),
    ],
)
def test_bad_options_are_named(make, field: str) -> None:  # noqa: ANN001
    with pytest.raises(dsfit.InputError, match=field):
        make()
