"""Camera rays against an independent intersection of rays and ribbons, and against areas in closed form."""

from __future__ import annotations

import math
import sys

import numpy as np
import pytest
import torch

from dsfit.errors import InputError
from dsfit.render import Camera, Hits, Strands, Visibility, context_of, coverage_of
from dsfit.render.pixel_samples import pixel_samples


def lines(points: torch.Tensor, radius: float) -> Strands:
    """Strands `[S, K, 3]` of one radius."""
    strands, count, _ = points.shape
    first = torch.arange(0, strands * count + 1, count)
    return Strands(points.reshape(-1, 3), first, torch.full((strands * count,), radius, dtype=torch.float64))


def random_lines(strands: int, points: int, radius: float, seed: int) -> Strands:
    """Straight strands for two points, jagged ones for more."""
    generator = torch.Generator().manual_seed(seed)
    root = 3 * torch.rand(strands, 1, 3, generator=generator, dtype=torch.float64) - 1.5
    along = 1.2 * torch.randn(strands, 1, 3, generator=generator, dtype=torch.float64)
    steps = 0.25 * torch.randn(strands, points, 3, generator=generator, dtype=torch.float64) * (points > 2)
    return lines(root + along * torch.linspace(0, 1, points, dtype=torch.float64).view(-1, 1) + steps, radius)


def wavy_lines(strands: int, radius: float, seed: int) -> Strands:
    """Smooth strands about as wide as a helix of three turns."""
    generator = torch.Generator().manual_seed(seed)
    root, phase = (torch.rand(strands, 1, k, generator=generator, dtype=torch.float64) for k in (3, 1))
    t = torch.linspace(0, 1, 60, dtype=torch.float64).view(-1, 1)
    angle = 2 * math.pi * (3 * t + phase)
    wave = torch.cat([0.1 * angle.cos(), -2 * t.expand(strands, -1, -1), 0.1 * angle.sin()], -1)
    return lines(3 * root - 1.5 + wave, radius)


def brute_force(strands: Strands, camera: Camera, directions: np.ndarray) -> tuple[np.ndarray, ...]:
    """Nearest segment and signed offset: `a + t (b - a) + s m = l d`, m normal to the plane of axis and camera."""
    points = (strands.points - camera.position).numpy()
    segments = np.delete(np.arange(len(points)), strands.first[1:].numpy() - 1)
    nearest = np.full(len(directions), np.inf)
    found, offset = np.full(len(directions), -1), np.zeros(len(directions))
    for number, start in enumerate(segments):
        a, b = points[start], points[start + 1]
        m = np.cross(a, b)
        m /= np.linalg.norm(m)
        matrix = np.stack(np.broadcast_arrays(a - b, -m, directions), axis=-1)
        t, s, far = np.linalg.solve(matrix, np.broadcast_to(a[:, None], (len(directions), 3, 1)))[..., 0].T
        better = (t >= 0) & (t <= 1) & (abs(s) <= strands.radius[start].item()) & (far > 0) & (far < nearest)
        nearest, found = np.where(better, far, nearest), np.where(better, number, found)
        offset = np.where(better, s / strands.radius[start].item() * np.sign(np.dot(m, np.cross(b - a, -a))), offset)
    return found, offset, nearest


