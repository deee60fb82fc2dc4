"""Runs an experiment: cells in parallel processes, each written when it is done, so that an interrupted run goes on
where it stopped."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import queue as queues
import time
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from dsfit.experiment import check_report, files, provenance
from dsfit.experiment.cells import Job, jobs, run_job
from dsfit.experiment.rundir import RunDirectory, RunFailure
from dsfit.experiment.schema import SCHEMA_VERSION, Config
from dsfit.experiment.threads import ONE_THREAD
from dsfit.experiment.validation import Experiment


class Progress(Protocol):
    """What the runner tells about itself; `NoProgress` keeps quiet."""

    def start(self, total: int, done: int) -> None:
        """`done` of `total` cells were there already."""

    def step(self, index: int, what: str) -> None:
        """Cell `index` now does `what`."""

    def finish(self, index: int) -> None:
        """Cell `index` is written."""


class NoProgress:
    """Says nothing."""

    def start(self, total: int, done: int) -> None:
        """Nothing."""

    def step(self, index: int, what: str) -> None:
        """Nothing."""

    def finish(self, index: int) -> None:
        """Nothing."""


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@dataclass(frozen=True)
class Outcome:
    """What `run` returns: where the run is, its result, and whether it was there already."""

    directory: RunDirectory
    result: dict[str, Any]
    skipped: bool


def run_directory(experiment: Experiment, out: str | Path | None = None) -> RunDirectory:
    """`<output.dir or out>/<config name>-<run id>`."""
    name = "".join(c if c.isalnum() or c in "._-" else "-" for c in experiment.name) or "run"
    folder = Path(out if out is not None else experiment.config.output.dir)
    return RunDirectory(folder / f"{name}-{provenance.run_id(experiment.config)}")


def run(
    experiment: Experiment,
    out: str | Path | None = None,
    *,
    force: bool = False,
    workers: int | None = None,
    progress: Progress | None = None,
) -> Outcome:
    """Run what is not done yet and return the result; every number but the seconds is the same for any number of
    workers.

    Args:
        experiment: from `validation.load`.
        out: folder of run directories instead of `output.dir`.
        force: throw away what an earlier run of the same experiment left.
        workers: processes with one thread each; left out, the number of cores, 1 where times are compared; 0 runs in
            this process.
        progress: told what goes on.

    Raises:
        RunFailure: cells failed (the others are done and kept), a worker died, or another process holds the directory.
    """
    directory, progress = run_directory(experiment, out), progress or NoProgress()
    try:
        directory.path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RunFailure(f"{directory.path}: {error.strerror}") from None
    with directory.lock():
        if force:
            directory.clear()
        elif (result := directory.finished()) is not None and _is_whole(directory, experiment.config):
            return Outcome(directory, result, skipped=True)
        started, clock = provenance.now(), time.perf_counter()
        config = experiment.config.model_dump(exclude_none=True)
        files.write_bytes(directory.path / "config.toml", files.to_toml(config).encode())
        todo = jobs(experiment)
        done = {job.index for job in todo if directory.cell(job.index, job.identity) is not None}
        pending = [job for job in todo if job.index not in done]
        if workers is None:  # what is timed side by side disturbs each other
            workers = 1 if experiment.config.kind in ("race", "compare_render") else cores()
        workers = min(workers, len(pending))
        session = {"started": started, "workers": workers, "threads_per_worker": 1, "cells_reused": len(done)}
        rendered = experiment.config.kind in ("render", "compare_render")
        numbers = experiment.config.render if rendered else experiment.config.estimate
        record = {**provenance.provenance(), "seed": numbers.seed, "dtype": numbers.dtype}
        sessions = [*directory.provenance().get("sessions", []), session]
        directory.write_json("provenance.json", {**record, "sessions": sessions})
        progress.start(len(todo), len(done))
        try:
            if pending and experiment.config.kind == "render":
                from dsfit.experiment.render import prepare

                prepare(directory, experiment.config, lambda what: progress.step(pending[0].index, what))
            failures = _compute(directory, pending, workers, progress)
        finally:
            session.update(finished=provenance.now(), seconds=round(time.perf_counter() - clock, 3))
            directory.write_json("provenance.json", {**record, "sessions": sessions})
        if failures:
            lines = "\n".join(f"  {job.label}: {reason}" for job, reason in failures)
            raise RunFailure(f"{len(failures)} of {len(todo)} cells failed (finished ones are kept):\n{lines}")
        result = {
            "name": experiment.name,
            "kind": experiment.config.kind,
            "title": experiment.config.title,
            "run_id": provenance.run_id(experiment.config),
            "config": config,
            "provenance": {**record, "sessions": sessions},
            "seconds": sum(s.get("seconds", 0.0) for s in sessions),
            "cells": [directory.cell(job.index, job.identity) for job in todo],
        }
        if experiment.config.kind == "check":
            result["report"] = check_report.report(result["cells"], experiment.config.check.level)
        if experiment.config.kind == "render":
            from dsfit.experiment.render_image import finish

            result["image"] = finish(directory, result, experiment.config)
        directory.write_json("result.json", result)
        return Outcome(directory, {"schema_version": SCHEMA_VERSION, **result}, skipped=False)


def _is_whole(directory: RunDirectory, config: Config) -> bool:
    """Whether a finished run has everything: of a rendering, its image."""
    if config.kind != "render":
        return True
    from dsfit.experiment.render_image import is_whole

    return is_whole(directory, config.render)


def _compute(directory: RunDirectory, pending: list[Job], workers: int, progress: Progress) -> list[tuple[Job, str]]:
    """Run the jobs; returns those that failed, with the reason."""
    if not pending:
        return []
    if workers == 0:
        return _in_this_process(directory, pending, progress)
    return _in_processes(directory, pending, workers, progress)


def _in_this_process(directory: RunDirectory, pending: list[Job], progress: Progress) -> list[tuple[Job, str]]:
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    failures = []
    try:
        for job in pending:
            reason = _guarded(directory, job, lambda what, index=job.index: progress.step(index, what))
            if reason:
                failures.append((job, reason))
            progress.finish(job.index)
    finally:
        torch.set_num_threads(threads)
    return failures


def _guarded(directory: RunDirectory, job: Job, say: Callable[[str], None]) -> str | None:
    """Run a job; an exception becomes its reason to fail, so that the other cells go on."""
    try:
        run_job(directory, job, say)
    except Exception as error:
        files.write_bytes(directory.cell_path(job.index, "error.txt"), traceback.format_exc().encode())
        return f"{type(error).__name__}: {error}"
    directory.cell_path(job.index, "error.txt").unlink(missing_ok=True)
    return None


_say_queue: Any = None


def _start_worker(queue: Any) -> None:
    """Runs first in every worker: one thread, and Ctrl-C is the parent's business."""
    import signal

    import torch

    global _say_queue
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    torch.set_num_threads(1)
    _say_queue = queue


