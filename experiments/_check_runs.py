"""Findings of a run of `dsfit check`, as the experiments about checks read them."""

from __future__ import annotations

from typing import Any

from dsfit.experiment.rundir import RunDirectory


def findings(directory: RunDirectory, suite: str) -> list[dict[str, Any]]:
    """All findings of a suite, in the order of its cells."""
    cells = directory.result()["cells"]
    return [finding for cell in cells if cell["suite"] == suite for finding in cell["findings"]]


def names(chosen: list[str]) -> str:
    """A list of names as the value of an override; an empty list stands for all."""
    return '"all"' if not chosen else "[" + ", ".join(f'"{name}"' for name in chosen) + "]"