def _rays(camera: Camera, seed: int, samples: int) -> torch.Tensor:
    pixel = torch.arange(camera.width * camera.height)
    places = pixel_samples(pixel // camera.width, pixel % camera.width, samples, seed)
    return camera.rays(pixel.unsqueeze(-1).expand(-1, samples), places)[1].flatten(0, 1)


@pytest.mark.parametrize(("radius", "seed"), [(0.05, 1), (0.01, 2), (0.2, 3)])
def test_straight_strands_as_by_brute_force(radius: float, seed: int) -> None:
    strands = random_lines(40, 2, radius, seed)
    camera = Camera((0.3, 0.5, 6.0), (0.0, 0.0, 0.0), fov_deg=45, width=32, height=24)
    hits = Visibility(strands, camera).hits(range(24), range(32), 4, seed)
    found, offset, depth = brute_force(strands, camera, _rays(camera, seed, 4).numpy())
    mine = np.full(len(found), -1)
    mine[(hits.pixel * 4 + hits.sample).numpy()] = hits.strand.numpy()
    assert (found >= 0).sum() > 100
    assert (mine != found).sum() <= 1  # a ray within float32 rounding of an edge
    same = hits.strand.numpy() == found[(hits.pixel * 4 + hits.sample).numpy()]
    index = (hits.pixel * 4 + hits.sample).numpy()[same]
    assert np.abs(hits.offset.numpy()[same] - offset[index]).max() < 1e-9
    assert np.abs(hits.depth.numpy()[same] / depth[index] - 1).max() < 1e-12


def test_bent_strands_as_by_brute_force() -> None:
    strands = random_lines(25, 6, 0.03, 4)
    camera = Camera((0.0, 0.0, 7.0), (0.0, 0.0, 0.0), fov_deg=45, width=32, height=32)
    hits = Visibility(strands, camera).hits(range(32), range(32), 16, 9)
    found, offset, _ = brute_force(strands, camera, _rays(camera, 9, 16).numpy())
    ray = (hits.pixel * 16 + hits.sample).numpy()
    segment = hits.segment.numpy()
    covered = found[ray] >= 0
    same = segment == found[ray]
    # mitred joints: a corner belongs to the other segment, or to none of the rectangles
    assert same.sum() > 1000 and (covered & ~same).sum() < 0.06 * covered.sum()
    assert (~covered).sum() < 0.06 * len(ray) and (found >= 0).sum() - covered.sum() < 0.06 * len(ray)
    # a mitred corner lies radius * slope nearer or farther than the axis, of a distance of 7
    error = np.abs(np.abs(hits.offset.numpy()) - np.abs(offset[ray]))[same]
    assert np.median(error) < 5e-4 and error.max() < 0.01


def test_position_segment_and_radius_of_a_hit_belong_together() -> None:
    strands = random_lines(25, 6, 0.02, 5)
    radius = torch.linspace(0.01, 0.05, len(strands.points), dtype=torch.float64)
    strands = Strands(strands.points, strands.first, radius)
    camera = Camera((0.0, 0.0, 7.0), (0.0, 0.0, 0.0), fov_deg=45, width=32, height=32)
    hits = Visibility(strands, camera).hits(range(32), range(32), 4, 9)
    start = strands.starts[hits.segment]
    assert torch.equal(strands.strand_of_point[start], hits.strand)
    a, b = strands.points[start], strands.points[start + 1]
    share = ((hits.position - a) * (b - a)).sum(-1) / ((b - a) ** 2).sum(-1)
    assert float(share.min()) >= -1e-9 and float(share.max()) <= 1 + 1e-9
    assert torch.allclose(hits.position, a + share.unsqueeze(-1) * (b - a), atol=1e-12)
    radius = strands.radius[start] * (1 - share) + strands.radius[start + 1] * share
    assert torch.allclose(hits.radius, radius, atol=1e-12)
    met = camera.position - hits.depth.unsqueeze(-1) * hits.outgoing
    assert float(((met - hits.position).norm(dim=-1) / hits.radius).max()) < 1.5  # mitre: at most sqrt(2)


def test_offsets_are_uniform_and_have_the_sign_of_tangent_times_outgoing() -> None:
    camera = Camera((0.0, 0.0, 7.0), (0.0, -1.0, 0.0), fov_deg=40, width=64, height=64)
    hits = Visibility(wavy_lines(40, 0.01, 6), camera).hits(range(64), range(64), 32, 2)
    counts = torch.histc(hits.offset, 10, -1, 1)
    assert len(hits) > 5000
    assert float(((counts - counts.mean()) ** 2 / counts.mean()).sum()) < 9 + 5 * math.sqrt(18)  # chi-square, 9
    assert abs(float(hits.offset.mean())) < 4 * math.sqrt(1 / 3 / len(hits))
    met = camera.position - hits.depth.unsqueeze(-1) * hits.outgoing
    side = torch.linalg.cross(hits.frame[:, 0], hits.outgoing)
    product = ((met - hits.position) * side).sum(-1) * hits.offset
    clear = (hits.offset.abs() > 0.3) & (side.norm(dim=-1) > 0.5)
    assert bool((product[clear] > 0).all()) and int(clear.sum()) > 4000


def test_coverage_of_thin_fibres_is_their_projected_area() -> None:
    # Fibres of 1/66 pixel in a plane across the view, none over another: length * 2 r rho / D in that plane each.
    distance, radius, size, length = 10.0, 1e-3, 40, 1.5
    camera = Camera((0.0, 0.0, distance), (0.0, 0.0, 0.0), fov_deg=30, width=size, height=size)
    angle = torch.linspace(0.1, 3.0, 9, dtype=torch.float64)
    middle = torch.cartesian_prod(*2 * [torch.linspace(-1.6, 1.6, 3, dtype=torch.float64)])
    along = torch.stack([angle.cos(), angle.sin(), 0 * angle], -1) * length / 2
    middle = torch.cat([middle, torch.zeros(9, 1, dtype=torch.float64)], -1)
    steps = torch.linspace(-1, 1, 7, dtype=torch.float64).view(1, -1, 1)
    strands = lines(middle.unsqueeze(1) + steps * along.unsqueeze(1), radius)
    plane = 2 * distance * math.tan(math.radians(15))
    foot = (middle[:, 0] * angle.sin() - middle[:, 1] * angle.cos()).abs()  # of the optical axis on the fibre's line
    expected = float((length * 2 * radius * (distance**2 + foot**2).sqrt() / distance).sum()) / plane**2
    visibility = Visibility(strands, camera)
    assert 2 * radius < plane / size / 66
    everywhere = (range(size), range(size), 64)
    values = [float(coverage_of(visibility.hits(*everywhere, seed), size**2, 64).mean()) for seed in range(12)]
    values = torch.tensor(values, dtype=torch.float64)
    error = float(values.std()) / math.sqrt(12)
    assert error < 0.04 * expected
    assert abs(float(values.mean()) - expected) < 4 * error


def test_the_same_seed_gives_the_same_hits_whatever_the_tiling(monkeypatch: pytest.MonkeyPatch) -> None:
    camera = Camera((0.0, 0.0, 7.0), (0.0, 0.0, 0.0), fov_deg=45, width=20, height=15)
    visibility = Visibility(random_lines(30, 4, 0.05, 7), camera)
    whole = visibility.hits(range(15), range(20), 6, 11)
    assert bool((whole.pixel * 6 + whole.sample).diff().gt(0).all())  # sorted by pixel, then by sample
    tile = visibility.hits(range(4, 11), range(3, 16), 6, 11)
    row, column = whole.pixel // 20, whole.pixel % 20
    inside = whole[(row >= 4) & (row < 11) & (column >= 3) & (column < 16)]
    for name in Hits.__dataclass_fields__:
        if name != "pixel":
            assert torch.equal(getattr(inside, name), getattr(tile, name)), name
    assert torch.equal((inside.pixel // 20 - 4) * 13 + inside.pixel % 20 - 3, tile.pixel)
    monkeypatch.setattr("dsfit.render.visibility._RAYS", 77)  # pieces that end within a pixel
    pieces = visibility.hits(range(15), range(20), 6, 11)
    assert all(torch.equal(getattr(pieces, name), getattr(whole, name)) for name in Hits.__dataclass_fields__)
    assert not torch.equal(visibility.hits(range(15), range(20), 6, 12).offset[:20], whole.offset[:20])


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_any_unit_of_length(unit: float) -> None:
    strands = random_lines(30, 4, 0.02, 8)
    here = Visibility(strands, Camera((0, 0, 7), (0, 0, 0), width=20, height=20)).hits(range(20), range(20), 4, 1)
    scaled = Strands(strands.points * unit, strands.first, strands.radius * unit)
    camera = Camera((0, 0, 7 * unit), (0, 0, 0), width=20, height=20)
    there = Visibility(scaled, camera).hits(range(20), range(20), 4, 1)
    assert abs(len(there) - len(here)) <= 1 and len(here) > 100
    if len(there) == len(here):
        assert torch.allclose(there.offset, here.offset, atol=1e-6)
        assert torch.allclose(there.depth, here.depth * unit, rtol=1e-9)


@pytest.mark.parametrize("target", [(0.0, 0.0, 20.0), (30.0, 0.0, 7.0)])
def test_views_of_nothing(target: tuple[float, float, float]) -> None:
    camera = Camera((0.0, 0.0, 7.0), target, width=8, height=8)  # away from the hair, and past it
    hits = Visibility(random_lines(30, 4, 0.05, 7), camera).hits(range(8), range(8), 4, 0)
    assert len(hits) == 0 and hits.frame.shape == (0, 3, 3) and hits.position.shape == hits.outgoing.shape == (0, 3)
    assert hits.strand.dtype == hits.segment.dtype == hits.pixel.dtype == hits.sample.dtype == torch.int64
    assert context_of(hits).batch_shape == (0,)
    assert coverage_of(hits, 64, 4).tolist() == [0.0] * 64
    assert len(Visibility(random_lines(3, 4, 0.05, 7), camera).hits(range(0), range(8), 4, 0)) == 0


def test_strands_behind_the_camera_stay_unseen() -> None:
    strands = random_lines(30, 4, 0.05, 7)
    both = Strands(
        torch.cat([strands.points, strands.points + torch.tensor([0.0, 0.0, 14.0])]),
        torch.cat([strands.first, strands.first[1:] + len(strands.points)]),
        torch.cat([strands.radius, strands.radius]),
    )
    camera = Camera((0.0, 0.0, 7.0), (0.0, 0.0, 0.0), width=16, height=16)
    hits = Visibility(both, camera).hits(range(16), range(16), 4, 3)
    assert len(hits) > 50 and int(hits.strand.max()) < 30


def test_views_along_the_tangent_are_finite() -> None:
    down = torch.tensor([[0.0, 0.0, 2.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0]], dtype=torch.float64)
    hook = torch.tensor([[0.0, 0.0, 3.0], [0.0, 0.0, 1.0], [0.3, 0.0, 1.0]], dtype=torch.float64)
    twice = torch.tensor([[0.2, 0.2, 0.0], [0.2, 0.2, 0.0], [-0.2, 0.3, 0.0]], dtype=torch.float64)
    back = torch.tensor([[-0.2, -0.2, 0.0], [0.2, -0.2, 0.0], [-0.2, -0.2, 0.0]], dtype=torch.float64)
    nothing = torch.tensor([[0.1, 0.1, 0.0]] * 3, dtype=torch.float64)
    strands = lines(torch.stack([down, hook, twice, back, nothing]), 0.05)
    camera = Camera((0.0, 0.0, 7.0), (0.0, 0.0, 0.0), fov_deg=10, width=32, height=32)
    hits = Visibility(strands, camera).hits(range(32), range(32), 4, 3)
    assert set(hits.strand.tolist()) == {1, 2, 3}
    for name in ("position", "frame", "outgoing", "offset", "radius", "depth"):
        assert bool(torch.isfinite(getattr(hits, name)).all()), name
    assert float((hits.frame @ hits.frame.mT - torch.eye(3)).abs().max()) < 1e-12
    context_of(hits, dtype=torch.float32)
    through = torch.tensor([[[0.0, 0.0, 9.0], [0.0, 0.0, 7.0], [0.2, 0.0, 5.0]]], dtype=torch.float64)
    inside = Visibility(lines(through, 0.05), camera).hits(range(32), range(32), 4, 3)  # the camera on the strand
    assert bool(torch.isfinite(inside.frame).all()) and bool(torch.isfinite(inside.offset).all())


def test_contexts_are_the_viewing_directions_in_the_fibre_frames() -> None:
    camera = Camera((0.0, 0.0, 7.0), (0.0, 0.0, 0.0), fov_deg=40, width=16, height=16)
    hits = Visibility(random_lines(30, 5, 0.05, 9), camera).hits(range(16), range(16), 4, 3)
    context = context_of(hits, torch.linspace(0, 3, len(hits)), 0.25)
    tangent, normal, binormal = hits.frame.unbind(-2)
    sine = (hits.outgoing * tangent).sum(-1)
    assert torch.allclose(torch.sin(context.theta_r), sine, atol=1e-12)
    flat = torch.cos(context.phi_r).unsqueeze(-1) * normal + torch.sin(context.phi_r).unsqueeze(-1) * binormal
    rebuilt = sine.unsqueeze(-1) * tangent + torch.cos(context.theta_r).unsqueeze(-1) * flat
    assert torch.allclose(rebuilt, hits.outgoing, atol=1e-12)
    assert torch.equal(context.hit, torch.arange(len(hits))) and float(context.n[-1]) == 3.0
    assert float(context.v[0]) == 0.25


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_contexts_at_the_poles(dtype: torch.dtype) -> None:
    camera = Camera((0.0, 0.0, 7.0), (0.0, 0.0, 0.0), fov_deg=40, width=8, height=8)
    hits = Visibility(random_lines(30, 5, 0.05, 9), camera).hits(range(8), range(8), 4, 3)
    tilt = torch.logspace(-18, -3, len(hits), dtype=torch.float64).unsqueeze(-1)
    for sign in (1.0, -1.0):
        outgoing = sign * hits.frame[:, 0] + tilt * hits.frame[:, 1]
        along = Hits(*(outgoing if name == "outgoing" else getattr(hits, name) for name in Hits.__dataclass_fields__))
        context = context_of(along, dtype=dtype)
        assert bool((context.theta_r.abs() > 1.5).all()) and context.dtype == dtype
        assert bool(torch.isfinite(context.phi_r).all())


def test_bad_input() -> None:
    camera = Camera((0.0, 0.0, 7.0), (0.0, 0.0, 0.0), width=8, height=8)
    visibility = Visibility(random_lines(3, 4, 0.05, 7), camera)
    for field, given in (
        ("rows", (range(9), range(8), 1, 0)),
        ("rows", (range(-1, 3), range(8), 1, 0)),
        ("columns", (range(8), 8, 1, 0)),
        ("samples", (range(8), range(8), 0, 0)),
        ("samples", (range(8), range(8), 2.0, 0)),
        ("seed", (range(8), range(8), 1, -1)),
        ("seed", (range(8), range(8), 1, 2**64)),
        ("seed", (range(8), range(8), 1, True)),
    ):
        with pytest.raises(InputError, match=f"^{field}: got"):
            visibility.hits(*given)
    for field, pair in (("strands", (torch.zeros(4, 3), camera)), ("camera", (visibility.strands, (0.0, 0.0, 7.0)))):
        with pytest.raises(InputError, match=f"^{field}: got"):
            Visibility(*pair)
    with pytest.raises(InputError, match="context.dtype"):
        context_of(visibility.hits(range(8), range(8), 1, 0), dtype=torch.float16)


def test_without_embree_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "embreex.rtcore_scene", None)
    with pytest.raises(InputError, match="pip install embreex"):
        Visibility(random_lines(3, 4, 0.05, 7), Camera((0.0, 0.0, 7.0), (0.0, 0.0, 0.0)))
