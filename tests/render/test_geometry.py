"""Generators of strands: reproducible, inside their stated size, hair-like, and with the stated scatter counts."""

from __future__ import annotations

import inspect
import math
from typing import Any

import pytest
import torch

from dsfit.errors import InputError
from dsfit.render import Strands
from dsfit.render.exact_counts import exact_crossings
from dsfit.render.geometry import GENERATORS, VIEWS, block, double_block, suggested_view

FEW: dict[str, Any] = {"strands": 60}
SMALL = {name: {"strands": (40, 20)} if name == "double_block" else FEW for name in GENERATORS}
NAMES = sorted(GENERATORS)


@pytest.mark.parametrize("name", NAMES)
def test_seed_decides_everything(name: str) -> None:
    state = torch.get_rng_state()
    one, same, other = (GENERATORS[name](seed=seed, **SMALL[name]) for seed in (4, 4, 5))
    assert torch.equal(torch.get_rng_state(), state)  # no global randomness used
    assert torch.equal(one.points, same.points) and torch.equal(one.radius, same.radius)
    assert (one.points - other.points).abs().max() > 0.1
    assert one.points.dtype == one.radius.dtype == torch.float64
    assert len(one) == 60


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_strands_are_smooth_and_of_even_steps(name: str, seed: int) -> None:
    """No kinks: the angle between segments that meet stays small (but for a few flyaways); no strand has a piece that
    is many times as long as another."""
    hair = GENERATORS[name](seed=seed, **({} if name == "double_block" else {"strands": 1500}))
    points = hair.points.reshape(len(hair), -1, 3)
    step = points.diff(dim=1)
    length = step.norm(dim=-1)
    assert float((length.amax(1) / length.amin(1)).quantile(0.99)) < 10
    cosine = (step[:, 1:] * step[:, :-1]).sum(-1) / (length[:, 1:] * length[:, :-1])
    assert float(cosine.flatten()[::7].quantile(0.001)) > math.cos(math.radians(35))
    assert float(cosine.flatten().median()) > math.cos(math.radians(20))


@pytest.mark.parametrize("name", NAMES)
def test_radii_vary_and_taper_towards_the_tip(name: str) -> None:
    generator = GENERATORS[name]
    radius = generator(**SMALL[name]).radius.reshape(60, -1)
    default = inspect.signature(block if name == "double_block" else generator).parameters["radius"].default
    assert radius[:, 0].mean().item() == pytest.approx(default, rel=0.03)
    assert float(radius[:, 0].std() / default) == pytest.approx(0.2 / math.sqrt(12), rel=0.3)
    tip = radius[:, -1] / radius[:, 0]
    expected = 1.0 if "block" in name else 0.25
    assert torch.allclose(tip, torch.full_like(tip, expected), rtol=1e-9)
    assert bool((radius.diff(dim=1) <= 1e-15).all())


