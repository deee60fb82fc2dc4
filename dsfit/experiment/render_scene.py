"""From a config to the scene of a rendering: strands, camera, visibility, grid, light, BSDF; each made once per
process."""

from __future__ import annotations

import dataclasses
import functools
import inspect
import math
import os
from functools import partial
from typing import TYPE_CHECKING, Any

import torch

from dsfit.errors import InputError
from dsfit.experiment import build
from dsfit.experiment.schema import Config
from dsfit.experiment.schema_render import GeometryConfig, Technique

if TYPE_CHECKING:
    from dsfit.experiment.reader import RawConfig
    from dsfit.render import Strands
    from dsfit.render.camera import Camera
    from dsfit.render.scene import RenderScene

_DEG = math.pi / 180


def strands_of(geometry: GeometryConfig) -> Strands:
    """The strands that `[geometry]` describes; the last few geometries are kept, files until they change.

    Raises:
        InputError: an unknown option, an option out of range, a damaged file.
    """
    path = getattr(geometry, "path", None)
    status = os.stat(path) if path and os.path.exists(path) else None
    return _strands(geometry.model_dump_json(), _Kept(geometry), status and (status.st_mtime_ns, status.st_size))


class _Kept:
    """Carries an argument past a cache whose key is made of the others."""

    def __init__(self, value: Any) -> None:
        self.value = value

    def __hash__(self) -> int:
        return 0

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Kept)


@functools.lru_cache(maxsize=2)
def _strands(_key: str, kept: _Kept, _status: Any) -> Strands:
    from dsfit.render import Strands, geometry

    config: GeometryConfig = kept.value
    if config.kind == "hair":
        made = geometry.read_hair(config.path)
    elif config.kind == "pbrt":
        made = geometry.read_pbrt_curves(config.path)
    else:
        try:
            made = geometry.GENERATORS[config.kind](**checked_options(config.kind, config.options))
        except TypeError as error:  # an option that a generator passes on, or a value of another type
            raise InputError("geometry.options", config.options, f"options of {config.kind} ({error})") from None
    for change in config.transforms:
        made = _changed(made, change)
    return Strands(made.points, made.first, made.radius * config.radius_factor)


def _changed(strands: Strands, change: Any) -> Strands:
    from dsfit.render.geometry import transform

    if change.kind == "rotate":
        turn = rotation(change.axis, change.angle_deg * _DEG).to(strands.points)
        return dataclasses.replace(strands, points=strands.points @ turn.mT)
    work, argument = {
        "scale": (transform.scaled, "factor"),
        "translate": (transform.translated, "by"),
        "turn_up": (transform.turned_up, "up"),
        "fit_into": (transform.fitted_into, "size"),
        "thin": (partial(transform.subsampled, keep=getattr(change, "keep", "counts")), "every"),
    }[change.kind]
    return work(strands, getattr(change, argument))


def checked_options(kind: str, options: dict[str, Any]) -> dict[str, Any]:
    """The options, if the generator of this name takes them.

    Raises:
        InputError: an option that it does not have.
    """
    from dsfit.render import geometry

    known = inspect.signature(geometry.GENERATORS[kind]).parameters
    passed_on = any(p.kind is p.VAR_KEYWORD for p in known.values())
    for name, value in options.items():
        if name not in known and not passed_on:
            raise InputError(f"geometry.options.{name}", value, f"an option of {kind}: " + ", ".join(known))
    return options


def rotation(axis: list[float], angle: float) -> torch.Tensor:
    """The matrix `[3, 3]` that turns by `angle` (radians, right-handed) about `axis` (Rodrigues).

    Raises:
        InputError: an axis of length 0.
    """
    direction = torch.tensor(axis, dtype=torch.float64)
    if not float(direction.norm()) > 0:
        raise InputError("axis", axis, "a vector of length > 0")
    x, y, z = (direction / direction.norm()).tolist()
    cross = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    return torch.eye(3, dtype=torch.float64) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross


