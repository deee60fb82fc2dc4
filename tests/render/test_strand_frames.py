from __future__ import annotations

import math

import pytest
import torch

from dsfit.render import Camera, Strands, Visibility
from dsfit.render.strand_frames import carried_normals, point_tangents, turned

_R, _PITCH = 0.7, 0.3


def helix(points: int, turns: float = 2.0) -> tuple[Strands, torch.Tensor]:
    """A helix (R cos t, R sin t, c t) and its parameter, unevenly spaced."""
    t = torch.linspace(0, 1, points, dtype=torch.float64)
    t = 2 * math.pi * turns * (t + 0.1 * torch.sin(6 * t)) / (1 + 0.1 * math.sin(6))
    place = torch.stack([_R * t.cos(), _R * t.sin(), _PITCH * t], -1)
    return Strands(place, torch.tensor([0, points]), torch.full((points,), 0.01, dtype=torch.float64)), t


def true_tangent(t: torch.Tensor) -> torch.Tensor:
    return torch.stack([-_R * t.sin(), _R * t.cos(), 0 * t + _PITCH], -1) / math.hypot(_R, _PITCH)


def test_tangents_of_a_helix_converge_with_the_square_of_the_spacing() -> None:
    worst = []
    for points in (41, 81, 161):
        strands, t = helix(points)
        worst.append(float((point_tangents(strands) - true_tangent(t)).norm(dim=-1).max()))
    assert worst[0] < 0.06 and worst[0] > 3.4 * worst[1] > 3.4**2 * worst[2]


def test_tangents_of_a_circle_are_exact_whatever_the_spacing() -> None:
    t = torch.tensor([1.0, 3.0] * 20, dtype=torch.float64).cumsum(0) * 0.04
    place = torch.stack([t.cos(), t.sin(), 0 * t], -1)
    strands = Strands(place, torch.tensor([0, 40]), torch.full((40,), 0.01, dtype=torch.float64))
    exact = torch.stack([-t.sin(), t.cos(), 0 * t], -1)
    assert float((point_tangents(strands) - exact).abs().max()) < 1e-13


def test_seen_tangents_are_smooth_along_the_strand() -> None:
    strands, t = helix(161)
    camera = Camera((6.0, 3.0, 1.0), (0.0, 0.0, 1.5), (0.0, 0.0, 1.0), fov_deg=40, width=48, height=48)
    hits = Visibility(strands, camera).hits(range(48), range(48), 64, 1)
    start = strands.starts[hits.segment]
    a, b = strands.points[start], strands.points[start + 1]
    share = (hits.position - a).norm(dim=-1) / (b - a).norm(dim=-1)
    exact = true_tangent(t[start] * (1 - share) + t[start + 1] * share)
    error = (hits.frame[:, 0] - exact).norm(dim=-1)
    chord = (b - a) / (b - a).norm(dim=-1, keepdim=True)
    assert len(hits) > 300
    assert float(error.max()) < 0.004 < 0.03 < float((chord - exact).norm(dim=-1).max())


def test_frames_are_right_handed_and_orthonormal() -> None:
    strands, _ = helix(81)
    camera = Camera((6.0, 3.0, 1.0), (0.0, 0.0, 1.5), (0.0, 0.0, 1.0), fov_deg=40, width=48, height=48)
    frame = Visibility(strands, camera).hits(range(48), range(48), 16, 1).frame
    assert float((frame @ frame.mT - torch.eye(3, dtype=torch.float64)).abs().max()) < 1e-12
    assert float((torch.linalg.det(frame) - 1).abs().max()) < 1e-12


def test_normals_do_not_spin_about_the_strand() -> None:
    # Against the Frenet normal, transported normals turn by minus the torsion: tau = c / (R^2 + c^2) per arc length.
    strands, t = helix(641)
    normal = carried_normals(strands, point_tangents(strands))
    frenet = -torch.stack([t.cos(), t.sin(), 0 * t], -1)
    binormal = torch.linalg.cross(true_tangent(t), frenet)
    angle = torch.atan2((normal * binormal).sum(-1), (normal * frenet).sum(-1))
    speed = math.hypot(_R, _PITCH)
    drift = angle - angle[0] + _PITCH / speed**2 * speed * (t - t[0])
    drift = drift - 2 * math.pi * torch.round(drift / (2 * math.pi))
    assert float(drift.abs().max()) < 2e-3
    assert float(_PITCH / speed * (t[-1] - t[0])) > 4  # radians: the bound above is no accident


def test_normals_of_a_plane_curve_keep_their_angle_to_the_plane() -> None:
    t = torch.linspace(0, 9, 200, dtype=torch.float64)
    place = torch.stack([t, t.sin(), 0 * t], -1)
    strands = Strands(place, torch.tensor([0, 200]), torch.full((200,), 0.01, dtype=torch.float64))
    normal = carried_normals(strands, point_tangents(strands))
    assert float((normal[:, 2] - normal[0, 2]).abs().max()) < 1e-13


def test_strands_do_not_change_each_other() -> None:
    generator = torch.Generator().manual_seed(1)
    sizes = [2, 5, 3, 9, 2]
    points = torch.randn(sum(sizes), 3, generator=generator, dtype=torch.float64)
    first = torch.tensor([0, *torch.tensor(sizes).cumsum(0).tolist()])
    radius = torch.full((sum(sizes),), 0.01, dtype=torch.float64)
    tangent = point_tangents(Strands(points, first, radius))
    normal = carried_normals(Strands(points, first, radius), tangent)
    for low, high in zip(first[:-1].tolist(), first[1:].tolist(), strict=True):
        one = Strands(points[low:high], torch.tensor([0, high - low]), radius[low:high])
        assert torch.equal(point_tangents(one), tangent[low:high])
        assert torch.equal(carried_normals(one, tangent[low:high]), normal[low:high])
    straight = points[1] - points[0]
    assert torch.allclose(tangent[:2], (straight / straight.norm()).expand(2, 3), atol=1e-15)


@pytest.mark.parametrize("repeat", [[0], [3], [7], [0, 1, 2, 3, 4, 5, 6], [2, 3]])
def test_repeated_points_take_the_direction_beside_them(repeat: list[int]) -> None:
    points = torch.tensor([[0.0, float(k), 0.0] for k in range(9)], dtype=torch.float64)
    for index in repeat:  # segment `index` has no length
        points[index + 1 :] -= torch.tensor([0.0, 1.0, 0.0])
    strands = Strands(points, torch.tensor([0, 9]), torch.full((9,), 0.01, dtype=torch.float64))
    assert torch.allclose(point_tangents(strands), torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64).expand(9, 3))


def test_turning_by_any_angle_keeps_normals_unit_and_upright() -> None:
    angle = torch.linspace(0, math.pi, 181, dtype=torch.float64)
    source = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64).expand(181, 3)
    target = torch.stack([angle.cos(), angle.sin(), 0 * angle], -1)
    in_plane = turned(torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64).expand(181, 3), source, target)
    across = turned(torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(181, 3), source, target)
    assert torch.allclose(in_plane[:-1], torch.stack([-angle.sin(), angle.cos(), 0 * angle], -1)[:-1], atol=1e-12)
    assert torch.allclose(across, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(181, 3), atol=1e-12)
    assert float((in_plane * target).sum(-1).abs().max()) < 1e-12
