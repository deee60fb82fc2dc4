"""Folders with small experiments that are made in a moment."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

EXPERIMENT = '''
"""A toy."""
from __future__ import annotations
import numpy as np
from dsfit.figures import Close, Data, Estimate, Experiment, Measured, Settings, Work

class Toy(Settings):
    scale: float = 2.0

def compute(settings: Toy, work: Work) -> Data:
    """Powers."""
    work.say("computing")
    with open(work.folder / "calls.txt", "a") as file:
        file.write("x")
    BODY
    x = np.linspace(0, 1, 9)
    record = {"words": ["a", "b"], "mean": 1.0, "mean_error": 0.1, "seconds": 0.5}
    return Data({"x": x, "y": settings.scale * x**2}, record)

EXPERIMENT = Experiment(
    title="Toy of 100 %", shows="x against y_x, θ_r & more.", settings=Toy, compute=compute, minutes=0.1,
    reproduces={"y": Close(1e-6), "mean": Estimate("mean_error"), "seconds": Measured()}, small=("scale=3.0",),
)
'''

DRAWING = '''
"""Draws a toy."""
from __future__ import annotations
from dsfit.figures import Data, Table
from dsfit.figures.page import Page

def figures(data, page):
    figure = page.figure(0.5)
    left, right = figure.subplots(1, 2)
    left.plot(data.arrays["x"], data.arrays["y"], label="y_x, θ / °")
    left.legend()
    figure.colorbar(right.imshow(data.arrays["y"].reshape(3, 3)), ax=right, label="50 %")
    BODY
    return {"curve": figure}

def tables(data):
    return [Table("values", "Values of y_x & more.", ["x", "y / %"], [["a_b", f"{y:.3f}"] for y in data.arrays["y"]])]
'''

Add = Callable[..., Path]


@pytest.fixture
def add(tmp_path: Path) -> Iterator[Add]:
    """Puts an experiment into a folder of this test, with lines of its own in `compute` and `figures`; returns the
    folder. What was imported from there is forgotten at the end."""
    root = tmp_path / "root"
    path, modules = list(sys.path), set(sys.modules)

    def add(name: str, compute: str = "", draw: str = "") -> Path:
        for folder, text, body in (
            ("experiments", EXPERIMENT, compute),
            ("experiments/drawing", DRAWING, draw),
            ("configs/figures", "scale = 2.0  # factor\n", ""),
        ):
            suffix = "toml" if folder.startswith("configs") else "py"
            (root / folder).mkdir(parents=True, exist_ok=True)
            (root / folder / f"{name}.{suffix}").write_text(text.replace("BODY", body).lstrip())
        return root

    yield add
    sys.path[:] = path
    for name in set(sys.modules) - modules:
        if name.startswith("experiments"):
            del sys.modules[name]
