"""Response maps of the full integrand |F| / int |F| over (theta_i, phi), for eccentricities of the section and numbers
of scattering fibres, with the proposal fitted to each and the ratio of both: the weight of a sample in units of the
mean weight."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Any, Literal

import numpy as np
import torch
from pydantic import Field

from dsfit import Context, Integrand, load_proposal
from dsfit.experiment import build
from dsfit.experiment.files import number
from dsfit.experiment.rundir import RunDirectory
from dsfit.experiment.validation import load
from dsfit.figures import Close, Data, Estimate, Experiment, Measured, Settings, Work

_CONFIG = "sweep_eccentricity_n.toml"
_METHODS = ("uniform", "mix", "fitted")
_FLOOR = 1e-6  # of a map's maximum: what is darker is stored as this
Angle = Annotated[float, Field(gt=-90, lt=90)]
Azimuths = list[Annotated[float, Field(ge=-180, le=180)]]
Section = Annotated[float, Field(gt=0.71, le=1)]
Fibres = Annotated[float, Field(ge=0, le=1000)]


class ResponseMaps(Settings):
    """Angles in degrees.

    `eccentricities` x `n` make the matrix, seen from `theta_r_deg`, `phi_r_deg`; `turned_phi_r_deg` are the azimuths of
    the view at `turned_eccentricity` and `turned_n` (none: no such row). Fits take `max_steps`; of every map each
    `thin`-th direction is stored; `checked` directions of each fitted proposal test the mean weight, with `seed`.
    """

    preset: Literal["nonabsorbing", "blond", "brown", "black"] = "blond"
    theta_r_deg: Angle = 30.0
    phi_r_deg: Annotated[float, Field(ge=-180, le=180)] = 40.0
    eccentricities: Annotated[list[Section], Field(min_length=1)] = [0.85, 0.92, 1.0]
    n: Annotated[list[Fibres], Field(min_length=1)] = [0.0, 1.0, 3.0, 10.0]
    turned_phi_r_deg: Azimuths = [0.0, 30.0, 60.0, 90.0]
    turned_eccentricity: Section = 0.85
    turned_n: Fibres = 1.0
    max_steps: Annotated[int, Field(ge=1, le=1000)] = 40
    thin: Literal[1, 2, 3, 4, 5, 6] = 2
    checked: Annotated[int, Field(ge=16, le=2**20)] = 4096
    seed: Annotated[int, Field(ge=0, lt=2**31)] = 1


def compute(settings: ResponseMaps, work: Work) -> Data:
    """Runs the sweep for the matrix and for the turned views, and thins its maps."""
    arrays: dict[str, np.ndarray] = {}
    cells = _cells(settings, work, "matrix", settings.eccentricities, settings.n, [settings.phi_r_deg], arrays)
    turned: list[dict[str, Any]] = []
    if settings.turned_phi_r_deg:
        section, n = [settings.turned_eccentricity], [settings.turned_n]
        turned = _cells(settings, work, "turned", section, n, settings.turned_phi_r_deg, arrays)
    record = {"preset": settings.preset, "theta_r_deg": settings.theta_r_deg, "phi_r_deg": settings.phi_r_deg,
              "eccentricities": settings.eccentricities, "n": settings.n, "turned_phi_r_deg": settings.turned_phi_r_deg,
              "turned_eccentricity": settings.turned_eccentricity, "turned_n": settings.turned_n,
              "cells": {cell.pop("name"): cell for cell in [*cells, *turned]}}  # fmt: skip
    return Data(arrays, record)


def _cells(
    settings: ResponseMaps, work: Work, which: str, sections: Sequence[float], n: Sequence[float],
    phi_r: Sequence[float], arrays: dict[str, np.ndarray],
) -> list[dict[str, Any]]:  # fmt: skip
    """Facts of every cell of a sweep; its maps go to `arrays` as `CELL.integrand` and `CELL.ratio`, decimal logarithms
    in float16."""
    overrides = (
        f'fiber.preset="{settings.preset}"',
        f"contexts.theta_r_deg=[{settings.theta_r_deg!r}]",
        f"contexts.phi_r_deg={list(phi_r)!r}",
        f"contexts.n={list(n)!r}",
        f'sweep.grid."fiber.eccentricity"={list(sections)!r}',
        f"methods={_methods(settings.max_steps)}",
        f"estimate.seed={settings.seed}",
        "estimate.samples=[16]",
        "estimate.repeats=2",
        "estimate.rounds=1",
        "output.plots=false",
    )
    work.say(f"{which}: {len(sections) * len(n) * len(phi_r)} cells")
    directory = work.run(_CONFIG, overrides)
    found = []
    for cell in directory.result()["cells"]:
        section = number(cell["identity"]["grid"]["fiber.eccentricity"])
        place = cell["identity"]["context"]
        azimuth = number(place["phi_r_deg"])
        name = f"{which}.e{section:g}-n{number(place['n']):g}-phi{azimuth:g}"
        maps = directory.arrays(cell["index"])
        facts = _facts(cell, maps)
        _keep(arrays, name, maps, settings.thin)
        path = work.root / "configs" / _CONFIG
        point = load(path, (*overrides, f'sweep.grid."fiber.eccentricity"=[{section!r}]')).points[0]
        facts |= _mean_weight(directory, cell, build.bsdf(point.config), settings)
        found.append({"name": name, "eccentricity": section, "n": number(place["n"]), "phi_r_deg": azimuth, **facts})
    return found


def _methods(steps: int) -> str:
    """The sweep's methods as TOML."""
    kinds = (
        '{name="uniform", kind="uniform"}',
        '{name="mix", kind="heuristic_mix", weights="best"}',
        f'{{name="fitted", kind="fitted", max_steps={steps}}}',
    )
    return f"[{', '.join(kinds)}]"


