"""Strands moved, scaled, thinned out: what stays as it is stays as it is."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dsfit.errors import InputError
from dsfit.render import Strands
from dsfit.render.exact_counts import exact_crossings
from dsfit.render.geometry import (
    block,
    curly_wisp,
    fitted_into,
    joined,
    scaled,
    subsampled,
    translated,
    turned_up,
    with_radius,
)


def uneven() -> Strands:
    points = torch.arange(27, dtype=torch.float64).reshape(9, 3) ** 1.5
    return Strands(points, torch.tensor([0, 2, 5, 9]), torch.linspace(0.1, 0.9, 9, dtype=torch.float64))


def test_moved_and_scaled() -> None:
    hair = uneven()
    moved = scaled(translated(hair, (1.0, -2.0, 3.0)), 2.0)
    assert torch.equal(moved.points, 2 * (hair.points + torch.tensor([1.0, -2.0, 3.0])))
    assert torch.equal(moved.radius, 2 * hair.radius)
    assert torch.equal(moved.first, hair.first)
    assert translated(hair, torch.zeros(3)).points.dtype == torch.float64


@settings(max_examples=30, deadline=None)
@given(
    st.lists(st.floats(0.01, 100), min_size=3, max_size=3), st.floats(-50, 50), st.floats(0.01, 50), st.booleans()
)
def test_fits_into_a_box(size: list[float], shift: float, factor: float, cube: bool) -> None:
    """Centred, inside, touching the box in one direction, and of the same shape."""
    hair = scaled(translated(curly_wisp(strands=9), (shift, -shift, shift / 2)), factor)
    box = torch.tensor(size[:1] * 3 if cube else size, dtype=torch.float64)
    fitted = fitted_into(hair, size[0] if cube else size)
    low, high = fitted.bounds
    assert torch.allclose(low + high, torch.zeros(3, dtype=torch.float64), atol=1e-9 * max(size))
    fill = (high - low) / box
    assert float(fill.max()) == pytest.approx(1.0)
    ratio = fitted.radius / hair.radius
    assert torch.allclose(ratio, ratio[0].expand_as(ratio))
    step = fitted.points.diff(dim=0).norm(dim=-1) / hair.points.diff(dim=0).norm(dim=-1)
    assert torch.allclose(step, ratio[0].expand_as(step), rtol=1e-9)


def test_one_radius() -> None:
    assert torch.equal(with_radius(uneven(), 0.3).radius, torch.full((9,), 0.3, dtype=torch.float64))


def test_every_third_strand() -> None:
    hair = curly_wisp(strands=10, points=5)
    some = subsampled(hair, 3)
    assert len(some) == 4
    expected = hair.points.reshape(10, 5, 3)[[0, 3, 6, 9]].reshape(-1, 3)
    assert torch.equal(some.points, expected)
    uneven_some = subsampled(uneven(), 2, keep="radius")
    assert uneven_some.first.tolist() == [0, 2, 6]
    assert torch.equal(uneven_some.points, uneven().points[[0, 1, 5, 6, 7, 8]])
    assert torch.equal(uneven_some.radius, uneven().radius[[0, 1, 5, 6, 7, 8]])


@pytest.mark.parametrize(("keep", "factor"), [("counts", 4.0), ("volume", 2.0), ("radius", 1.0)])
def test_subsampling_scales_radii(keep: str, factor: float) -> None:
    hair = block(strands=40, points=4)
    assert torch.allclose(subsampled(hair, 4, keep=keep).radius, factor * hair.radius.reshape(40, 4)[::4].flatten())
    volume = (hair.radius**2).sum() / (subsampled(hair, 4, keep="volume").radius ** 2).sum()
    assert float(volume) == pytest.approx(1.0, rel=0.1)


def test_subsampling_keeps_scatter_counts() -> None:
    hair = block(strands=3000, points=4)
    generator = torch.Generator().manual_seed(0)
    side = 3.0 * torch.rand(300, 2, generator=generator, dtype=torch.float64) - 1.5
    origin = torch.cat([torch.full((300, 1), -8.0, dtype=torch.float64), side], -1)
    across = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    all_of_them, some = (exact_crossings(s, origin, across).double().mean() for s in (hair, subsampled(hair, 5)))
    assert float(some / all_of_them) == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("up", ["x", "y", "z", "-x", "-y", "-z"])
def test_turning_is_a_rotation(up: str) -> None:
    axes = Strands(torch.eye(3, dtype=torch.float64), torch.tensor([0, 3]), torch.ones(3, dtype=torch.float64))
    turned = turned_up(axes, up).points
    assert float(torch.linalg.det(turned)) == pytest.approx(1.0)
    sign = -1.0 if up[0] == "-" else 1.0
    assert turned["xyz".index(up[-1])].tolist() == [0.0, sign, 0.0]
    assert torch.equal(turned @ turned.T, torch.eye(3, dtype=torch.float64))
    if up == "y":
        assert torch.equal(turned, axes.points)


def test_joined() -> None:
    both = joined([uneven(), block(strands=2, points=3)])
    assert both.first.tolist() == [0, 2, 5, 9, 12, 15]
    assert torch.equal(both.points[:9], uneven().points)
    assert torch.equal(both.radius[9:], block(strands=2, points=3).radius)


@pytest.mark.parametrize(
    ("call", "arguments", "field"),
    [
        (translated, ((1.0, 2.0),), "translated.by"),
        (translated, ((1.0, 2.0, math.nan),), "translated.by"),
        (translated, ("up",), "translated.by"),
        (scaled, (0.0,), "scaled.factor"),
        (scaled, (-1.0,), "scaled.factor"),
        (scaled, (math.inf,), "scaled.factor"),
        (scaled, (None,), "scaled.factor"),
        (fitted_into, (0.0,), "fitted_into.size"),
        (fitted_into, ((1.0, 1.0, -1.0),), "fitted_into.size"),
        (fitted_into, ((1.0, 1.0),), "fitted_into.size"),
        (fitted_into, (math.nan,), "fitted_into.size"),
        (fitted_into, ("big",), "fitted_into.size"),
        (with_radius, (0.0,), "with_radius.radius"),
        (with_radius, (math.nan,), "with_radius.radius"),
        (subsampled, (0,), "subsampled.every"),
        (subsampled, (4,), "subsampled.every"),
        (subsampled, (1.5,), "subsampled.every"),
        (subsampled, (2, "mass"), "subsampled.keep"),
        (turned_up, ("w",), "up"),
        (turned_up, (None,), "up"),
    ],
)
def test_bad_arguments(call: Any, arguments: tuple[Any, ...], field: str) -> None:
    with pytest.raises(InputError) as caught:
        if arguments[-1] == "mass":
            call(uneven(), arguments[0], keep="mass")
        else:
            call(uneven(), *arguments)
    assert caught.value.field.startswith(field)


def test_joining_nothing() -> None:
    with pytest.raises(InputError, match="joined.parts"):
        joined([])
