"""Uniform numbers: range, reproducibility, uniformity, and what makes each kind more than independent numbers."""

from __future__ import annotations

import pytest
import torch
from scipy import stats

from dsfit.errors import InputError
from dsfit.random import KINDS, child, uniform_chunks, uniforms


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_shape_range_and_seed(kind: str, dtype: torch.dtype) -> None:
    u = uniforms((100, 2, 3), 4, generator=generator(1), kind=kind, dtype=dtype)
    again = uniforms((100, 2, 3), 4, generator=generator(1), kind=kind, dtype=dtype)
    other = uniforms((100, 2, 3), 4, generator=generator(2), kind=kind, dtype=dtype)
    assert u.shape == (100, 2, 3, 4) and u.dtype == dtype
    assert bool((u > 0).all() and (u < 1).all())
    assert torch.equal(u, again) and not torch.equal(u, other)


@pytest.mark.parametrize("kind", KINDS)
def test_open_interval_of_many_float32(kind: str) -> None:
    """torch.rand gives exact zeros in float32 about once in 2^24; with 2^25 numbers one is expected."""
    u = uniforms((2**20,), 32 if kind == "random" else 2, generator=generator(3), kind=kind, dtype=torch.float32)
    assert 0 < float(u.min()) and float(u.max()) < 1


def test_open_interval_replaces_exact_zero(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch, "rand", lambda shape, **options: torch.zeros(shape, dtype=options["dtype"]))
    for kind in ("random", "stratified"):
        assert bool((uniforms((8,), 1, generator=generator(0), kind=kind, dtype=torch.float32) > 0).all())


@pytest.mark.parametrize("kind", KINDS)
def test_every_coordinate_is_uniform(kind: str) -> None:
    """One point of each of many randomisations: independent uniform numbers, whatever the kind."""
    u = uniforms((8, 3000), 3, generator=generator(4), kind=kind)[5]
    p = [stats.kstest(u[:, k].numpy(), "uniform").pvalue for k in range(3)]
    correlation = torch.corrcoef(u.T)[[0, 0, 1], [1, 2, 2]].abs() * 3000**0.5
    assert min(p) > 1e-3 and float(correlation.max()) < 4


def test_stratified_has_one_point_in_each_stratum() -> None:
    u = uniforms((50, 7), 3, generator=generator(5), kind="stratified")
    cells = (u * 50).floor().long().sort(dim=0).values
    assert torch.equal(cells, torch.arange(50)[:, None, None].expand(50, 7, 3))
    assert not torch.equal(u[:, 0].argsort(dim=0), u[:, 1].argsort(dim=0))


def test_sobol_is_a_digital_net_and_scrambling_keeps_it() -> None:
    """Any 2^k x 2^(m-k) grid of cells holds one of 2^m points in the first two dimensions, for every scrambling."""
    u = uniforms((256, 20), 2, generator=generator(6), kind="sobol")
    for k in range(9):
        cell = (u[..., 0] * 2**k).long() * 2 ** (8 - k) + (u[..., 1] * 2 ** (8 - k)).long()
        assert torch.equal(cell.sort(dim=0).values, torch.arange(256)[:, None].expand(256, 20))
    assert torch.unique(u[0, :, 0]).numel() == 20
    # a digital shift alone would leave the differences between two randomisations the same at all points
    digits = (u * 2**40).long()
    assert torch.unique(digits[:, 0] ^ digits[:, 1], dim=0).shape[0] > 64


def test_sobol_point_set_is_that_of_torch_before_scrambling() -> None:
    from dsfit import random as module

    levels, dimension = 6, 5
    state = torch.quasirandom.SobolEngine(dimension).sobolstate
    identity = torch.zeros(levels, dimension, dtype=torch.long)  # no random digits below the diagonal
    directions = module._scramble(state, identity, levels)
    points = torch.zeros(1, dimension, dtype=torch.long)
    for k in range(levels):
        points = torch.cat([points, points ^ directions[k]])
    expected = torch.quasirandom.SobolEngine(dimension).draw(64, dtype=torch.float64)
    ours = points / 2.0**52
    assert torch.equal(torch.unique(ours, dim=0), torch.unique(expected, dim=0))


def test_sobol_error_falls_faster_than_random() -> None:
    """Root mean square error of ∫ prod 2u over the square: slope about -1 or steeper, random -1/2."""
    slopes = {}
    for kind in KINDS:
        rms = [
            (4 * uniforms((n, 200), 2, generator=generator(n), kind=kind).prod(-1).mean(0) - 1).square().mean().sqrt()
            for n in (64, 4096)
        ]
        slopes[kind] = float(torch.log(rms[1] / rms[0]) / torch.log(torch.tensor(64.0)))
    assert slopes["sobol"] < -0.95 and -0.6 < slopes["random"] < -0.4


@pytest.mark.parametrize("rows", [1, 7, 64, 300, 2000])
def test_pieces_of_sobol_are_the_whole(rows: int) -> None:
    whole = uniforms((1000, 3), 2, generator=generator(8), kind="sobol")
    pieces = list(uniform_chunks((1000, 3), 2, generator=generator(8), kind="sobol", rows=rows))
    assert torch.equal(torch.cat(pieces), whole) and max(len(piece) for piece in pieces) <= rows


@pytest.mark.parametrize("kind", KINDS)
def test_pieces_are_bounded_and_complete(kind: str) -> None:
    pieces = list(uniform_chunks((1000, 2), 3, generator=generator(9), kind=kind, rows=100))
    assert sum(len(piece) for piece in pieces) == 1000 and max(len(piece) for piece in pieces) <= 100
    assert uniforms((0, 2), 3, generator=generator(9), kind=kind).shape == (0, 2, 3)
    assert uniforms((1,), 1, generator=generator(9), kind=kind).shape == (1, 1)


def test_children_differ() -> None:
    parent = generator(10)
    first, second = (torch.rand(4, generator=child(parent)) for _ in range(2))
    assert not torch.equal(first, second)


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"kind": "halton"}, "uniforms.kind"),
        ({"generator": None}, "uniforms.generator"),
        ({"dtype": torch.float16}, "uniforms.dtype"),
        ({"shape": (-1,)}, "uniforms.shape"),
        ({"shape": ()}, "uniforms.shape"),
        ({"dimension": 0}, "uniforms.dimension"),
        ({"shape": (2**31,), "kind": "sobol"}, "uniforms.shape[0]"),
    ],
)
def test_bad_input(change: dict, field: str) -> None:
    arguments = {"shape": (4,), "dimension": 2, "generator": generator(0), **change}
    with pytest.raises(InputError) as error:
        uniforms(**arguments)
    assert error.value.field == field
