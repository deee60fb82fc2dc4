"""Many experiments at once: failures, kills, interruptions, and two runs in the same place."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from dsfit.figures.catalogue import find
from dsfit.figures.make import make
from dsfit.figures.manifest import check_manifest
from dsfit.figures.run import Job, run_all


def manifest(out: Path) -> dict:
    return json.loads((out / "manifest.json").read_text())["experiments"]


def test_failures_and_kills_are_told_and_leave_the_others_alone(add, tmp_path: Path):
    root = add("toy_good")
    add("toy_fails", compute="raise RuntimeError('planted failure')")
    add("toy_killed", compute="import os; os.kill(os.getpid(), 9)")
    add("toy_undrawn", draw="raise ValueError('planted in the drawing')")
    entries = [find(root, name) for name in ("toy_fails", "toy_killed", "toy_undrawn", "toy_good")]
    made = {one.name: one for one in run_all(entries, Job(tmp_path), workers=2)}
    assert list(made) == [entry.name for entry in entries]
    assert "planted failure" in made["toy_fails"].failure and "exit 1" in made["toy_fails"].failure
    assert "SIGKILL" in made["toy_killed"].failure
    assert "planted in the drawing" in made["toy_undrawn"].failure
    assert made["toy_good"].failure == "" and made["toy_good"].computed
    found = manifest(tmp_path)
    assert {name: one["state"] for name, one in found.items()} == {
        "toy_good": "complete", "toy_fails": "not computed", "toy_killed": "not computed", "toy_undrawn": "not drawn",
    }  # fmt: skip
    assert "SIGKILL" in found["toy_killed"]["failure"] and found["toy_good"]["failure"] is None
    assert "planted failure" in (tmp_path / "toy_fails/log.txt").read_text()
    assert (
        "toy_good" in (tmp_path / "thesis.tex").read_text() and "toy_fails" not in (tmp_path / "thesis.tex").read_text()
    )
    assert check_manifest(tmp_path)[1] == []

    # mended, it goes on from where it was: what was computed is only drawn
    add("toy_undrawn")
    again = run_all([find(root, "toy_undrawn"), find(root, "toy_good")], Job(tmp_path), workers=1)
    assert [(one.failure, one.computed, one.drawn) for one in again] == [("", False, True), ("", False, False)]
    assert manifest(tmp_path)["toy_undrawn"]["state"] == "complete"
    assert manifest(tmp_path)["toy_undrawn"]["failure"] is None


def test_what_is_up_to_date_takes_no_process(add, tmp_path: Path, monkeypatch):
    entry = find(add("toy_i"), "toy_i")
    make(entry, tmp_path, say=lambda what: None)

    def refuse(*args, **kwargs):
        raise AssertionError("a process was started")

    monkeypatch.setattr(subprocess, "Popen", refuse)
    assert not run_all([entry], Job(tmp_path))[0].failure


def test_two_runs_at_once_make_it_once(add, tmp_path: Path):
    entry = find(add("toy_j", compute="import time; time.sleep(1.0)"), "toy_j")
    said: list[str] = []
    made = []

    def go() -> None:
        made.extend(run_all([entry], Job(tmp_path, say=lambda name, what: said.append(what)), workers=1))

    threads = [threading.Thread(target=go) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(one.computed for one in made) == [False, True] and not any(one.failure for one in made)
    assert (tmp_path / "toy_j/files/calls.txt").read_text() == "x"
    assert any("another run" in what for what in said)
    assert check_manifest(tmp_path)[1] == []


def start(root: Path, out: Path, *names: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "dsfit.cli", "figures", "run", *names, "--root", str(root), "--out", str(out)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def wait_for(path: Path, process: subprocess.Popen[str], seconds: float = 120.0) -> str:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if path.exists() and path.read_text():
            return path.read_text()
        assert process.poll() is None, process.communicate()[0]
        time.sleep(0.05)
    raise AssertionError(f"{path} did not come")


def is_alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


SLEEP = """
    import os, subprocess, sys, time
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(300)"])
    if not (work.folder / "again").exists():
        (work.folder / "again").write_text(f"{os.getpid()} {child.pid}")
        time.sleep(300)
    child.kill()
"""


@pytest.mark.parametrize("how", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)])
def test_an_interrupted_run_stops_its_workers_and_goes_on_later(add, tmp_path: Path, how: signal.Signals):
    root, out = add("toy_sleeps", compute=SLEEP), tmp_path / "out"
    process = start(root, out, "toy_sleeps")
    pids = [int(x) for x in wait_for(out / "toy_sleeps/files/again", process).split()]
    process.send_signal(how)
    said = process.communicate(timeout=60)[0]
    assert process.returncode == 130 and "interrupted" in said
    end = time.monotonic() + 20
    while any(map(is_alive, pids)) and time.monotonic() < end:
        time.sleep(0.05)
    assert not any(map(is_alive, pids))
    assert not (out / "toy_sleeps/data.json").exists() and manifest_is_there(out)
    made = run_all([find(root, "toy_sleeps")], Job(out), workers=1)
    assert made[0].computed and not made[0].failure


def manifest_is_there(out: Path) -> bool:
    return (out / "manifest.json").is_file() and check_manifest(out)[1] == []


@pytest.mark.slow
def test_a_killed_run_holds_its_place_until_its_worker_is_gone(add, tmp_path: Path):
    root, out = add("toy_k", compute=SLEEP), tmp_path / "out"
    process = start(root, out, "toy_k")
    worker, child = (int(x) for x in wait_for(out / "toy_k/files/again", process).split())
    process.kill()
    process.communicate()
    said = threading.Event()
    made = []
    job = Job(out, say=lambda name, what: said.set() if "another run" in what else None)
    thread = threading.Thread(target=lambda: made.extend(run_all([find(root, "toy_k")], job, workers=1)))
    thread.start()
    assert said.wait(60)
    for pid in (worker, child):
        os.kill(pid, signal.SIGKILL)
    thread.join(120)
    assert made[0].computed and not made[0].failure