def _work(path: str, job: Job) -> str | None:
    return _guarded(RunDirectory(path), job, lambda what: _say_queue.put((job.index, what)))


@contextlib.contextmanager
def _environment(changes: dict[str, str]) -> Iterator[None]:
    before = {name: os.environ.get(name) for name in changes}
    os.environ.update(changes)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _in_processes(
    directory: RunDirectory, pending: list[Job], workers: int, progress: Progress
) -> list[tuple[Job, str]]:
    spawn = multiprocessing.get_context("spawn")
    queue = spawn.Queue()
    failures: list[tuple[Job, str]] = []
    with _environment(ONE_THREAD):
        pool = ProcessPoolExecutor(workers, mp_context=spawn, initializer=_start_worker, initargs=(queue,))
        try:
            futures: dict[Future[str | None], Job] = {
                pool.submit(_work, str(directory.path), job): job for job in pending
            }
            waiting = set(futures)
            while waiting:
                finished, waiting = wait(waiting, timeout=0.2, return_when=FIRST_COMPLETED)
                with contextlib.suppress(queues.Empty):
                    while True:
                        progress.step(*queue.get_nowait())
                for future in finished:
                    job = futures[future]
                    reason = future.result()
                    if reason:
                        failures.append((job, reason))
                    progress.finish(job.index)
            pool.shutdown()
        except BrokenProcessPool:
            raise RunFailure("a worker process died (out of memory, or killed); finished cells are kept") from None
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in multiprocessing.active_children():
                process.terminate()
            raise
    return sorted(failures, key=lambda failure: failure[0].index)
