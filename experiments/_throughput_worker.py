"""Measures all contenders in this process: `python -m experiments._throughput_worker JOB FILE`, both as
`experiments/throughput.py` makes them."""

from __future__ import annotations

import dataclasses
import json
import os
import sys
from pathlib import Path
from typing import Any

from experiments._throughput_timing import load, measure


def work(job: dict[str, Any]) -> dict[str, Any]:
    """All contenders with this number of threads; with one thread also the machine's limits and the kernel's counts."""
    os.sched_setaffinity(0, job["cores"])
    import torch

    import experiments._throughput_dsfit as ours
    import experiments._throughput_mitsuba as theirs

    threads, settings = job["threads"], job["settings"]
    torch.set_num_threads(threads)
    choice = theirs.Choice(**job["choice"])
    mi = None if choice.variant is None else theirs.start(choice, threads)
    single = threads == 1
    library = ours.Library(("eager", "compiled") if single else ("compiled",), parts=single and settings["parts"])
    rows = []
    # Every shape and number of threads is compiled anew: two threads do with one layout.
    layouts = settings["layouts"] if single else settings["layouts"][:1]
    for count in settings["counts" if single else "counts_threads"]:
        for layout in layouts:
            contenders = library.contenders(count, layout)
            if mi is not None and layout == "all different":
                contenders = theirs.contenders(mi, count) + contenders
            before = load()
            found = measure(contenders, seconds=settings["seconds"], least=settings["rounds"])
            rows += [{**row, "threads": threads, "load": before} for row in found]
            print(f"{threads} threads, {count} directions, {layout}: load {before:.1f}", flush=True)
    result: dict[str, Any] = {"rows": rows}
    return result | (_limits(library, settings) if single else {})


def _limits(library: Any, settings: dict[str, Any]) -> dict[str, Any]:
    import experiments._throughput_limits as limits
    from dsfit.race.machine import probe

    return {
        "machine": dataclasses.asdict(probe(settings["probe_seconds"], compiled=settings["probe_compiled"])),
        "counts": limits.counts(library),
        "profile": limits.profiles(library),
        "backends": {name: str(kernel.backend) for name, kernel in library.kernels.items()},
    }


if __name__ == "__main__":
    Path(sys.argv[2]).write_text(json.dumps(work(json.loads(sys.argv[1]))))
