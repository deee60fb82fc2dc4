"""Turns what a TOML file said into a `Config`, or into one error that names file, key, value and what is allowed."""

from __future__ import annotations

import math
import re
import types
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from dsfit.errors import InputError
from dsfit.experiment.design import all_values, at_point, design_of
from dsfit.experiment.reader import ConfigError, RawConfig, did_you_mean, dotted, read
from dsfit.experiment.rundir import slug
from dsfit.experiment.schema import Config

MAX_CELLS = 100_000


@dataclass(frozen=True)
class GridPoint:
    """One point of the design of `[sweep]`, with the config that results; `values` is empty without a sweep."""

    values: dict[str, Any]
    config: Config


@dataclass(frozen=True)
class Experiment:
    """A validated config and its grid points.

    Attributes:
        name: stem of the config file.
        raw: the merged tables, for error messages.
        config: the validated config without any grid value applied.
        points: one entry per combination of grid values, at least one.
    """

    name: str
    raw: RawConfig
    config: Config
    points: list[GridPoint]


def load(path: str | Path, overrides: Sequence[str] = ()) -> Experiment:
    """Read and validate a config file.

    Raises:
        ConfigError: the first thing that is wrong; further ones are listed below it in the message.
    """
    raw, config = load_base(path, overrides)
    return Experiment(raw.name, raw, config, expand(raw, config))


def load_base(path: str | Path, overrides: Sequence[str] = ()) -> tuple[RawConfig, Config]:
    """The tables and the config of a file, as `load` reads them, without the points of its sweep."""
    raw = read(path, overrides)
    _anchor_paths(raw)
    return raw, validate(raw)


def _anchor_paths(raw: RawConfig) -> None:
    """Paths are relative to the file that names them, or to the working directory when given by `--set`."""

    def anchored(key: tuple[str | int, ...], path: Any) -> Any:
        if not isinstance(path, str) or not path or "\0" in path:
            return path  # refused later
        source = Path(raw.source(key))
        return str(((source.parent if source.is_file() else Path()) / path).resolve())

    lights = raw.lookup(("light", "lights"))
    parts = [("light", "lights", k) for k in range(len(lights))] if isinstance(lights, list) else []
    for where in (("light",), ("geometry",), *parts):
        table = raw.lookup(where)
        if isinstance(table, dict) and "path" in table:
            table["path"] = anchored((*where, "path"), table["path"])
    methods = raw.lookup(("methods",))
    for k, method in enumerate(methods if isinstance(methods, list) else []):
        if isinstance(method, dict) and "file" in method:
            method["file"] = anchored(("methods", k, "file"), method["file"])
    for key in ("saved", "user"):
        paths = raw.lookup(("check", key))
        if isinstance(paths, list):
            paths[:] = [anchored(("check", key), path) for path in paths]


def validate(raw: RawConfig) -> Config:
    """The `Config` for merged tables; see `load`."""
    try:
        config = Config.model_validate(raw.data)
    except ValidationError as error:
        found = [_explain(raw, detail) for detail in error.errors(include_url=False)]
        unique = list(dict.fromkeys(str(problem) for problem in found))
        first = found[0]
        if len(unique) > 1:
            first.args = ("\n".join(unique),)
        raise first from None
    _cross_check(raw, config)
    return config


def expand(raw: RawConfig, config: Config) -> list[GridPoint]:
    """All points of the design, each validated on its own."""
    design = design_of(raw, config.sweep)
    if len(design) > MAX_CELLS:
        raise raw.error(("sweep", "grid"), f"at most {MAX_CELLS} combinations (these are {len(design)})")
    return [
        GridPoint(values, validate(at_point(raw, design.sources, values)) if values else config)
        for values in all_values(design)
    ]


def _cross_check(raw: RawConfig, config: Config) -> None:
    if config.kind in ("compare", "sweep") and not config.methods:
        raise raw.error(("methods",), "at least one [[methods]] table", [])
    if config.kind == "sweep" and not (config.sweep.grid or config.sweep.space):
        raise raw.error(("sweep", "grid"), "at least one dotted key with a list of values, as kind is 'sweep'", {})
    seen: set[str] = set()
    for index, method in enumerate(config.methods):
        if slug(method.name) in seen:
            raise raw.error(("methods", index, "name"), "names that differ in their letters and digits")
        seen.add(slug(method.name))
    if math.prod(len(x) for x in _context_lists(config)) > MAX_CELLS:
        raise raw.error(("contexts",), f"at most {MAX_CELLS} combinations")
    lengths = {len(x) for x in _context_lists(config) if len(x) != 1}
    if config.contexts.combine == "zip" and len(lengths) > 1:
        raise raw.error(
            ("contexts", "combine"), "lists of equal length (or of one element) when combined by 'zip'", sorted(lengths)
        )
    from dsfit.experiment import build  # needs torch: not before the tables themselves are right

    build.check(raw, config)


def _context_lists(config: Config) -> list[list[float]]:
    contexts = config.contexts
    return [contexts.theta_r_deg, contexts.phi_r_deg, contexts.n, *([contexts.v] if contexts.v is not None else [])]


