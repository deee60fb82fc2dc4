"""Experiments by name: computed, drawn, tabulated, listed with their hashes and compared with stored reference data.

An experiment is a module of the folder `experiments`: `experiments/NAME.py` says what is computed (`EXPERIMENT`),
`experiments/drawing/NAME.py` what is drawn from the stored data (`figures`) and tabulated (`tables`), and
`configs/figures/NAME.toml` holds its settings. `dsfit figures run` makes them all.
"""

from __future__ import annotations

import importlib
from typing import Any

_PUBLIC = {
    "Close": "dsfit.figures.rules",
    "Data": "dsfit.figures.data",
    "Estimate": "dsfit.figures.rules",
    "Exact": "dsfit.figures.rules",
    "Experiment": "dsfit.figures.experiment",
    "Measured": "dsfit.figures.rules",
    "Rule": "dsfit.figures.rules",
    "Settings": "dsfit.experiment.sections",
    "Table": "dsfit.figures.table",
    "Work": "dsfit.figures.experiment",
    "read_about": "dsfit.experiment.about",
}

__all__ = sorted(_PUBLIC)


def __getattr__(name: str) -> Any:
    """Names are loaded when first used: the command line imports this package at every start."""
    if name not in _PUBLIC:
        raise AttributeError(f"module 'dsfit.figures' has no attribute {name!r}")
    return getattr(importlib.import_module(_PUBLIC[name]), "Section" if name == "Settings" else name)
