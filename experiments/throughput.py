"""Directions per second and core: dsfit's kernels against Mitsuba 3's `hair` BSDF, and against what the machine can do.

    python experiments/throughput.py --out DIR [--quick]     (measures: three minutes, and compiling)
    python experiments/throughput.py --plot DIR              (figure and table of what was measured)

Each number of threads gets a process of its own, bound to as many cores, in which all contenders run in turn. Writes
throughput.json, throughput.png, throughput.pdf and throughput.md.

What is compared differs: `hair` is one fibre (four lobes in closed form, no scattering among fibres); dsfit evaluates
Marschner's fibre with its roots and caustic, the same lobes widened by scattering, and back scattering, of 8 or 9
components in the mixture that it draws from. Mitsuba takes unit vectors, dsfit angles: "to_angles" is what a
conversion costs. Times are without compiling, which the first run does in seconds; later ones find the code on
disk. They include the wait for the result.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from _throughput_timing import load, measure

COUNTS = (1_000, 10_000, 100_000, 1_000_000)
QUICK_COUNTS = (1_000, 10_000)
NAME = "throughput.json"


def compute(folder: Path, quick: bool) -> dict[str, Any]:
    """Measure in one process for each number of threads; also writes the data to `folder`."""
    import _throughput_mitsuba as mitsuba

    from dsfit.experiment.files import write_json
    from dsfit.experiment.provenance import provenance

    start, before = time.perf_counter(), load()
    choice = mitsuba.choose()
    cores = sorted(os.sched_getaffinity(0))
    results = []
    for threads in (1,) if quick else (1, 2)[: len(cores)]:
        job = {"threads": threads, "cores": cores[:threads], "quick": quick, "choice": dataclasses.asdict(choice)}
        results.append(_in_process(job))
    data = {
        "provenance": provenance(),
        "mitsuba": {**dataclasses.asdict(choice), "version": mitsuba.version()},
        "load": {"before": before, "after": load(), "cores": len(cores)},
        "seconds": time.perf_counter() - start,
        "quick": quick,
        "rows": [row for result in results for row in result["rows"]],
        **{key: results[0][key] for key in ("machine", "counts", "profile", "backends")},
    }
    write_json(folder / NAME, data)
    return data


def _in_process(job: dict[str, Any]) -> dict[str, Any]:
    """`work(job)` in a new process, whose libraries start with the threads they are to have."""
    threads = str(job["threads"])
    environment = {**os.environ, "OMP_NUM_THREADS": threads, "MKL_NUM_THREADS": threads}
    command = [sys.executable, str(Path(__file__).resolve()), "--job", json.dumps(job)]
    done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def work(job: dict[str, Any]) -> dict[str, Any]:
    """All contenders with this number of threads; with one thread also the machine's limits and the kernel's counts."""
    os.sched_setaffinity(0, job["cores"])
    import _throughput_dsfit as ours
    import _throughput_mitsuba as theirs
    import torch

    threads, quick = job["threads"], job["quick"]
    torch.set_num_threads(threads)
    choice = theirs.Choice(**job["choice"])
    mi = None if choice.variant is None else theirs.start(choice, threads)
    single = threads == 1
    library = ours.Library(("eager", "compiled") if single else ("compiled",), parts=single and not quick)
    rows = []
    # Every shape and number of threads is compiled anew: two threads and quick runs do with one.
    layouts = list(ours.LAYOUTS)[: 2 if single and not quick else 1]
    for count in QUICK_COUNTS if quick else COUNTS if single else COUNTS[2:]:
        for layout in layouts:
            contenders = library.contenders(count, layout)
            if mi is not None and layout == "all different":
                contenders = theirs.contenders(mi, count) + contenders
            before = load()
            found = measure(contenders, seconds=0.3 if quick else 4.0, least=3 if quick else 7)
            rows += [{**row, "threads": threads, "load": before} for row in found]
            print(f"{threads} threads, {count} directions, {layout}: load {before:.1f}", file=sys.stderr)
    result: dict[str, Any] = {"rows": rows}
    if single:
        result |= _limits(library, quick)
    return result


def _limits(library: Any, quick: bool) -> dict[str, Any]:
    import _throughput_limits as limits

    from dsfit.race.machine import probe

    return {
        "machine": dataclasses.asdict(probe(0.02 if quick else 0.1, compiled=not quick)),
        "counts": limits.counts(library),
        "profile": limits.profiles(library),
        "backends": {name: str(kernel.backend) for name, kernel in library.kernels.items()},
    }


def main(arguments: list[str] | None = None) -> None:
    """Command line; see the module text."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, help="measure, and write data, figure and table to this folder")
    parser.add_argument("--plot", type=Path, help="figure and table of the data in this folder")
    parser.add_argument("--quick", action="store_true", help="few directions, few rounds")
    parser.add_argument("--job", help=argparse.SUPPRESS)
    given = parser.parse_args(arguments)
    if given.job is not None:
        print(json.dumps(work(json.loads(given.job))))
        return
    folder = given.out or given.plot
    if folder is None:
        parser.error("--out or --plot is needed")
    if given.out is not None:
        compute(folder, given.quick)
    from _throughput_report import figure, table

    data = json.loads((folder / NAME).read_text())
    (folder / "throughput.md").write_text(table(data))
    figure(data, folder)
    print((folder / "throughput.md").read_text())


if __name__ == "__main__":
    main()
