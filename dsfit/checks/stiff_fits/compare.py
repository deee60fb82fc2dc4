"""The solvers side by side: which share of the problems each of them solves, how truthful it is, and how long it
takes."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Row:
    """One solver over all problems that it was tried on.

    Attributes:
        problems: (problem, objective) pairs tried; `solved`, `converged`, `faulty`: shares of them.
        evaluations, seconds: medians over those that were solved by it (all, if none was).
    """

    solver: str
    problems: int
    solved: float
    converged: float
    faulty: float
    evaluations: float
    seconds: float


def compare(findings: Iterable[Mapping[str, Any]]) -> list[Row]:
    """Rows per solver, best first, from findings of `run` as plain data."""
    by_solver: dict[str, list[dict[str, Any]]] = {}
    for finding in findings:
        data = finding["data"]
        if "solver" in data and not data["refused"]:
            by_solver.setdefault(data["solver"], []).append({**data, "faults": finding["value"]})
    rows = []
    for solver, tried in by_solver.items():
        solved = [one for one in tried if one["solved"]]
        rows.append(
            Row(
                solver,
                len(tried),
                len(solved) / len(tried),
                sum(one["converged"] for one in tried) / len(tried),
                sum(one["faults"] > 0 for one in tried) / len(tried),
                statistics.median(one["evaluations"] for one in solved or tried),
                statistics.median(one["seconds"] for one in solved or tried),
            )
        )
    return sorted(rows, key=lambda row: (-row.solved, row.seconds))
