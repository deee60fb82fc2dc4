"""The cells of an experiment: what is computed and stored as one piece."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from dsfit.experiment import build
from dsfit.experiment.rundir import RunDirectory
from dsfit.experiment.schema import Config
from dsfit.experiment.validation import Experiment


@dataclass(frozen=True)
class Job:
    """One cell: a context of a grid point, a whole grid point for `transmittance`, a suite's part for `check`, a peer
    over one group of contexts for `race`, a tile for `render`, a technique for
    `compare_render`.

    Attributes:
        index: position in the run.
        label: for tables and plots.
        identity: grid values and context, in plain data; a stored cell with another identity is not this one.
        config: the grid point's config.
    """

    index: int
    label: str
    identity: dict[str, Any]
    config: Config


def jobs(experiment: Experiment) -> list[Job]:
    """All cells, in a fixed order."""
    found: list[Job] = []
    for number, point in enumerate(experiment.points):
        for work in _work_of(point.config, first=number == 0):
            identity = {"grid": point.values, **work}
            found.append(Job(len(found), _label(point.config, identity), identity, point.config))
    return found


def _work_of(config: Config, first: bool) -> Iterable[dict[str, Any]]:
    """Identities of the cells of one grid point; `first` says whether it is the first one."""
    if config.kind == "check":
        from dsfit.experiment.checking import work_of

        return work_of(config, first=first)
    if config.kind == "race":
        from dsfit.experiment.race import work_of as races_of

        return races_of(config)
    if config.kind == "render":
        from dsfit.experiment.render import work_of as tiles_of

        return tiles_of(config)
    if config.kind == "compare_render":
        from dsfit.experiment.compare_render import work_of as techniques_of

        return techniques_of(config)
    if config.kind in ("transmittance", "amortise"):
        return [{"context": {}}]
    return [{"context": context} for context in build.context_values(config.contexts)]


_SHOWN_ANYWAY = ("fiber.preset", "contexts.theta_r_deg", "contexts.phi_r_deg", "contexts.n", "contexts.v")


def _label(config: Config, identity: dict[str, Any]) -> str:
    if identity.get("part"):
        return f"{identity['suite']}: {identity['part']}"
    if identity.get("peer"):
        return f"{identity['peer']}: {identity['group']}"
    if identity.get("technique"):
        return str(identity["technique"])
    if identity.get("tile"):
        top, left, bottom, right = identity["tile"]
        return f"rows {top} to {bottom - 1}, columns {left} to {right - 1}"
    parts = [config.fiber.preset]
    parts += [f"{key.split('.')[-1]} {value}" for key, value in identity["grid"].items() if key not in _SHOWN_ANYWAY]
    context = identity["context"]
    if context:
        parts.append(f"θr {context['theta_r_deg']:g}°")
        if context["phi_r_deg"]:
            parts.append(f"φr {context['phi_r_deg']:g}°")
        if config.scattering.kind == "constant":
            parts.append(f"n {context['n']:g}")
            if context["v"] is not None:
                parts.append(f"v {context['v']:g}")
    return ", ".join(parts)


def run_job(directory: RunDirectory, job: Job, say: Callable[[str], None]) -> None:
    """Compute a cell and write it."""
    started = time.perf_counter()
    if job.config.kind == "transmittance":
        from dsfit.experiment.transmittance import transmittance

        data, arrays = transmittance(job.config, say)
    elif job.config.kind == "check":
        from dsfit.experiment.checking import run_suite

        data, arrays = run_suite(job.config, job.identity, job.label, say)
    elif job.config.kind == "race":
        from dsfit.experiment.race import race

        data, arrays = race(job.config, job.identity, directory, say)
    elif job.config.kind == "compare_render":
        from dsfit.experiment.compare_render import compare_render

        data, arrays = compare_render(job.config, job.identity, directory, say)
    elif job.config.kind == "render":
        from dsfit.experiment.render import render

        data, arrays = render(job.config, job.identity, directory, say)
    elif job.config.kind == "amortise":
        from dsfit.experiment.amortise import amortise

        data, arrays = amortise(job, directory, say)
    else:
        from dsfit.experiment.compare import compare

        data, arrays = compare(job, directory, say)
    data = {"index": job.index, "label": job.label, "identity": job.identity, **data}
    directory.write_cell(job.index, {**data, "seconds": time.perf_counter() - started}, arrays)