def library_error(raw: RawConfig, section: str, error: InputError) -> ConfigError:
    """An `InputError` of the library as a config error of the key that caused it."""
    if isinstance(error, ConfigError):
        return error
    leaf = error.field.split(".")[-1].split("[")[0]
    within = re.match(r"light\.lights\.(\d+)\.", error.field)  # a part of a total light
    if within:
        place = ("light", "lights", int(within[1]))
        found = [(*place, key) for key in (leaf, f"{leaf}_deg") if raw.lookup((*place, key)) is not None]
        return raw.error(found[0] if found else place, f"{error.allowed} ({error.field})")
    for candidate in ((section, leaf), (section, f"{leaf}_deg"), (section,)):
        if raw.lookup(candidate) is not None:
            return raw.error(candidate, f"{error.allowed} ({error.field})")
    return ConfigError(raw.path, f"{section}.{leaf}", error.value, error.allowed)


# ---- pydantic's errors in words ----


def _explain(raw: RawConfig, detail: Any) -> ConfigError:
    key, annotation, model = _locate(detail["loc"])
    if detail["type"] == "extra_forbidden":
        known = list(model.model_fields) if model else []
        name = str(key[-1])
        return raw.error(key, "one of the keys " + ", ".join(known) + did_you_mean(name, known), detail["input"])
    if detail["type"] == "missing":
        return ConfigError(raw.source(key), dotted(key), None, f"{describe(annotation)} (this key is required)")
    if detail["type"] in ("union_tag_invalid", "union_tag_not_found"):
        tags = list(_tags(annotation))
        given = detail["input"].get("kind") if isinstance(detail["input"], dict) else detail["input"]
        return ConfigError(
            raw.source((*key, "kind")),
            dotted((*key, "kind")),
            given,
            "one of " + ", ".join(map(repr, tags)) + did_you_mean(given, tags),
        )
    value = raw.lookup(key)
    allowed = describe(annotation)
    if isinstance(value, str) and (choices := _choices(annotation)):
        allowed += did_you_mean(value, choices)
    return ConfigError(raw.source(key), dotted(key), detail["input"] if value is None else value, allowed)


def _locate(loc: tuple[str | int, ...]) -> tuple[tuple[str | int, ...], Any, type[BaseModel] | None]:
    """Key in the tables, its annotation, and the innermost model, from a pydantic location (which also names union
    members)."""
    key: list[str | int] = []
    annotation: Any = Config
    model: type[BaseModel] | None = None
    for part in loc:
        base, _ = _bare(annotation)
        tags = _tags(annotation)
        if tags:
            annotation = tags.get(str(part), annotation)
        elif isinstance(base, type) and issubclass(base, BaseModel):
            key.append(part)
            model = base
            annotation = base.model_fields.get(str(part))
        elif get_origin(base) in (list, dict):
            key.append(part)
            annotation = get_args(base)[-1]
        else:
            break  # a member of a plain union: the whole union is described
    return tuple(key), annotation, model


def _bare(annotation: Any) -> tuple[Any, list[Any]]:
    """Annotation without Annotated, FieldInfo and None, and the constraints found on the way."""
    metadata: list[Any] = []
    while True:
        if isinstance(annotation, FieldInfo):
            metadata += annotation.metadata
            annotation = annotation.annotation
        elif get_origin(annotation) is Annotated:
            annotation, *extra = get_args(annotation)
            for item in extra:
                metadata += item.metadata if isinstance(item, FieldInfo) else [item]
        elif get_origin(annotation) in (Union, types.UnionType):
            members = [m for m in get_args(annotation) if m is not type(None)]
            if len(members) > 1:
                return annotation, metadata
            annotation = members[0]
        else:
            return annotation, metadata


def _members(annotation: Any) -> list[Any]:
    base, _ = _bare(annotation)
    return (
        [m for m in get_args(base) if m is not type(None)] if get_origin(base) in (Union, types.UnionType) else [base]
    )


def _tags(annotation: Any) -> dict[str, Any]:
    """kind -> model of a discriminated union; empty for anything else."""
    members = _members(annotation)
    if len(members) < 2 or not all(isinstance(m, type) and issubclass(m, BaseModel) for m in members):
        return {}
    return {tag: m for m in members for tag in get_args(m.model_fields["kind"].annotation)}


def _choices(annotation: Any) -> list[str]:
    return [word for member in _members(annotation) if get_origin(member) is Literal for word in get_args(member)]


def describe(annotation: Any) -> str:
    """What a key accepts, in words."""
    if tags := _tags(annotation):
        return "a table with kind " + " or ".join(map(repr, tags))
    base, metadata = _bare(annotation)
    if get_origin(base) in (Union, types.UnionType):
        return ", or ".join(describe(member) for member in _members(base))
    limits = {
        name: getattr(item, name)
        for item in metadata
        for name in ("gt", "ge", "lt", "le", "min_length", "max_length", "pattern")
        if getattr(item, name, None) is not None
    }
    if base in (int, float):
        signs = {"gt": ">", "ge": ">=", "lt": "<", "le": "<="}
        bounds = " and ".join(f"{signs[name]} {limits[name]:.6g}" for name in signs if name in limits)
        return f"a finite number {bounds}".strip() if base is float else f"a whole number {bounds}".strip()
    if base is str:
        longest = f" of at most {limits['max_length']} characters" if "max_length" in limits else ""
        return f"a {'non-empty ' if limits.get('min_length') else ''}string{longest}"
    if base is bool:
        return "true or false"
    if get_origin(base) is Literal:
        return "one of " + ", ".join(map(repr, get_args(base)))
    if get_origin(base) is list:
        low, high = limits.get("min_length", 0), limits.get("max_length")
        count = f" of {low} elements" if low and low == high else " of at least one element" if low else ""
        return f"a list{count}, each {describe(get_args(base)[0])}"
    if isinstance(base, type) and issubclass(base, BaseModel):
        return "a table with the keys " + ", ".join(base.model_fields)
    return "a table"
