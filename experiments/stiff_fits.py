"""Solvers on fits that start badly or have no single answer."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from dsfit.checks.stiff_fits.compare import compare
from dsfit.experiment.files import number
from dsfit.figures import Close, Data, Experiment, Measured, Settings, Work
from experiments._check_runs import findings, names

DECADES = 6.0
"""What is left of the way is told down to so many decades."""


class StiffFits(Settings):
    """`problems` and `solvers` by name, all if a list is empty; `seconds` is the time that a solver is told it has
    (most are stopped by their steps before)."""

    problems: list[str]
    solvers: list[str]
    seconds: float


def compute(settings: StiffFits, work: Work) -> Data:
    """Every solver on every problem.

    Arrays `[problems, solvers]`: `left`, the log10 of what is left of the way from the start to the best known value
    (-6 at least; nan where a solver was not tried), `converged` (claimed), and `faults`, the number of false claims.
    """
    overrides = (
        f"check.stiff_fits.problems={names(settings.problems)}",
        f"check.stiff_fits.solvers={names(settings.solvers)}",
        f"check.stiff_fits.seconds={settings.seconds}",
    )
    found = findings(work.run("stiff_fits.toml", overrides), "stiff_fits")
    tried = [f for f in found if "solver" in f["data"] and not f["data"]["refused"]]
    problems, solvers = (list(dict.fromkeys(f[key] for f in tried)) for key in ("case", "subject"))
    shape = (len(problems), len(solvers))
    arrays = {"left": np.full(shape, math.nan), "converged": np.zeros(shape, bool), "faults": np.zeros(shape, np.int64)}
    for finding in tried:
        at = problems.index(finding["case"]), solvers.index(finding["subject"])
        arrays["left"][at] = _left(finding["data"])
        arrays["converged"][at] = finding["data"]["converged"]
        arrays["faults"][at] = int(number(finding["value"]))
    rows = {
        row.solver: {
            "problems": row.problems,
            "solved": row.solved,
            "converged": row.converged,
            "faulty": row.faulty,
            "evaluations": row.evaluations,
            "seconds": row.seconds,
        }
        for row in compare(found)
    }
    return Data(arrays, {"problems": problems, "solvers": solvers, "rows": rows})


def _left(data: dict[str, Any]) -> float:
    start, best, optimum = (number(data[key]) for key in ("start", "objective", "optimum"))
    if not math.isfinite(start):
        return 0.0 if not math.isfinite(best) else -DECADES
    share = (best - optimum) / (start - optimum) if start > optimum else 0.0
    return max(math.log10(share), -DECADES) if share > 0 else -DECADES


EXPERIMENT = Experiment(
    title="Solvers on badly posed fits",
    shows="How much of the way to the best value each solver goes from bad starts, and that none says what is false.",
    settings=StiffFits,
    compute=compute,
    minutes=2.0,
    reproduces={
        # The paths of badly posed fits amplify rounding. Held are the shares of problems, and, exactly, that there is
        # no false claim (`faults`).
        "left": Measured(),
        "converged": Measured(),
        "rows.*.solved": Close(0.0, 0.15),
        "rows.*.converged": Close(0.0, 0.15),
        "rows.*.evaluations": Close(1.0),
        "rows.*.seconds": Measured(),
    },
    small=('problems=["rosenbrock_scaled"]', 'solvers=["optimistix.lm", "torch.lbfgs"]'),
)
