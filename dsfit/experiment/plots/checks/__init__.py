"""Figures of `dsfit check`: one module per suite that has any, each with `figures(directory, result)`."""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Iterator
from typing import Any

from matplotlib.figure import Figure

from dsfit.experiment.rundir import RunDirectory


def checks(directory: RunDirectory, result: dict[str, Any]) -> Iterator[tuple[str, Figure]]:
    """Figures of every suite of the run that draws any."""
    for suite in dict.fromkeys(cell["suite"] for cell in result["cells"]):
        name = f"{__name__}.{suite}"
        if importlib.util.find_spec(name) is not None:
            yield from importlib.import_module(name).figures(directory, result)
