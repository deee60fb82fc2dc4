"""Examples in docstrings run, and every public name has one."""

from __future__ import annotations

import doctest
import importlib
import inspect
import sys
from pathlib import Path

import pytest

import dsfit

PACKAGE = Path(dsfit.__file__).parent
FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
WITHOUT = {
    "Amortised": "what amortise returns",
    "Fit": "what fit returns",
    "HeldOut": "what held_out returns",
    "HairKernel": "its tables take several seconds",
    "amortise": "trains for seconds at least",
    "train_family": "trains for minutes",
}
"""Public names without an example, and why."""


def modules() -> list[str]:
    """Modules of dsfit whose source holds an example."""
    found = []
    for path in sorted(PACKAGE.rglob("*.py")):
        if ">>> " in path.read_text(encoding="utf-8"):
            parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
            found.append(".".join(parts[:-1] if parts[-1] == "__init__" else parts))
    return found


@pytest.mark.parametrize("name", modules())
def test_examples_of_a_module(name: str) -> None:
    importlib.import_module(name)
    module = sys.modules[name]
    runner = doctest.DocTestRunner(optionflags=FLAGS, verbose=False)
    cases = [case for case in doctest.DocTestFinder(exclude_empty=True).find(module, name) if case.examples]
    assert cases, "an example that doctest does not find"
    told: list[str] = []
    for case in cases:
        runner.run(case, out=told.append, clear_globs=True)
    assert not runner.summarize(verbose=False).failed, "".join(told)


def test_every_public_name_has_an_example() -> None:
    missing = {name for name in dsfit.__all__ if ">>> " not in (inspect.getdoc(_documented(name)) or "")}
    assert missing == set(WITHOUT)


def _documented(name: str) -> object:
    value = getattr(dsfit, name)
    return getattr(value, name) if inspect.ismodule(value) else value
