"""`[light]` tables of emitters and sums: what they build, what they refuse, where their files are."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import torch

from dsfit.experiment import build
from dsfit.experiment.reader import ConfigError
from dsfit.experiment.validation import load
from dsfit.scene import RectangleLight, RingLight, SphereLight, SunLight, TotalLight, write_exr

METHODS = "[[methods]]\nname = 'light'\nkind = 'light'\n"
SUN = "kind = 'sun'\ndirection = [0.0, 2.0, 0.0]\n"
SPHERE = "kind = 'sphere'\ncenter = [0.0, 1.0, 2.0]\nradius = 0.5\nradiance = [1, 2, 3]\n"


def light(tmp_path: Path, text: str) -> Any:
    (tmp_path / "a.toml").write_text(f"[light]\n{text}\n{METHODS}")
    return build.light(load(tmp_path / "a.toml").config)


def test_every_kind(tmp_path: Path) -> None:
    sun = light(tmp_path, SUN + "angular_radius_deg = 2.0\nirradiance = [3.0, 2.0, 1.0]")
    assert isinstance(sun, SunLight) and sun.angular_radius == pytest.approx(math.radians(2))
    assert sun.direction.tolist() == [0.0, 1.0, 0.0]
    wanted = [x / (math.pi * math.sin(math.radians(2)) ** 2) for x in (3, 2, 1)]
    assert sun.radiance.tolist() == pytest.approx(wanted, rel=1e-12)
    assert light(tmp_path, SUN + "radiance = 7.0").radiance.tolist() == [7.0]
    sphere = light(tmp_path, SPHERE)
    assert isinstance(sphere, SphereLight) and sphere.center.tolist() == [0, 1, 2] and float(sphere.radius) == 0.5
    text = "kind = 'rectangle'\ncorner = [1.0, 0.0, 0.0]\nedge_u = [0.0, 2.0, 0.0]\nedge_v = [0.0, 0.0, 3.0]"
    sheet = light(tmp_path, text)
    assert isinstance(sheet, RectangleLight) and sheet.sides.tolist() == [2, 3] and not sheet.two_sided
    text = "kind = 'ring'\ncenter = [1.0, 0.0, 0.0]\nnormal = [-4.0, 0.0, 0.0]\ninner = 0.5\nouter = 1.0\n"
    ring = light(tmp_path, text + "two_sided = true")
    assert isinstance(ring, RingLight) and ring.normal.tolist() == [-1, 0, 0] and ring.two_sided


def test_a_total_and_its_shares(tmp_path: Path) -> None:
    write_exr(tmp_path / "sky.exr", {"RGB": torch.ones(4, 8, 3)})
    part = "[[light.lights]]\n"
    sky = part + "kind = 'environment'\npath = 'sky.exr'\n"
    text = "kind = 'total'\n" + part + SUN + "irradiance = 1.0\n" + part + SPHERE + sky
    found = light(tmp_path, text)
    assert isinstance(found, TotalLight) and found.shares is None and found.channels == 3
    assert [type(x).__name__ for x in found.lights] == ["SunLight", "SphereLight", "EnvironmentLight"]
    shared = text.replace(SPHERE, SPHERE + "share = 1.0\n").replace("1.0\n[[", "1.0\nshare = 3\n[[", 1) + "share = 0\n"
    with pytest.raises(ConfigError, match="shares"):  # nothing else is sampled where the sky shines
        light(tmp_path, shared)
    found = light(tmp_path, shared[: -len("share = 0\n")] + "share = 4\n")
    assert found.shares.tolist() == pytest.approx([3 / 8, 1 / 8, 4 / 8])


def test_a_map_in_a_total_that_changes_is_read_again(tmp_path: Path) -> None:
    text = "kind = 'total'\n[[light.lights]]\nkind = 'environment'\npath = 'sky.exr'\n"
    omega, found = torch.zeros(2, dtype=torch.float64), []
    for value, size in ((1.0, 8), (2.0, 16)):
        write_exr(tmp_path / "sky.exr", {"RGB": torch.full((4, size, 3), value)})
        (tmp_path / "a.toml").write_text(f"[light]\n{text}\n{METHODS}")
        found.append(float(build.integrand(load(tmp_path / "a.toml").config).light(omega)[0]))
    assert found == [1.0, 2.0]


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        (SUN, ["a.toml: light", "either irradiance or radiance"]),
        (SUN + "irradiance = 1.0\nradiance = 1.0", ["light.irradiance: got 1.0", "either irradiance or radiance"]),
        (SUN + "irradiance = 1.0\nangular_radius_deg = 91", ["light.angular_radius_deg: got 91", "<= 90"]),
        (SUN + "irradiance = 1.0\nshare = 0.5", ["light.share: got 0.5", "one of the keys"]),
        (SUN.replace("2.0", "0.0") + "irradiance = 1.0", ["light.direction: got [0.0, 0.0, 0.0]", "length > 0"]),
        (SPHERE.replace("0.5", "0.0"), ["light.radius: got 0.0", ">= 1e-12"]),
        (SPHERE.replace("[1, 2, 3]", "[1, 2, -3]"), ["light.radiance: got [1, 2, -3]"]),
        (
            "kind = 'rectangle'\ncorner = [1, 0, 0]\nedge_u = [0, 2, 0]\nedge_v = [0, 1, 3]",
            ["light.edge_v: got [0, 1, 3]", "right angles"],
        ),
        (
            "kind = 'ring'\ncenter = [1, 0, 0]\nnormal = [1, 0, 0]\ninner = 2.0\nouter = 1.0",
            ["light.inner: got 2.0", "[0, 1)"],
        ),
        ("kind = 'total'\nlights = []", ["light.lights: got []", "at least one element"]),
        ("kind = 'total'\n[[light.lights]]\nkind = 'total'", ["light.lights.0.kind: got 'total'", "'sun'", "'ring'"]),
        (
            f"kind = 'total'\n[[light.lights]]\n{SPHERE}[[light.lights]]\n{SUN.replace('2.0', '0.0')}radiance = 1.0",
            ["light.lights.1.direction: got [0.0, 0.0, 0.0]", "length > 0"],
        ),
        (
            f"kind = 'total'\n[[light.lights]]\n{SPHERE}share = 1.0\n[[light.lights]]\nkind = 'constant'",
            ["light.lights.1", "a share for every light, or for none"],
        ),
        (
            "kind = 'total'\n[[light.lights]]\nkind = 'environment'\npath = 'gone.exr'",
            ["light.lights.0", "gone.exr", "a complete single-part OpenEXR image"],
        ),
    ],
)
def test_what_is_refused(tmp_path: Path, text: str, parts: list[str]) -> None:
    with pytest.raises(ConfigError) as caught:
        light(tmp_path, text)
    assert all(part in str(caught.value) for part in parts), str(caught.value)
