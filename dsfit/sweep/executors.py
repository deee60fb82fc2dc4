"""Where batches are computed, behind `concurrent.futures`: processes of this machine, or a Dask cluster."""

from __future__ import annotations

import importlib.metadata
import platform
import time
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, Protocol

from dsfit.errors import InputError
from dsfit.experiment.provenance import code_version
from dsfit.experiment.rundir import RunFailure
from dsfit.sweep.slot import run_batch, start_again, stop_all
from dsfit.sweep.tasks import Batch

# what decides numbers, and what has to understand each other over the network
_COMPARED = ("torch", "numpy", "scipy", "jax", "optimistix", "distributed", "cloudpickle")
CONNECT_SECONDS = 20.0
"""How long a scheduler, and then its first worker, is waited for."""
_ASK_EVERY = 5.0  # seconds between looks at how many workers there are


class Machines(Protocol):
    """Where batches are computed."""

    name: str

    def slots(self) -> int:
        """How many batches are computed at once, at present."""

    def submit(self, batch: Batch) -> Future[list[dict[str, Any]]]:
        """Compute a batch."""

    def lost(self) -> str:
        """Why nothing can be computed any more; empty as long as it can."""

    def close(self) -> None:
        """End; what is at work is given up."""


class LocalProcesses:
    """Child processes of this machine, one thread each; every one is kept by a thread of this process."""

    def __init__(self, workers: int) -> None:
        self.name = f"{workers} local processes"
        self._workers = workers
        start_again()
        self._pool: Executor = ThreadPoolExecutor(workers, thread_name_prefix="dsfit-sweep")

    def slots(self) -> int:
        """The number of processes."""
        return self._workers

    def submit(self, batch: Batch) -> Future[list[dict[str, Any]]]:
        """Compute a batch."""
        return self._pool.submit(run_batch, batch)

    def lost(self) -> str:
        """Never."""
        return ""

    def close(self) -> None:
        """End all processes."""
        stop_all()
        self._pool.shutdown(wait=True, cancel_futures=True)


def versions() -> dict[str, str]:
    """Versions of this process's code, Python and packages."""
    found = {"dsfit": code_version(), "python": platform.python_version()}
    for name in _COMPARED:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found


class DaskCluster:
    """The workers of a Dask scheduler: as many batches at once as they have threads. Workers may come and go."""

    def __init__(self, address: str, timeout: float | None = None) -> None:
        """Connect, and compare the versions of all workers with this process's.

        Args:
            address: of the scheduler, as `tcp://host:8786`, or the JSON file that it writes.
            timeout: seconds to wait for the scheduler, and then for its first worker; left out, `CONNECT_SECONDS`.

        Raises:
            InputError: `distributed` is not installed, or nobody answers there.
            RunFailure: no workers, or other versions there.
        """
        try:
            from distributed import Client
        except ImportError:
            raise InputError("--dask", address, "the package `distributed` to be installed here and there") from None
        timeout = CONNECT_SECONDS if timeout is None else timeout
        self._client = _connect(Client, address, timeout)
        self._executor = self._client.get_executor(pure=False)
        self._slots, self._asked = 0, -_ASK_EVERY
        try:
            self._check_workers(address, timeout)
        except BaseException:
            self.close()
            raise
        self.name = f"Dask at {self._client.scheduler.address}"

    def _check_workers(self, address: str, timeout: float) -> None:
        try:
            self._client.wait_for_workers(1, timeout=timeout)
        except TimeoutError:
            raise RunFailure(f"{address}: the scheduler has no workers (waited {timeout:g} s)") from None
        try:
            there = self._client.run(versions)
        except Exception as error:
            raise RunFailure(
                f"{address}: dsfit cannot be used by the workers: {type(error).__name__}: {error}"
            ) from None
        here = versions()
        for worker, found in there.items():
            differing = [f"{name} {found[name]} (here {here[name]})" for name in here if found[name] != here[name]]
            if differing:
                raise RunFailure(f"{address}: worker {worker} has {', '.join(differing)}; numbers could differ")

    def slots(self) -> int:
        """Threads of all workers, as they were a few seconds ago."""
        if time.monotonic() - self._asked > _ASK_EVERY:
            self._asked = time.monotonic()
            try:
                self._slots = sum(self._client.ncores().values())
            except (OSError, ValueError, TimeoutError):  # while the connection is being made again
                pass
        return self._slots

    def submit(self, batch: Batch) -> Future[list[dict[str, Any]]]:
        """Compute a batch; should its worker be lost, another one does it."""
        return self._executor.submit(run_batch, batch)

    def lost(self) -> str:
        """Whether the scheduler is gone."""
        return "" if self._client.status in ("running", "connecting") else "the Dask scheduler is gone"

    def close(self) -> None:
        """Cancel what is not done and disconnect; the workers stay."""
        try:
            self._executor.shutdown(wait=False)
        finally:
            self._client.close(timeout=5)


def _connect(client: Any, address: str, timeout: float) -> Any:
    allowed = "the address of a running Dask scheduler (tcp://host:8786), or the JSON file that it writes"
    try:
        if "://" in address or not address.endswith(".json"):
            return client(address, timeout=timeout, set_as_default=False)
        if not Path(address).is_file():
            raise InputError("--dask", address, f"{allowed}; there is no such file")
        return client(scheduler_file=address, timeout=timeout, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError("--dask", address, f"{allowed} ({type(error).__name__}: {error})"[:400]) from None
