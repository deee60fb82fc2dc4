"""Experiments by name: computed, drawn, tabulated, listed with their hashes and compared with stored reference data.

An experiment is a module of the folder `experiments`: `experiments/NAME.py` says what is computed (`EXPERIMENT`),
`experiments/drawing/NAME.py` what is drawn from the stored data (`figures`) and tabulated (`tables`), and
`configs/figures/NAME.toml` holds its settings. `dsfit figures run` makes them all.
"""

from __future__ import annotations

from dsfit.experiment.about import read_about
from dsfit.experiment.sections import Section as Settings
from dsfit.figures.data import Data
from dsfit.figures.experiment import Experiment, Work
from dsfit.figures.rules import Close, Estimate, Exact, Measured, Rule
from dsfit.figures.table import Table

__all__ = [
    "Close",
    "Data",
    "Estimate",
    "Exact",
    "Experiment",
    "Measured",
    "Rule",
    "Settings",
    "Table",
    "Work",
    "read_about",
]
