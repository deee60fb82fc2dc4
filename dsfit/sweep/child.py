"""The process that computes cells, one after another: `python -m dsfit.sweep.child`, started by `slot`.

Requests come pickled on standard input: (base or None for the last one's, task); answers go to standard output. It ends
with its keeper, and after some idle time.
"""

from __future__ import annotations

import os
import pickle
import signal
import sys
import threading
import time

IDLE_SECONDS = 300.0


def main() -> None:
    """Answer requests until there are no more."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the keeper's business
    requests = os.fdopen(os.dup(0), "rb")
    answers = os.fdopen(os.dup(1), "wb")
    # whatever the cells print or read is kept off the two pipes
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.dup2(2, 1)
    clock = _Clock()
    threading.Thread(target=_watch, args=(os.getppid(), clock), daemon=True).start()

    import torch

    from dsfit.sweep.compute import compute

    torch.set_num_threads(1)
    base = None
    answer: object = "ready"
    while True:
        pickle.dump(answer, answers)
        answers.flush()
        clock.idle_since = time.monotonic()
        try:
            new_base, task = pickle.load(requests)
        except EOFError:
            return
        clock.idle_since = None
        base = new_base or base
        answer = compute(base, task)


class _Clock:
    idle_since: float | None = None


def _watch(keeper: int, clock: _Clock) -> None:
    """End with the keeper, however it ended, even in the middle of a cell."""
    while os.getppid() == keeper:
        time.sleep(1.0)
        if clock.idle_since is not None and time.monotonic() - clock.idle_since > IDLE_SECONDS:
            break
    os._exit(0)


if __name__ == "__main__":
    sys.exit(main())