def camera_of(config: Config, strands: Strands) -> Camera:
    """The camera; without a position it sees the whole geometry."""
    from dsfit.render.camera import Camera
    from dsfit.render.geometry import VIEWS, suggested_view

    c = config.camera
    position: Any = c.position
    target: Any = c.target
    if position is None:
        away = c.direction or VIEWS.get(config.geometry.kind, (0.35, 0.25, 1.0))
        seen, middle, _, _ = suggested_view(strands, away, c.fov_deg, aspect=min(1.0, c.width / c.height))
        target = middle if target is None else torch.tensor(target, dtype=torch.float64)
        position = target + (seen - middle) * c.margin
    elif target is None:
        target = (strands.bounds[0] + strands.bounds[1]) / 2
    return Camera(position, target, c.up, fov_deg=c.fov_deg, width=c.width, height=c.height)


def scene_of(config: Config) -> RenderScene:
    """The scene; the last two are kept, so that all tiles and techniques of a process share one."""
    return _scene(key_of(config), _Kept(config))


def key_of(config: Config) -> tuple[Any, ...]:
    """Equal for configs of equal scenes, as long as the files that they name do not change."""
    parts = {"geometry", "camera", "grid", "fiber", "bsdf", "light"}
    asked = {"subsamples", "v", "background", "dtype", "seed"}
    stamps = tuple(os.stat(path).st_mtime_ns for path in _files(config) if os.path.exists(path))
    return config.model_dump_json(include=parts), config.render.model_dump_json(include=asked), stamps


def _files(config: Config) -> list[str]:
    lights = [config.light, *getattr(config.light, "lights", [])]
    return [thing.path for thing in (config.geometry, *lights) if getattr(thing, "path", None)]


@functools.lru_cache(maxsize=2)
def _scene(_key: tuple[Any, ...], kept: _Kept) -> RenderScene:
    from dsfit.render.scene import RenderScene

    config: Config = kept.value
    strands = strands_of(config.geometry)
    return RenderScene.of(
        strands,
        camera_of(config, strands),
        bsdf=build.bsdf(config),
        light=build.light(config),
        grid=config.grid.resolution,
        step=config.grid.step,
        max_n=config.grid.max_n,
        v=config.render.v,
        background=config.render.background,
        subsamples=config.render.subsamples,
        seed=config.render.seed,
        dtype=getattr(torch, config.render.dtype),
    )


def check(raw: RawConfig, config: Config) -> None:
    """Refuse geometry and camera that cannot be made.

    Raises:
        ConfigError: naming the key.
    """
    from dsfit.experiment.validation import library_error

    try:
        strands = strands_of(config.geometry)
    except InputError as error:
        name = error.field.rpartition(".")[2]
        for key in (("geometry", "options", name), ("geometry", "path"), ("geometry", "transforms"), ("geometry",)):
            if raw.lookup(key) is not None:
                raise raw.error(key, f"{error.allowed} ({error.field})", error.value) from None
        raise library_error(raw, "geometry", error) from None
    try:
        camera_of(config, strands)
    except InputError as error:
        raise library_error(raw, "camera", error) from None
    check_technique(raw, ("render", "technique"), config.render.technique)
    if config.kind == "compare_render":
        from dsfit.experiment.compare_render import check as check_comparison

        check_comparison(raw, config)


def check_technique(raw: RawConfig, key: tuple[str | int, ...], technique: Technique) -> None:
    """Refuse a technique that cannot be made.

    Raises:
        ConfigError: naming the key.
    """
    from dsfit.experiment.reader import did_you_mean
    from dsfit.render.techniques import TECHNIQUES
    from dsfit.render.techniques import technique as make

    if technique.kind not in TECHNIQUES:
        known = "one of " + ", ".join(TECHNIQUES) + did_you_mean(technique.kind, TECHNIQUES)
        raise raw.error((*key, "kind"), known, technique.kind)
    try:
        light = 0.5 if technique.light == "best" else technique.light  # type: ignore[comparison-overlap]
        make(technique.kind, technique.options, light=light, uniforms=technique.uniforms)
    except InputError as error:
        name = error.field.rpartition(".")[2]
        where = ("options", name) if name in technique.options else ("light",) if name == "light" else ("options",)
        raise raw.error((*key, *where), f"{error.allowed} ({error.field})", error.value) from None