def _facts(cell: dict[str, Any], maps: dict[str, np.ndarray]) -> dict[str, Any]:
    """Excess, its bound and the largest weight of every method; the fit's steps and seconds; integrals of the maps."""
    methods = {one["name"]: one for one in cell["methods"]}
    facts: dict[str, Any] = {
        name: {key: number(methods[name][key]) for key in ("excess", "excess_error", "largest_weight")}
        for name in _METHODS
    }
    fit = methods["fitted"]["fit"]
    facts["fit"] = {"steps": fit["steps"], "nodes": fit["nodes"], "at_bounds": len(fit["at_bounds"])}
    facts["seconds"] = {"fit": number(fit["seconds"]), "cell": number(cell["seconds"])}
    facts["mix_of"] = {k: round(float(c), 3) for k, c in zip(methods["mix"]["strategies"], methods["mix"]["fractions"],
                                                             strict=True)}  # fmt: skip
    facts["map_integrals"] = {"integrand": _integral(maps, "integrand"), "fitted": _integral(maps, "density_2")}
    return facts


def _integral(maps: dict[str, np.ndarray], name: str) -> float:
    """Integral over the sphere by the trapezoidal rule on the map's grid."""
    theta, phi = np.radians(maps["theta_deg"]), np.radians(maps["phi_deg"])
    values = maps[name].astype(np.float64) * np.cos(theta)[:, None]
    return float(np.trapezoid(np.trapezoid(values, phi, axis=1), theta))


def _keep(arrays: dict[str, np.ndarray], name: str, maps: dict[str, np.ndarray], thin: int) -> None:
    some = slice(None, None, thin)
    arrays["theta_deg"], arrays["phi_deg"] = maps["theta_deg"][some], maps["phi_deg"][some]
    integrand, density = (maps[key][some, some].astype(np.float64) for key in ("integrand", "density_2"))
    floor = _FLOOR * integrand.max()
    arrays[f"{name}.integrand"] = np.log10(np.maximum(integrand, floor)).astype(np.float16)
    arrays[f"{name}.ratio"] = np.log10(np.maximum(integrand, floor) / density).astype(np.float16)


def _mean_weight(directory: RunDirectory, cell: dict[str, Any], bsdf: Any, settings: ResponseMaps) -> dict[str, Any]:
    """Mean of |F| / (p int |F|) over directions drawn from the fitted proposal, which is 1, and its standard error."""
    fit = next(one for one in cell["methods"] if one["name"] == "fitted")["fit"]
    proposal = load_proposal(directory.path / fit["file"])
    place = cell["identity"]["context"]
    context = Context(math.radians(place["theta_r_deg"]), math.radians(place["phi_r_deg"]), number(place["n"]))
    generator = torch.Generator().manual_seed(settings.seed)
    with torch.no_grad():
        distribution = proposal(context)
        u = torch.rand(settings.checked, distribution.dimension, generator=generator, dtype=torch.float64)
        omega, log_p = distribution.sample_with_log_prob(u.clamp(1e-12, 1 - 1e-12))
        value = torch.linalg.vector_norm(Integrand(bsdf)(omega, context), dim=-1)
    weight = value * torch.exp(-log_p) / number(cell["reference"]["norm"])
    error = float(weight.std()) / math.sqrt(len(weight))
    return {"mean_weight": float(weight.mean()), "mean_weight_error": error}


EXPERIMENT = Experiment(
    title="Response maps over eccentricity and scattering fibres",
    shows="|F|/∫|F| over the direction of the light for eccentricities and n, beside each the fitted proposal and the "
    "weight of a sample; views of an elliptic section from several azimuths; the excess of uniform directions, of the "
    "best heuristic mix and of the fit.",
    settings=ResponseMaps,
    compute=compute,
    minutes=4.0,
    needs=("jax", "optimistix"),
    reproduces={
        "cells.*.seconds.*": Measured(),
        "cells.*.mean_weight": Estimate("cells.*.mean_weight_error", most=0.1),
        "cells.*.mean_weight_error": Close(0.2),
        "cells.*.fit.*": Close(0.5),
        "cells.*.fitted.largest_weight": Close(0.05),
        "cells.*.fitted.excess*": Close(0.05, 1e-6),
        "cells.*.map_integrals.*": Close(1e-3),
        "cells.*.mix_of.*": Close(0.02, 0.01),
        "cells.*.excess_error": Close(0.5),
        "cells.*.excess": Close(5e-3),
        "cells.*.largest_weight": Close(5e-3),
        "*.ratio": Close(1e-3, 0.02),
        "*.integrand": Close(1e-3, 2e-3),
    },
    small=("eccentricities=[1.0]", "n=[3.0]", "turned_phi_r_deg=[]", "max_steps=4", "checked=256"),
)
