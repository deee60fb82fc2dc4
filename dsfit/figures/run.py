"""Makes many experiments, each in a process of its own: one that fails, or is killed, leaves the others alone."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass, field
from pathlib import Path

from dsfit.experiment import provenance
from dsfit.experiment.runner import ONE_THREAD, cores
from dsfit.figures import state
from dsfit.figures.catalogue import Entry
from dsfit.figures.make import Look, is_up_to_date
from dsfit.figures.manifest import write_manifest
from dsfit.figures.worker import DONE, SAY

_PATIENCE = 5.0


@dataclass(frozen=True)
class Made:
    """How an experiment ended: `failure` is empty where it went well."""

    name: str
    failure: str = ""
    computed: bool = False
    drawn: bool = False
    seconds: float = 0.0


@dataclass(frozen=True)
class Job:
    """What all experiments have in common.

    Attributes:
        out: directory that they go to.
        overrides: `key=value` changes of the settings of each.
        force: compute anew.
        only_draw: draw the data that are there.
        look: width and formats of figures.
        say: told the name of an experiment and what it does; called from several threads.
    """

    out: Path
    overrides: Sequence[str] = ()
    force: bool = False
    only_draw: bool = False
    look: Look = field(default_factory=Look)
    say: Callable[[str, str], None] = lambda name, what: None

    def text(self, entry: Entry) -> str:
        """For a worker's command line."""
        common = {"overrides": list(self.overrides), "force": self.force, "only_draw": self.only_draw}
        place = {"root": str(entry.root), "name": entry.name, "out": str(self.out.resolve())}
        return json.dumps({**place, **common, "look": asdict(self.look)})


def run_all(entries: Sequence[Entry], job: Job, workers: int | None = None) -> list[Made]:
    """Make the experiments, those that take longest first, and write manifest and thesis; returns how each ended, in
    the order given. What is up to date takes no process.

    Another run in the same directory may go on at once: each experiment is made by one of them, the other waits.

    Args:
        entries: what to make.
        job: how.
        workers: how many at once, one thread each; left out, the number of cores.

    Raises:
        KeyboardInterrupt: passed on when everything is stopped; what is done stays.
    """
    job.out.mkdir(parents=True, exist_ok=True)
    found: dict[str, Made] = {}
    todo = []
    for entry in sorted(entries, key=lambda entry: -entry.experiment.minutes):
        if not job.force and _is_up_to_date(entry, job):
            found[entry.name] = Made(entry.name)
            (job.out / entry.name / state.FAILED).unlink(missing_ok=True)
        else:
            todo.append(entry)
    crew = _Crew(job)
    pool = ThreadPoolExecutor(workers or cores())
    try:
        for future in as_completed([pool.submit(crew.make, entry) for entry in todo]):
            found[future.result().name] = future.result()
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        crew.stop()
        raise
    finally:
        pool.shutdown()
        write_manifest(job.out)
    return [found[entry.name] for entry in entries]


def _is_up_to_date(entry: Entry, job: Job) -> bool:
    """False as well where that cannot be told: the worker will say why."""
    try:
        return is_up_to_date(entry, job.out, job.overrides, only_draw=job.only_draw, look=job.look)
    except Exception:  # a drawing that is no Python, a state file of another version
        return False


class _Crew:
    """Worker processes, which can all be stopped."""

    def __init__(self, job: Job) -> None:
        self._job = job
        self._guard = threading.Lock()
        self._stopped = False
        self._running: set[subprocess.Popen[str]] = set()

    def stop(self) -> None:
        """End all processes and what they started, first kindly."""
        with self._guard:
            self._stopped = True
            running = list(self._running)
        for process in running:
            _signal(process, signal.SIGTERM)
        end = time.monotonic() + _PATIENCE
        for process in running:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(max(0.0, end - time.monotonic()))
            _signal(process, signal.SIGKILL)

    def make(self, entry: Entry) -> Made:
        """One experiment in a new process, when no other run is at it."""
        folder, told = self._job.out / entry.name, False

        def waiting() -> None:
            nonlocal told
            if self._stopped:
                raise _Stopped
            if not told:
                self._job.say(entry.name, "waiting for another run that is at it")
            told = True

        try:
            with state.lock(folder, waiting) as handle:
                made = self._in_process(entry, folder, handle)
                _record(folder, made)
                return made
        except _Stopped:
            return Made(entry.name, "stopped")
        except OSError as error:
            return Made(entry.name, f"{folder}: {error.strerror}")

    def _in_process(self, entry: Entry, folder: Path, handle: int) -> Made:
        """Its last line is what it did, or why it failed; everything goes to the log, what is meant for it is told."""
        command = [sys.executable, "-m", "dsfit.figures.worker", self._job.text(entry)]
        log, last = folder / "log.txt", ""
        with open(log, "w", encoding="utf-8") as file:
            with self._guard:
                if self._stopped:
                    raise _Stopped
                process = subprocess.Popen(
                    command, env={**os.environ, **ONE_THREAD}, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
                    stderr=subprocess.STDOUT, text=True, errors="replace", bufsize=1, start_new_session=True,
                    pass_fds=(handle,) if handle >= 0 else (),
                )  # fmt: skip
                self._running.add(process)
            threading.Thread(target=_bury, args=(process,), daemon=True).start()
            assert process.stdout is not None
            for line in process.stdout:
                file.write(line)
                file.flush()
                last = line.strip() or last
                if last.startswith(SAY):
                    self._job.say(entry.name, last.removeprefix(SAY))
            code = process.wait()
            with self._guard:
                self._running.discard(process)
        if code == 0 and last.startswith(DONE):
            return Made(entry.name, **json.loads(last.removeprefix(DONE)))
        return Made(entry.name, f"{_ending(code)}: {last.removeprefix(SAY) or 'no word'} (all of it: {log})")


class _Stopped(Exception):
    """The run is being ended."""


def _bury(process: subprocess.Popen[str]) -> None:
    """When a worker has ended, end what it left behind, which would keep its output open."""
    process.wait()
    _signal(process, signal.SIGKILL)


def _signal(process: subprocess.Popen[str], what: signal.Signals) -> None:
    """To the process and all that it started, as long as any lives."""
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, what)


def _record(folder: Path, made: Made) -> None:
    if made.failure:
        state.write_state(folder / state.FAILED, {"failure": made.failure, "at": provenance.now()})
    else:
        (folder / state.FAILED).unlink(missing_ok=True)


def _ending(code: int) -> str:
    if code < 0:
        with contextlib.suppress(ValueError):
            return f"killed by {signal.Signals(-code).name}"
    return f"exit {code}"
