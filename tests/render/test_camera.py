from __future__ import annotations

import math

import pytest
import torch

from dsfit.errors import InputError
from dsfit.render import Camera
from dsfit.render.pixel_samples import pixel_samples


def _centre(camera: Camera, row: int, column: int) -> torch.Tensor:
    return camera.rays(torch.tensor(row * camera.width + column), torch.full((2,), 0.5, dtype=torch.float64))[1]


def test_middle_ray_meets_the_target_and_edges_span_the_field_of_view() -> None:
    camera = Camera((1.0, 2.0, 3.0), (0.0, 2.5, -1.0), (0.1, 1.0, 0.2), fov_deg=40.0, width=7, height=5)
    towards = torch.tensor([-1.0, 0.5, -4.0], dtype=torch.float64)
    assert torch.allclose(_centre(camera, 2, 3), towards / towards.norm(), atol=1e-14)
    u = torch.tensor([[0.5, 0.0], [0.5, 1.0]], dtype=torch.float64)
    origin, (top, bottom) = camera.rays(torch.tensor([3, 4 * 7 + 3]), u)
    assert math.degrees(math.acos(float(top @ bottom))) == pytest.approx(40.0, abs=1e-10)
    assert origin.tolist() == [[1.0, 2.0, 3.0]] * 2
    assert torch.allclose(camera.axes @ camera.axes.T, torch.eye(3, dtype=torch.float64), atol=1e-14)


def test_rows_go_down_and_columns_right() -> None:
    camera = Camera((0, 0, 5), (0, 0, 0), fov_deg=60, width=9, height=9)  # looks along -z: x is to the right
    assert float(_centre(camera, 0, 4)[1]) > 0 > float(_centre(camera, 8, 4)[1])
    assert float(_centre(camera, 4, 0)[0]) < 0 < float(_centre(camera, 4, 8)[0])


def test_pixels_are_square_and_their_solid_angles_add_up_to_the_image() -> None:
    camera = Camera((0, 0, 5), (0, 0, 0), fov_deg=70, width=64, height=48)
    y = math.tan(math.radians(35))
    x = y * 64 / 48
    whole = 4 * math.asin(x * y / math.sqrt((1 + x * x) * (1 + y * y)))
    assert float(camera.solid_angle(torch.arange(64 * 48)).sum()) == pytest.approx(whole, rel=2e-4)


def test_places_within_a_pixel_cover_it() -> None:
    camera = Camera((0, 0, 5), (0, 0, 0), fov_deg=60, width=4, height=4)
    pixel = torch.tensor([5, 6, 9, 10])
    corner = torch.tensor([[1.0, 1.0], [0.0, 1.0], [1.0, 0.0], [0.0, 0.0]], dtype=torch.float64)
    direction = camera.rays(pixel, corner)[1]  # the corner that the four pixels share
    assert torch.allclose(direction, torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64), atol=1e-14)


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"fov_deg": 0.0}, "fov_deg"),
        ({"fov_deg": 180.0}, "fov_deg"),
        ({"fov_deg": math.nan}, "fov_deg"),
        ({"target": (0.0, 0.0, 5.0)}, "target"),
        ({"up": (0.0, 0.0, -2.0)}, "up"),
        ({"up": (0.0, 0.0, 0.0)}, "up"),
        ({"position": (0.0, math.nan, 0.0)}, "position"),
        ({"position": (0.0, 0.0)}, "position"),
        ({"target": "up"}, "target"),
        ({"width": 0}, "width"),
        ({"height": 2.5}, "height"),
        ({"height": True}, "height"),
    ],
)
def test_bad_cameras(change: dict, field: str) -> None:
    given = {"position": (0.0, 0.0, 5.0), "target": (0.0, 0.0, 0.0), "up": (0.0, 1.0, 0.0)} | change
    with pytest.raises(InputError, match=f"camera.{field}: got"):
        Camera(**given)


def test_bad_rays() -> None:
    camera = Camera((0, 0, 5), (0, 0, 0), width=4, height=4)
    place = torch.full((1, 2), 0.5, dtype=torch.float64)
    for pixels, u in (
        (torch.tensor([16]), place),
        (torch.tensor([-1]), place),
        (torch.tensor([1.0]), place),
        (torch.tensor([1, 2]), place),
        (torch.tensor([1]), place + 1),
        (torch.tensor([1]), place * math.nan),
    ):
        with pytest.raises(InputError):
            camera.rays(pixels, u)


def test_places_are_nets_in_base_2() -> None:
    rows = torch.arange(40)
    points = pixel_samples(rows, 3 * rows, 64, seed=5)
    for start, size in ((0, 64), (16, 16), (56, 8)):
        bits = size.bit_length() - 1
        for split in range(bits + 1):
            cells = (points[:, start : start + size] * torch.tensor([2.0**split, 2.0 ** (bits - split)])).long()
            number = cells[..., 0] * 2 ** (bits - split) + cells[..., 1]
            assert torch.equal(number.sort(-1).values, torch.arange(size).expand(40, -1))


def test_places_of_a_pixel_depend_on_it_and_the_seed_alone() -> None:
    rows, columns = torch.arange(1000) // 40, torch.arange(1000) % 40
    points = pixel_samples(rows, columns, 8, seed=2**40 + 3)
    some = torch.randperm(1000, generator=torch.Generator().manual_seed(1))[:50]
    assert torch.equal(pixel_samples(rows[some], columns[some], 8, seed=2**40 + 3), points[some])
    assert torch.equal(pixel_samples(rows[some], columns[some], 3, seed=2**40 + 3), points[some, :3])
    for other in (3, 2**41 + 3, 2**40 + 4):  # both halves of the seed count
        assert not bool((pixel_samples(rows, columns, 8, seed=other) == points).any())
    assert len(points.flatten(0, 1).unique(dim=0)) == 8000


def test_each_place_is_uniform_and_pixels_are_independent() -> None:
    rows, columns = torch.arange(40000) // 200, torch.arange(40000) % 200
    points = pixel_samples(rows, columns, 4, seed=1)
    for sample in range(4):
        cells = (points[:, sample] * 16).long()
        counts = torch.bincount(cells[:, 0] * 16 + cells[:, 1], minlength=256).to(torch.float64)
        chi2 = float(((counts - 156.25) ** 2 / 156.25).sum())
        assert abs(chi2 - 255) < 5 * math.sqrt(2 * 255)
    first = (points[:, 0] - 0.5).view(200, 200, 2)
    for neighbour in (first[1:] * first[:-1], first[:, 1:] * first[:, :-1], first * first.flip(-1)):
        assert abs(float(neighbour.mean()) * 12) < 5 / math.sqrt(neighbour.numel() / 2)
