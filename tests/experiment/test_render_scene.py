"""From `[geometry]`, `[camera]` and `[grid]` to a scene, and what is refused on the way."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, get_args

import pytest
import torch

from dsfit.errors import InputError
from dsfit.experiment.provenance import run_id
from dsfit.experiment.reader import ConfigError
from dsfit.experiment.render_scene import camera_of, rotation, scene_of, strands_of
from dsfit.experiment.schema import Config
from dsfit.experiment.schema_render import Generator
from dsfit.experiment.validation import load
from dsfit.render.geometry import GENERATORS, write_hair

SHIPPED = sorted((Path(__file__).parents[2] / "configs").glob("render_*.toml"))
CONFIG = """
kind = "render"
[bsdf]
azimuthal = "simplified"
precision = "exact"
[geometry]
kind = "block"
options = { strands = 50, points = 6 }
[camera]
width = 12
height = 8
[grid]
resolution = 5
[render]
dtype = "float64"
technique = { kind = "uniform" }
"""


def made(**changes: Any) -> Config:
    geometry = {"kind": "block", "options": {"strands": 40, "points": 5}, **changes.pop("geometry", {})}
    return Config.model_validate({"kind": "render", "geometry": geometry, **changes})


def written(folder: Path, text: str = "") -> Path:
    path = folder / "scene.toml"
    path.write_text(CONFIG + text)
    return path


def test_a_config_may_name_every_generator_and_no_other() -> None:
    assert set(get_args(Generator)) == set(GENERATORS)


def test_transformations_are_applied_in_their_order() -> None:
    plain = strands_of(made().geometry)
    steps = [
        {"kind": "translate", "by": [1.0, 0.0, 0.0]},
        {"kind": "rotate", "axis": [0.0, 0.0, 2.0], "angle_deg": 90.0},
        {"kind": "scale", "factor": 3.0},
    ]
    moved = strands_of(made(geometry={"transforms": steps, "radius_factor": 2.0}).geometry)
    x, y, z = plain.points.unbind(-1)
    torch.testing.assert_close(moved.points, 3 * torch.stack([-y, x + 1, z], -1))
    torch.testing.assert_close(moved.radius, 6 * plain.radius)
    thin = strands_of(made(geometry={"transforms": [{"kind": "thin", "every": 4}]}).geometry)
    assert len(thin) == 10
    fitted = strands_of(made(geometry={"transforms": [{"kind": "fit_into", "size": 2.0}]}).geometry)
    assert float((fitted.bounds[1] - fitted.bounds[0]).max()) == pytest.approx(2.0)
    turned = strands_of(made(geometry={"transforms": [{"kind": "turn_up", "up": "z"}]}).geometry)
    torch.testing.assert_close(turned.points[:, 1], plain.points[:, 2])


def test_rotations_are_right_handed() -> None:
    turn = rotation([0.0, 3.0, 0.0], math.pi / 2)
    torch.testing.assert_close(turn @ torch.tensor([0.0, 0.0, 1.0]).double(), torch.tensor([1.0, 0.0, 0.0]).double())
    with pytest.raises(InputError, match="axis"):
        rotation([0.0, 0.0, 0.0], 1.0)


@pytest.mark.parametrize(("kind", "width"), [("block", 30), ("ball", 30), ("ball", 15)])
def test_the_camera_that_is_left_out_sees_everything(kind: str, width: int) -> None:
    """In pictures that are higher than wide too, where the horizontal angle of view is the smaller one."""
    options = {"strands": 60, "points": 6}
    config = made(geometry={"kind": kind, "options": options}, camera={"width": width, "height": 30})
    strands = strands_of(config.geometry)
    camera = camera_of(config, strands)
    seen = (strands.points.double() - camera.position) @ camera.axes.T
    slope = math.tan(math.radians(camera.fov_deg) / 2)
    place = seen[:, :2].abs() / seen[:, 2:] / torch.tensor([width / 30, 1.0], dtype=torch.float64)
    assert 0.85 * slope < float(place.max()) < slope
    near = camera_of(config.model_copy(update={"camera": config.camera.model_copy(update={"margin": 0.5})}), strands)
    assert float(near.position.norm()) < 0.7 * float(camera.position.norm())


def test_a_camera_that_is_given_stands_where_it_is_told() -> None:
    config = made(camera={"position": [0.0, 0.0, 20.0], "fov_deg": 40.0, "width": 4, "height": 2})
    camera = camera_of(config, strands_of(config.geometry))
    assert camera.position.tolist() == [0.0, 0.0, 20.0]
    assert (camera.fov_deg, camera.width, camera.height) == (40.0, 4, 2)
    low, high = strands_of(config.geometry).bounds
    towards = (low + high) / 2 - camera.position
    torch.testing.assert_close(camera.axes[2], towards / towards.norm())


def test_scenes_are_made_once_and_anew_where_they_differ(tmp_path: Path) -> None:
    config = load(written(tmp_path)).config
    scene = scene_of(config)
    assert scene_of(load(written(tmp_path)).config) is scene
    assert scene_of(load(written(tmp_path), ["render.samples=7"]).config) is scene
    wider = scene_of(load(written(tmp_path), ["camera.width=13"]).config)
    assert wider is not scene and wider.camera.width == 13
    assert scene_of(load(written(tmp_path), ["render.v=threshold"]).config).v == "threshold"
    assert scene.subsamples == config.render.subsamples and scene.dtype == torch.float64


def test_files_are_found_beside_the_config_and_read_again_when_they_change(tmp_path: Path) -> None:
    few, more = (strands_of(made(geometry={"options": {"strands": n, "points": 5}}).geometry) for n in (7, 9))
    (tmp_path / "data").mkdir()
    write_hair(few, tmp_path / "data" / "lock.hair")
    path = tmp_path / "scene.toml"
    text = CONFIG.replace('kind = "block"', 'kind = "hair"\npath = "data/lock.hair"')
    path.write_text(text.replace("options = { strands = 50, points = 6 }\n", ""))
    config = load(path).config
    assert config.geometry.path == str(tmp_path / "data" / "lock.hair")
    first = run_id(config)
    assert len(strands_of(config.geometry)) == 7
    write_hair(more, tmp_path / "data" / "lock.hair")
    assert len(strands_of(config.geometry)) == 9
    assert run_id(config) != first


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ("geometry.options.strandz=5", "geometry.options.strandz"),
        ("geometry.options.strands=0", "geometry.options.strands"),
        ('geometry.kind="blok"', "geometry.kind"),
        ('geometry={kind="hair", path="none.hair"}', "geometry.path"),
        ('geometry={kind="double_block", options={curl=2}}', "geometry.options"),
        ('geometry.transforms=[{kind="rotate", axis=[0,0,0], angle_deg=3.0}]', "geometry.transforms"),
        ("camera.up=[0.0, 0.0, 0.0]", "camera.up"),
        ("camera.fov_deg=180", "camera.fov_deg"),
        ("grid.resolution=0", "grid.resolution"),
        ("render.passes=1", "render.passes"),
        ("render.technique.light=1.0", "render.technique.light"),
        ('render.technique.kind="uniforn"', "did you mean 'uniform'"),
        ('render.technique={kind="single", options={proposal="M_R", curl=1}}', "render.technique.options.curl"),
        ('render.technique={kind="deon_offset", options={glint_share=2.0}}', "render.technique.options.glint_share"),
    ],
)
def test_errors_name_the_key(tmp_path: Path, change: str, named: str) -> None:
    with pytest.raises(ConfigError) as found:
        load(written(tmp_path), [change])
    assert named in str(found.value)


@pytest.mark.slow
@pytest.mark.parametrize("path", SHIPPED, ids=lambda p: p.stem)
def test_shipped_scenes_load(path: Path) -> None:
    if path.stem != "render_base":
        assert load(path).config.kind in ("render", "compare_render")
