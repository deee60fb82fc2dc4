"""The environment map of the studio scenes is what its script makes, and its lamps are where they are said to be."""

from __future__ import annotations

import importlib.util
import math
from pathlib import Path
from typing import Any

import pytest
import torch

from dsfit.frame import to_angles
from dsfit.scene import EnvironmentLight
from dsfit.scene.exr import read_exr

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def script() -> Any:
    spec = importlib.util.spec_from_file_location("studio_map", ROOT / "experiments" / "studio_map.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_shipped_map_is_the_scripts(script: Any) -> None:
    stored = read_exr(ROOT / "configs" / "data" / "studio.exr").pixels
    torch.testing.assert_close(stored, script.studio().to(torch.float32), rtol=1e-5, atol=1e-6)


def test_the_lamps_are_where_the_light_sees_them(script: Any) -> None:
    light = EnvironmentLight.from_file(str(ROOT / "configs" / "data" / "studio.exr"))
    for azimuth, elevation, *_, radiance in script.LAMPS.values():
        a, e = math.radians(azimuth), math.radians(elevation)
        towards = torch.tensor([math.cos(e) * math.sin(a), math.sin(e), math.cos(e) * math.cos(a)]).double()
        seen = light(to_angles(towards))
        room = script.room(towards)
        torch.testing.assert_close(seen, torch.tensor(radiance).double() + room, rtol=1e-3, atol=1e-3)
        assert float(light(to_angles(-towards)).max()) < 0.2
