"""From a config to fibre, BSDF, light, scattering, integrand and contexts; the only place where degrees become
radians."""

from __future__ import annotations

import functools
import itertools
import math
import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import torch

from dsfit.bsdf import Convention, DualScattering, Fiber
from dsfit.context import Context
from dsfit.errors import InputError
from dsfit.experiment.schema import Config, ContextsConfig, FiberConfig
from dsfit.experiment.schema_lights import light_paths

if TYPE_CHECKING:
    from dsfit.experiment.reader import RawConfig
    from dsfit.scene import Light, Scattering

_DEG = math.pi / 180


def fiber(config: FiberConfig, dtype: torch.dtype = torch.float64) -> Fiber:
    """The preset with its overrides."""
    overrides: dict[str, Any] = {}
    for key, value in config.model_dump(exclude={"preset"}, exclude_none=True).items():
        tensor = torch.tensor(value, dtype=torch.float64)
        overrides[key.removesuffix("_deg")] = (tensor * _DEG if key.endswith("_deg") else tensor).to(dtype)
    return Fiber.preset(config.preset, dtype=dtype, **overrides)


def convention(config: Config) -> Convention:
    """The named convention with its switches."""
    given = config.bsdf.convention
    if isinstance(given, str):
        return Convention.named(given)
    switches = dict(given)
    base = switches.pop("base", "consistent")
    if not isinstance(base, str):
        raise InputError("convention.base", base, "'consistent' or 'printed'")
    return Convention.named(base, **switches)


def bsdf(config: Config, dtype: torch.dtype = torch.float64) -> DualScattering:
    """The dual scattering BSDF."""
    b = config.bsdf
    strand = fiber(config.fiber, dtype)
    precision = b.precision
    if precision == "auto":
        precision = "table" if strand.is_round and b.azimuthal != "raw" else "exact"
    return DualScattering(strand, b.d_f, b.d_b, b.azimuthal, convention(config), precision)


def light(config: Config) -> Light:
    """The light; reads the map of an environment light."""
    from dsfit.experiment.lights import made

    return made(config.light)


def scattering(config: Config) -> Scattering | None:
    """The scattering, or None where n and v are the context's."""
    from dsfit import scene

    options = config.scattering.model_dump(exclude={"kind", "hint"})
    if config.scattering.kind == "slab":
        return scene.SlabScattering(**options)
    if config.scattering.kind == "sphere":
        return scene.SphereScattering(**options)
    return None


def integrand(config: Config, dtype: torch.dtype = torch.float64) -> Any:
    """BSDF x light x scattering; the last few are kept, because the BSDF's tables take a second to make."""
    scene = config.model_dump_json(include={"fiber", "bsdf", "light", "scattering"})
    found = [os.stat(path) for path in light_paths(config.light) if os.path.exists(path)]
    return _integrand(_Scene(config, (scene, *((x.st_mtime_ns, x.st_size) for x in found))), dtype)


@dataclass(frozen=True)
class _Scene:
    """A config that equals another if their scenes do."""

    config: Config = field(compare=False)
    key: tuple[Any, ...]


@functools.lru_cache(maxsize=4)
def _integrand(scene: _Scene, dtype: torch.dtype) -> Any:
    from dsfit.scene.integrand import Integrand

    config = scene.config
    return Integrand(bsdf(config, dtype), light=light(config), scattering=scattering(config))


def context_values(contexts: ContextsConfig) -> Iterator[dict[str, Any]]:
    """Every context as the plain numbers of the config; v is None where it follows from n."""
    lists = [contexts.theta_r_deg, contexts.phi_r_deg, contexts.n, contexts.v or [None]]
    if contexts.combine == "zip":
        length = max(map(len, lists))
        lists = [x * length if len(x) == 1 else x for x in lists]
        combined: Iterator[Any] = zip(*lists, strict=True)
    else:
        combined = itertools.product(*lists)
    for values in combined:
        yield dict(zip(("theta_r_deg", "phi_r_deg", "n", "v"), values, strict=True))


def context(config: Config, values: dict[str, Any]) -> Context:
    """The (scalar) context of these numbers; a slab or sphere supplies n and v."""
    made = Context(
        torch.tensor(values["theta_r_deg"] * _DEG, dtype=torch.float64),
        values["phi_r_deg"] * _DEG,
        values["n"],
        values["v"],
    )
    where = scattering(config)
    return made if where is None else where.hints(made, config.scattering.hint)  # type: ignore[union-attr]


def check(raw: RawConfig, config: Config) -> None:
    """Build everything that is cheap to build, so that what the library refuses is refused before anything is written.

    Raises:
        ConfigError: naming the key that the library's error comes from.
    """
    from dsfit.experiment.methods import check_method
    from dsfit.experiment.validation import library_error

    for section, make in (
        ("fiber", lambda: fiber(config.fiber)),
        ("light", lambda: light(config)),
        ("scattering", lambda: scattering(config)),
    ):
        try:
            make()
        except InputError as error:
            if section == "light" and config.light.kind == "environment":
                raise raw.error(("light", "path"), f"{error.allowed} (here: {error.value})") from None
            raise library_error(raw, section, error) from None
    try:
        convention(config)
    except InputError as error:
        given = raw.lookup(("bsdf", "convention"))
        key: tuple[str, ...] = ("bsdf", "convention")
        if isinstance(given, dict):
            known = error.field.split(".")[-1]
            key = (*key, known if known in given else str(error.value) if str(error.value) in given else "base")
        raise raw.error(key, error.allowed) from None
    try:
        integrand(config)
    except InputError as error:
        section = error.field.split(".")[0]
        raise library_error(raw, section if section in ("light", "fiber") else "bsdf", error) from None
    for index, method in enumerate(config.methods):
        check_method(raw, index, method, config)
    if config.kind == "check":
        from dsfit.experiment.checking import validate

        validate(raw, config)
    if config.kind == "race":
        from dsfit.experiment.race import check as check_race

        check_race(raw, config)
    if config.kind == "amortise":
        from dsfit.experiment.amortise import check as check_amortise

        check_amortise(raw, config)
    if config.kind in ("render", "compare_render"):
        from dsfit.experiment.render_scene import check as check_scene

        check_scene(raw, config)
    if config.kind == "render":
        from dsfit.experiment.render import check as check_render

        check_render(raw, config)
