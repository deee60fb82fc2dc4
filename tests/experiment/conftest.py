"""A config small enough to run in a second or two."""

from __future__ import annotations

from pathlib import Path

import pytest

TINY = """
title = "tiny"
[contexts]
theta_r_deg = [0, 30]
[[methods]]
name = "uniform"
kind = "uniform"
[[methods]]
name = "mix of two"
kind = "heuristic_mix"
proposals = ["TT", "uniform"]
[estimate]
samples = [16, 64]
repeats = 4
rounds = 2
rtol = 1e-3
[output]
plots = false
"""


@pytest.fixture
def tiny(tmp_path: Path) -> Path:
    """Path of the tiny config; its runs belong in the folder beside it."""
    path = tmp_path / "tiny.toml"
    path.write_text(TINY + f"dir = '{tmp_path / 'runs'}'\n")
    return path
