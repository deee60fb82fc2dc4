"""Runs that are there already, for experiments that read them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from dsfit.experiment.plots.style import styled
from dsfit.experiment.validation import load
from dsfit.figures import Data, Table
from dsfit.figures.catalogue import Entry, find
from dsfit.figures.data import read_data, write_data
from dsfit.figures.page import Page
from dsfit.figures.verify import compare

ROOT = Path(__file__).parents[2]


@dataclass
class Run:
    """What an experiment reads of a run directory."""

    found: dict[str, Any]
    layers: Mapping[int, dict[str, np.ndarray]] = field(default_factory=dict)

    def result(self) -> dict[str, Any]:
        return self.found

    def arrays(self, index: int) -> dict[str, np.ndarray]:
        return self.layers[index]


@dataclass
class Canned:
    """Hands out `runs` by config; the changes must make a config that `dsfit run` takes."""

    runs: Mapping[str, Run]
    root: Path = ROOT
    asked: list[Any] = field(default_factory=list)

    def say(self, what: str) -> None:
        pass

    def run(self, config: str, overrides: tuple[str, ...] = ()) -> Run:
        self.asked.append(load(self.root / "configs" / config, overrides).config)
        return self.runs[config]


def data_of(name: str, work: Canned, folder: Path, changes: tuple[str, ...] = ()) -> Data:
    """Data of an experiment with its own settings, through the files; they agree with themselves."""
    entry = entry_of(name)
    write_data(folder, entry.experiment.compute(entry.settings(changes), work))  # type: ignore[arg-type]
    data = read_data(folder)
    found = compare(data, data, entry.experiment.reproduces)
    assert found["verdict"] == "agrees", found["deviating"]
    return data


def entry_of(name: str) -> Entry:
    return find(ROOT, name)


def drawn(name: str, data: Data) -> tuple[dict[str, Figure], dict[str, Table]]:
    """Figures and tables, drawn and set once."""
    drawing = entry_of(name).drawing
    with styled():
        figures = drawing.figures(data, Page(150.0))
        for figure in figures.values():
            figure.draw_without_rendering()
            assert abs(figure.get_size_inches()[0] * 25.4 - 150) < 1e-6
    tables = {table.name: table for table in drawing.tables(data)}
    for table in tables.values():
        assert table.latex() and table.markdown()
    assert set(getattr(drawing, "captions", lambda data: {})(data)) <= set(figures)
    return figures, tables


def column(table: Table, head: str) -> list[str]:
    """Cells of a column."""
    return [row[list(table.head).index(head)] for row in table.rows]


def check_result(suite: str, findings: list[dict[str, Any]]) -> dict[str, Any]:
    """A run of `dsfit check` with these findings."""
    return {"cells": [{"suite": suite, "findings": findings}], "report": {"verdict": "pass"}}
