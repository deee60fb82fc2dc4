"""Directions per second and core: dsfit's kernels against Mitsuba 3's `hair` BSDF, and against what the machine can do.

Each number of threads gets a process of its own, bound to as many cores, in which all contenders run in turn. Where
Mitsuba is not installed, the others are measured without it.

What is compared differs: `hair` is one fibre (four lobes in closed form, no scattering among fibres); dsfit evaluates
Marschner's fibre with its roots and caustic, the same lobes widened by scattering, and back scattering, of 8 or 9
components in the mixture that it draws from. Mitsuba takes unit vectors, dsfit angles: "to_angles" is what a
conversion costs. Times are without compiling, which the first run does in seconds; later ones find the code on
disk. They include the wait for the result.
"""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from dsfit.experiment.runner import ONE_THREAD
from dsfit.figures import Close, Data, Experiment, Measured, Settings, Work
from experiments import _throughput_mitsuba as mitsuba
from experiments import _throughput_worker as worker
from experiments._throughput_timing import load


class Throughput(Settings):
    """`counts` are directions per call with one thread, `counts_threads` with more.

    Each set of contenders is timed in turn for `seconds`, or `rounds` rounds; the machine's rates are measured for
    `probe_seconds` each, those of compiled code too if `probe_compiled`; `layouts` are how directions share contexts;
    `parts` times the kernels of some terms.
    """

    threads: list[int] = [1, 2]
    counts: list[int] = [1_000, 10_000, 100_000, 1_000_000]
    counts_threads: list[int] = [100_000, 1_000_000]
    seconds: float = 4.0
    rounds: int = 7
    probe_seconds: float = 0.1
    probe_compiled: bool = True
    layouts: list[str] = ["all different", "16 a context"]
    parts: bool = True


def compute(settings: Throughput, work: Work) -> Data:
    """Measure in one process for each number of threads; there are no more of them than cores."""
    before, choice = load(), mitsuba.choose()
    cores = sorted(os.sched_getaffinity(0))
    work.say(f"Mitsuba: {choice.variant}, {choice.reason}")
    common = {"settings": settings.model_dump(), "choice": dataclasses.asdict(choice)}
    results = []
    for threads in [count for count in settings.threads if count <= len(cores)]:
        job = {"threads": threads, "cores": cores[:threads], **common}
        results.append(in_process(job, work))
    record = {
        "mitsuba": {**dataclasses.asdict(choice), "version": mitsuba.version()},
        "load": {"before": before, "after": load(), "cores": len(cores)},
        "rows": [row for result in results for row in result["rows"]],
        **{key: result[key] for result in results for key in ("machine", "counts", "profile", "backends")
           if key in result},
    }  # fmt: skip
    return Data(record=record)


def in_process(job: dict[str, Any], work: Work) -> dict[str, Any]:
    """The worker's answer to a job, from a new process whose libraries start with the threads they are to have.

    Raises:
        RuntimeError: the process failed; what it said went to standard error.
    """
    path = os.pathsep.join(part for part in (str(work.root), os.environ.get("PYTHONPATH")) if part)
    threads = {name: str(job["threads"]) for name in ONE_THREAD if name.endswith("_THREADS")}
    answer = work.folder / f"threads_{job['threads']}.json"
    answer.unlink(missing_ok=True)
    command = [sys.executable, "-m", worker.__name__, json.dumps(job), str(answer)]
    environment = {**os.environ, **threads, "PYTHONPATH": path}
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True, cwd=work.root) as process:
        assert process.stdout is not None
        for line in process.stdout:
            work.say(line.strip())
    if process.returncode:
        raise RuntimeError(f"measuring with {job['threads']} threads ended with {process.returncode}")
    return json.loads(Path(answer).read_text())


EXPERIMENT = Experiment(
    title="Throughput of the kernels",
    shows="Directions per second and core: dsfit's kernels against Mitsuba 3's hair and the machine's limits.",
    settings=Throughput,
    compute=compute,
    minutes=1.4,
    reproduces={
        "counts.*": Close(1e-3),  # of operations; some depend on what is drawn
        "*": Measured(),
    },
    small=(
        "threads=[1]",
        "counts=[1000, 10000]",
        "seconds=0.3",
        "rounds=3",
        "probe_seconds=0.02",
        "probe_compiled=false",
        'layouts=["all different"]',
        "parts=false",
    ),
)