@pytest.mark.parametrize(
    ("name", "low", "high"),
    [
        ("block", (-2.5, -2.5, -2.5), (2.5, 2.5, 2.5)),
        ("double_block", (-5.25, -2.5, -2.5), (5.25, 2.5, 2.5)),
        ("straight_bundle", (-1.4, -6.0, -0.6), (1.4, 6.0, 0.6)),
        ("wavy_bundle", (-3.5, -7.0, -1.3), (3.5, 7.0, 1.3)),
        ("curly_wisp", (-1.8, -5.0, -1.2), (1.8, 5.0, 1.2)),
        ("ball", (-2.5, -2.5, -2.5), (2.5, 2.5, 2.5)),
    ],
)
def test_fills_its_size(name: str, low: tuple[float, ...], high: tuple[float, ...]) -> None:
    """98 percent of the points lie in the stated box widened by a tenth of its diagonal, and they reach its sides."""
    hair = GENERATORS[name]()
    points = hair.points[:: max(1, len(hair.points) // 50_000)]
    least, most = torch.tensor(low, dtype=torch.float64), torch.tensor(high, dtype=torch.float64)
    slack = 0.1 * float((most - least).norm())
    inside = ((points > least - slack) & (points < most + slack)).all(-1).double().mean()
    assert float(inside) > 0.98
    assert bool(((points.amin(0) - least).abs() < 2 * slack).all())
    assert bool(((points.amax(0) - most).abs() < 2 * slack).all())


@pytest.mark.parametrize("name", ["block", "double_block", "straight_bundle", "wavy_bundle", "curly_wisp"])
def test_hangs_down_from_its_roots(name: str) -> None:
    hair = GENERATORS[name](**SMALL[name])
    points = hair.points.reshape(60, -1, 3)
    top = points[:, 0, 1]
    assert float(top.max() - top.min()) < 1e-9
    assert bool((points[:, -1, 1] < top - 1).all())


def test_ball_roots_are_on_a_sphere_and_strands_go_round_it() -> None:
    hair = GENERATORS["ball"](strands=3000)
    points = hair.points.reshape(3000, -1, 3)
    root = points[:, 0].norm(dim=-1)
    assert torch.allclose(root, torch.full_like(root, 1.8), rtol=1e-12)
    assert float((points.norm(dim=-1) > 1.75).double().mean()) > 0.97  # around, not through
    assert float(points[:, 0].mean(0).norm()) < 0.2  # all around
    distance = points.norm(dim=-1).flatten()
    assert 2.2 < float(distance[::3].quantile(0.95)) < 2.6


@pytest.mark.parametrize("strands", [1500, 12000])
@pytest.mark.parametrize("disorder", [0.0, 1.0])
def test_block_has_the_stated_counts(strands: int, disorder: float) -> None:
    """n = strands x 2 radius / side straight through: 5 to 40; Poisson spread where strands stand independently."""
    hair = block(seed=1, strands=strands, points=6, disorder=disorder)
    generator = torch.Generator().manual_seed(0)
    start = 4.0 * torch.rand(200, 2, generator=generator, dtype=torch.float64) - 2.0
    start[:, 0] += 0.3  # clear of the cut ends at the bottom
    origin = torch.cat([torch.full((200, 1), -8.0, dtype=torch.float64), start], -1)
    found = exact_crossings(hair, origin, torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)).double()
    expected = strands * 2 / 120 / 5
    assert float(found.mean()) == pytest.approx(expected, rel=0.12)
    if not disorder:
        assert float(found.mean()) == pytest.approx(expected, abs=5 * math.sqrt(expected / 200))
        assert float(found.var()) == pytest.approx(expected, rel=0.4)


def test_double_block_is_two_blocks_of_the_given_density() -> None:
    hair = double_block(strands=(30, 90), gap=2.0, disorder=0.0, points=3)
    right = hair.points.reshape(120, 3, 3)[..., 0].amin(1) > 0
    assert right.tolist() == [False] * 30 + [True] * 90
    assert float(hair.points[:, 0].abs().min()) >= 1.0
    blocks = hair.points.reshape(120, 3, 3)[:, 0, 0]
    assert not torch.equal(blocks[:30] + 3.5, blocks[30:60] - 3.5)  # not the same block twice


def test_without_disorder_strands_are_straight() -> None:
    hair = block(strands=50, disorder=0.0)
    points = hair.points.reshape(50, -1, 3)
    assert torch.equal(points[:, 0, ::2], points[:, -1, ::2])


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(("direction", "aspect"), [(None, 1.0), ((1.0, -0.5, -0.3), 1.0), (None, 0.4), (None, 2.5)])
def test_suggested_view_sees_every_strand(name: str, direction: tuple[float, ...] | None, aspect: float) -> None:
    """Every point is in front of the camera and inside the picture, which they nearly fill."""
    assert sorted(VIEWS) == NAMES
    hair = GENERATORS[name](**SMALL[name])
    position, target, up, fov = suggested_view(hair, VIEWS[name] if direction is None else direction, aspect=aspect)
    forward = (target - position) / (target - position).norm()
    right = torch.linalg.cross(forward, up)
    right = right / right.norm()
    over = torch.linalg.cross(right, forward)
    points = hair.points - position
    depth = points @ forward
    assert bool((depth > 0).all())
    plane = torch.stack([points @ right / aspect, points @ over], -1) / depth[:, None] / math.tan(math.radians(fov) / 2)
    assert 0.88 < float(plane.abs().max()) < 1.0


def bad(name: str) -> list[tuple[str, Any]]:
    cases: list[tuple[str, Any]] = [
        ("seed", -1),
        ("seed", 1.5),
        ("seed", True),
        ("strands", 0),
        ("strands", 10**9),
        ("strands", "many"),
        ("points", 2),
        ("points", 10.0),
        ("radius", 0.0),
        ("radius", -1.0),
        ("radius", math.nan),
        ("radius", math.inf),
        ("radius", "thick"),
        ("flyaways", 1.5),
    ]
    known = {**inspect.signature(GENERATORS[name]).parameters, **inspect.signature(block).parameters}
    numbers = [key for key, p in known.items() if isinstance(p.default, float)]
    cases += [(key, value) for key in numbers if key in _own(name) for value in (math.nan, None, "x", -1e30)]
    return cases


def _own(name: str) -> set[str]:
    return set(inspect.signature(GENERATORS[name]).parameters)


@pytest.mark.parametrize("name", NAMES)
def test_bad_arguments_are_named(name: str) -> None:
    for field, value in bad(name):
        with pytest.raises(InputError) as caught:
            GENERATORS[name](**{**SMALL[name], field: value})
        assert field in caught.value.field


def test_a_size_beyond_memory_is_refused() -> None:
    with pytest.raises(InputError, match="at most 20000000 points"):
        block(strands=1_000_000, points=100)


@pytest.mark.parametrize("strands", [1000, (10,), (10, 20, 30), (0, 10), (10, "x")])
def test_double_block_wants_two_counts(strands: Any) -> None:
    with pytest.raises(InputError, match="strands"):
        double_block(strands=strands)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("direction", (0.0, 1.0, 0.0)),
        ("direction", (0.0, 0.0, 0.0)),
        ("direction", (1.0, 0.0)),
        ("direction", (math.nan, 0.0, 1.0)),
        ("fov_deg", 0.0),
        ("fov_deg", 180.0),
        ("margin", 0.5),
        ("aspect", 0.0),
    ],
)
def test_bad_views(field: str, value: Any) -> None:
    line = Strands(torch.eye(3, dtype=torch.float64)[:2], torch.tensor([0, 2]), torch.ones(2, dtype=torch.float64))
    with pytest.raises(InputError, match=field):
        suggested_view(line, **{field: value})
