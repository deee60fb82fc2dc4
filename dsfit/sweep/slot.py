"""Where a batch of cells is computed: a thread that keeps one child process, on this machine or on a Dask worker.

The child is a fresh interpreter with one thread, so that numbers do not depend on what else the worker has done, and a
cell that hangs, runs out of memory or crashes takes nobody else with it.
"""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

from dsfit.experiment.provenance import numbers_version
from dsfit.experiment.threads import ONE_THREAD
from dsfit.sweep.tasks import Base, Batch, Task

_SHOWN = 2000  # bytes of a dead child's last words


class Stopped(RuntimeError):
    """The sweep ends: what is not computed yet is left."""


class Unable(RuntimeError):
    """This worker cannot compute cells at all: another version of the code, or a child that does not start."""


_mine = threading.local()
_lock = threading.Lock()
_children: set[_Child] = set()
_stopping = threading.Event()


def run_batch(batch: Batch) -> list[dict[str, Any]]:
    """Compute a batch's cells in this thread's child; returns an outcome for each (see `compute.Outcome`).

    Raises:
        Stopped: `stop_all` was called.
        Unable: no cell can be computed here.
    """
    if numbers_version() != batch.version:
        raise Unable(f"dsfit {numbers_version()} on this worker, {batch.version} where the sweep was started")
    token = object()  # this batch's base has to be sent once to every child that works at it
    return [_run(batch, task, token) for task in batch.tasks]


def _run(batch: Batch, task: Task, token: object) -> dict[str, Any]:
    clock = time.monotonic()
    for attempt in (1, 2):
        if _stopping.is_set():
            raise Stopped("stopped")
        child = _child()
        try:
            return child.ask(batch.base, token, task, batch.timeout)
        except _Gone as gone:
            _drop(child)
            if _stopping.is_set():
                raise Stopped("stopped") from None
            if not gone.asked and attempt == 1:
                continue  # an idle child had ended
            return {
                "cell": task.cell, "context": None, "fate": gone.fate, "error": gone.reason, "traceback": gone.words,
                "seconds": time.monotonic() - clock,
            }  # fmt: skip
    raise AssertionError("unreachable")


def _child() -> _Child:
    """This thread's child; a new one where there is none."""
    child = getattr(_mine, "child", None)
    if child is None or child.process.poll() is not None:
        if child is not None:
            _drop(child)
        child = _mine.child = _Child()
        with _lock:
            _children.add(child)
        child.wait_ready()
    return child


def _drop(child: _Child) -> None:
    child.kill()
    with _lock:
        _children.discard(child)
    _mine.child = None


def stop_all() -> None:
    """Kill all children of this process; threads at work raise `Stopped`."""
    _stopping.set()
    with _lock:
        for child in _children:
            child.kill()
        _children.clear()


def start_again() -> None:
    """Take back `stop_all`."""
    _stopping.clear()


class _Gone(Exception):
    """The child is not there any more; `asked` says whether it had got the cell."""

    def __init__(self, fate: str, reason: str, words: str, asked: bool) -> None:
        super().__init__(reason)
        self.fate, self.reason, self.words, self.asked = fate, reason, words, asked


class _Child:
    """A child process and the two pipes."""

    def __init__(self) -> None:
        self.words = tempfile.TemporaryFile("a+b")  # noqa: SIM115  (closed with the child)
        root = str(Path(__file__).resolve().parents[2])
        path = os.pathsep.join(filter(None, [root, os.environ.get("PYTHONPATH", "")]))
        self.process = subprocess.Popen(
            [sys.executable, "-m", "dsfit.sweep.child"], env={**os.environ, **ONE_THREAD, "PYTHONPATH": path},
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self.words,
        )  # fmt: skip
        self._token: object = None
        self._timed_out = False

    def wait_ready(self) -> None:
        """Until it has imported what it needs.

        Raises:
            Unable: it ended instead.
        """
        try:
            pickle.load(self.process.stdout)  # type: ignore[arg-type]
        except (EOFError, OSError, pickle.UnpicklingError):
            words = self._last_words()
            _drop(self)
            if _stopping.is_set():
                raise Stopped("stopped") from None
            raise Unable(f"the process that computes cells did not start: {words}") from None

    def ask(self, base: Base, token: object, task: Task, timeout: float | None) -> dict[str, Any]:
        """The outcome of a cell.

        Raises:
            _Gone: the child died, or was killed because it took too long.
        """
        stdin, stdout = self.process.stdin, self.process.stdout
        assert stdin is not None and stdout is not None
        self.words.truncate(0)
        try:
            pickle.dump((None if token is self._token else base, task), stdin)
            stdin.flush()
        except OSError:
            raise _Gone("died", "the process died while idle", "", asked=False) from None
        self._token = token
        self._timed_out = False
        timer = threading.Timer(timeout, self._time_out) if timeout is not None else None
        if timer is not None:
            timer.daemon = True
            timer.start()
        try:
            return pickle.load(stdout)
        except (EOFError, OSError, pickle.UnpicklingError):
            if self._timed_out:
                raise _Gone("timed out", f"took more than {timeout:g} s", "", asked=True) from None
            code = self.process.wait()
            raise _Gone("died", f"the process died ({_exit_text(code)})", self._last_words(), asked=True) from None
        finally:
            if timer is not None:
                timer.cancel()

    def _time_out(self) -> None:
        self._timed_out = True
        self.process.kill()

    def _last_words(self) -> str:
        size = self.words.seek(0, os.SEEK_END)
        self.words.seek(max(0, size - _SHOWN))
        return self.words.read().decode(errors="replace").strip()

    def kill(self) -> None:
        """End it, whatever it does."""
        self.process.kill()
        self.process.wait()


def _exit_text(code: int) -> str:
    import signal

    if code < 0:
        try:
            return signal.Signals(-code).name
        except ValueError:
            return f"signal {-code}"
    return f"exit code {code}"
