"""The clock of a race, and peers made ready by it.

It counts CPU seconds, of this process and of the compilers it starts: everything here runs in one thread, so they are
the run time on a core that does nothing else, and other work on the machine does not count against a peer.
"""

from __future__ import annotations

import importlib
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import torch

from dsfit.context import Context
from dsfit.race.peer import Peer, Problem
from dsfit.random import child

T = TypeVar("T")
_FEW = 16
"""Samples of a second first use: compilers take a single one for a case of its own."""


def timed(work: Callable[[], T]) -> tuple[T, float]:
    """What `work` returns and the CPU seconds it took."""
    start = time.process_time()
    result = work()
    return result, time.process_time() - start


def children_seconds() -> float:
    """CPU seconds of processes that were started from here and have ended."""
    try:
        import resource
    except ImportError:  # pragma: no cover (Windows)
        return 0.0
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


@dataclass
class Watch:
    """How much of a core the process got between `start` and `share`, and how busy the machine was."""

    wall: float = 0.0
    cpu: float = 0.0

    def start(self) -> Watch:
        """Begin."""
        self.wall, self.cpu = time.perf_counter(), time.process_time()
        return self

    def record(self) -> dict[str, float | list[float]]:
        """CPU seconds over wall seconds since `start`, and the load averages of 1, 5 and 15 minutes."""
        wall = max(time.perf_counter() - self.wall, 1e-9)
        load = list(os.getloadavg()) if hasattr(os, "getloadavg") else []
        return {"cpu_share": (time.process_time() - self.cpu) / wall, "load": load}


@dataclass(frozen=True)
class Ready:
    """A prepared peer.

    Attributes:
        peer: prepared, and used once.
        seconds: everything done once: preparation, recorded seconds of earlier training, and what a first use costs
            beyond a second one (tables, compilers).
        uniforms: kind of its uniform numbers.
        prepare, recorded, first_use: its parts; compilers count as first use.
    """

    peer: Peer
    seconds: float
    prepare: float
    recorded: float
    first_use: float
    uniforms: str = "random"


def make_ready(peer: Peer, problem: Problem, uses: Sequence[Context], generator: torch.Generator) -> Ready:
    """Prepare the peer and use it once at each batch of contexts `[B]` in `uses`, all by the clock; packages are
    imported before it starts."""
    for name in peer.needs:
        importlib.import_module(name)
    compilers = children_seconds()
    _, prepare = timed(lambda: peer.prepare(problem))

    def use(contexts: Context) -> None:
        with torch.no_grad():
            sampler = peer.at(contexts)
            for samples in (sampler.least, max(sampler.least, _FEW)):
                sampler.estimate(samples, child(generator))

    twice = [[timed(lambda c=contexts: use(c))[1] for _ in range(2)] for contexts in uses]
    first = sum(max(0.0, once - again) for once, again in twice) + children_seconds() - compilers
    recorded = float(peer.recorded_seconds)
    return Ready(peer, prepare + recorded + first, prepare, recorded, first, problem.uniforms)
