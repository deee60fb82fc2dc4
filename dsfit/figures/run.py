"""Makes many experiments, each in a process of its own: one that fails, or is killed, leaves the others alone."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dsfit.experiment.runner import ONE_THREAD, cores
from dsfit.figures.catalogue import Entry
from dsfit.figures.state import write_manifest


@dataclass(frozen=True)
class Made:
    """How an experiment ended: `failure` is empty where it went well."""

    name: str
    failure: str
    computed: bool = False
    drawn: bool = False
    seconds: float = 0.0


def run_all(
    entries: Sequence[Entry],
    out: Path,
    overrides: Sequence[str] = (),
    *,
    workers: int | None = None,
    force: bool = False,
    only_draw: bool = False,
    width_mm: float = 150.0,
    say: Callable[[str, str], None] = lambda name, what: None,
) -> list[Made]:
    """Make the experiments, those that take longest first, and write the manifest; returns how each ended, in the order
    given.

    Args:
        entries: what to make.
        out: directory that it goes to.
        overrides: `key=value` changes of the settings of each.
        workers: how many at once, one thread each; left out, the number of cores.
        force: compute anew.
        only_draw: draw the data that are there.
        width_mm: width of figures.
        say: told the name of an experiment and what it does; called from several threads.
    """
    out.mkdir(parents=True, exist_ok=True)
    order = sorted(entries, key=lambda entry: -entry.experiment.minutes)
    options = {"overrides": list(overrides), "force": force, "only_draw": only_draw, "width_mm": width_mm}
    running: set[subprocess.Popen[str]] = set()
    lock = threading.Lock()
    found: dict[str, Made] = {}
    pool = ThreadPoolExecutor(workers or cores())
    try:
        futures = [pool.submit(_in_process, entry, out, options, running, lock, say) for entry in order]
        for future in as_completed(futures):
            found[future.result().name] = future.result()
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        with lock:
            for process in running:
                process.terminate()
        raise
    finally:
        pool.shutdown()
        write_manifest(out)
    return [found[entry.name] for entry in entries]


def _in_process(
    entry: Entry,
    out: Path,
    options: dict[str, Any],
    running: set[subprocess.Popen[str]],
    lock: threading.Lock,
    say: Callable[[str, str], None],
) -> Made:
    """One experiment in a new process; its last line is what it did, whatever came before goes to the log as well."""
    job = json.dumps({"root": str(entry.root), "name": entry.name, "out": str(out.resolve()), **options})
    environment = {**os.environ, **ONE_THREAD}
    log = out / entry.name / "log.txt"
    log.parent.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "dsfit.figures.worker", job]
    last = ""
    with open(log, "w", encoding="utf-8") as file:
        with lock:
            process = subprocess.Popen(
                command, env=environment, stdout=subprocess.PIPE, stderr=file, text=True, bufsize=1
            )
            running.add(process)
        assert process.stdout is not None
        for line in process.stdout:
            file.write(line)
            last = line.strip()
            say(entry.name, last)
        code = process.wait()
        with lock:
            running.discard(process)
    if code:
        lines = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        reason = lines[-1] if lines else "no word"
        return Made(entry.name, f"exit {code}: {reason} (all of it: {log})")
    return Made(entry.name, "", **json.loads(last))
