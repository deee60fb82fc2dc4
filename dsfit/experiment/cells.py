"""The cells of an experiment: what is computed and stored as one piece."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from dsfit.errors import InputError
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
        for work in work_of(point.config, first=number == 0):
            identity = {"grid": point.values, **work}
            found.append(Job(len(found), label_of(point.config, identity), identity, point.config))
    return found


def work_of(config: Config, first: bool) -> Iterable[dict[str, Any]]:
    """Identities of the cells of one grid point; `first` says whether it is the first one."""
    if config.kind == "check":
        from dsfit.experiment.checking import work_of as suites_of

        return suites_of(config, first=first)
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


def label_of(config: Config, identity: dict[str, Any]) -> str:
    """A cell's name for tables and plots."""
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
    parts += [f"{_last(key)} {value}" for key, value in identity["grid"].items() if not key.startswith(_SHOWN_ANYWAY)]
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


def _last(key: str) -> str:
    """The last part of a dotted key; of a list's element, the list's name too."""
    name, _, last = key.rpartition(".")
    return f"{name.rpartition('.')[2]}.{last}" if last.isdigit() else last


def run_job(directory: RunDirectory, job: Job, say: Callable[[str], None]) -> None:
    """Compute a cell and write it."""
    data, arrays = compute_job(directory, job, say)
    directory.write_cell(job.index, data, arrays)


def compute_job(
    directory: RunDirectory | None, job: Job, say: Callable[[str], None]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Numbers and arrays of a cell, not yet written.

    Without a directory nothing is written on the way either: proposals are not kept and no maps are made. That is for
    comparisons, transmittances, checks and amortising; the other kinds share files between their cells.
    """
    started = time.perf_counter()
    data, arrays = _computed(directory, job, say)
    data = {"index": job.index, "label": job.label, "identity": job.identity, **data}
    return {**data, "seconds": time.perf_counter() - started}, arrays


def _computed(
    directory: RunDirectory | None, job: Job, say: Callable[[str], None]
) -> tuple[dict[str, Any], dict[str, Any]]:
    kind = job.config.kind
    if kind == "transmittance":
        from dsfit.experiment.transmittance import transmittance

        return transmittance(job.config, say)
    if kind == "check":
        from dsfit.experiment.checking import run_suite

        return run_suite(job.config, job.identity, job.label, say)
    if kind == "amortise":
        from dsfit.experiment.amortise import amortise

        return amortise(job, directory, say)
    if kind in ("compare", "sweep"):
        from dsfit.experiment.compare import compare

        return compare(job, directory, say)
    if directory is None:
        raise InputError("directory", None, f"a run directory for cells of kind {kind!r}")
    if kind == "race":
        from dsfit.experiment.race import race

        return race(job.config, job.identity, directory, say)
    if kind == "compare_render":
        from dsfit.experiment.compare_render import compare_render

        return compare_render(job.config, job.identity, directory, say)
    from dsfit.experiment.render import render

    return render(job.config, job.identity, directory, say)
