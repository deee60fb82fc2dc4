"""`python -m dsfit.figures.worker JOB`: makes one experiment and prints what it does, at last what it did, as JSON.

Lines that begin with `say: ` are for whoever waits; whatever else libraries print is only for the log.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

DONE, SAY = "done: ", "say: "


def main(text: str) -> None:
    """Make the experiment that the job (JSON) names."""
    import torch

    from dsfit.figures.catalogue import find
    from dsfit.figures.make import Look, make

    torch.set_num_threads(1)
    job = json.loads(text)
    entry, look = find(job.pop("root"), job.pop("name")), Look(**job.pop("look"))
    out, overrides = Path(job.pop("out")), job.pop("overrides")
    done = make(entry, out, overrides, say=lambda what: print(f"{SAY}{what}", flush=True), look=look, **job)
    print(DONE + json.dumps(done), flush=True)


if __name__ == "__main__":
    main(sys.argv[1])
