"""Finds experiments and their drawings, and reads their settings."""

from __future__ import annotations

import ast
import hashlib
import importlib
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from pydantic import ValidationError

from dsfit.errors import InputError
from dsfit.experiment.provenance import sources_hash
from dsfit.experiment.reader import did_you_mean, read
from dsfit.experiment.sections import Section
from dsfit.figures.experiment import Experiment

FOLDER = "experiments"


@dataclass(frozen=True)
class Entry:
    """An experiment with its name and its place."""

    name: str
    root: Path
    experiment: Experiment

    @property
    def config(self) -> Path:
        """Its settings."""
        return self.root / "configs" / "figures" / f"{self.name}.toml"

    @property
    def drawing(self) -> ModuleType:
        """The module with `figures(data, page)` and `tables(data)`."""
        return importlib.import_module(f"{FOLDER}.drawing.{self.name}")

    def settings(self, overrides: Sequence[str] = ()) -> Section:
        """Its settings, with `key=value` changes.

        Raises:
            ConfigError: the file or a change is wrong.
        """
        raw = read(self.config, overrides)
        try:
            return self.experiment.settings.model_validate(raw.data)
        except ValidationError as error:
            detail = error.errors(include_url=False)[0]
            raise raw.error(detail["loc"], detail["msg"]) from None

    def numbers_version(self) -> str:
        """Hash of all code that decides the numbers: dsfit without what only shows them, and the experiment's module
        with those of the folder that it imports, without comments and what is only told (title, rules, minutes)."""
        return _digest(sources_hash(numbers=True), self.root, f"{FOLDER}.{self.name}")

    def drawing_version(self) -> str:
        """Hash of all code that decides figures and tables."""
        return _digest(sources_hash(), self.root, f"{FOLDER}.drawing.{self.name}")

    def description(self) -> dict[str, Any]:
        """What is told of it, as plain data; `reproduces` in words, by pattern."""
        experiment = self.experiment
        return {
            "title": experiment.title,
            "shows": experiment.shows,
            "minutes": experiment.minutes,
            "reproduces": {pattern: str(rule) for pattern, rule in experiment.reproduces.items()},
        }


class BrokenExperiment(RuntimeError):
    """An experiment whose module cannot be imported, or does not define what it must."""


def names(root: Path) -> list[str]:
    """Names of all experiments below `root`, sorted."""
    return sorted(p.stem for p in (root / FOLDER / "drawing").glob("*.py") if not p.stem.startswith("_"))


def find(root: str | Path, name: str) -> Entry:
    """The experiment of this name.

    Raises:
        InputError: there is none.
        BrokenExperiment: it cannot be imported.
    """
    root = Path(root).resolve()
    known = names(root)
    if name not in known:
        raise InputError("experiment", name, ", ".join(known) + did_you_mean(name, known))
    if str(root) not in sys.path:
        sys.path.insert(0, str(root))
    try:
        experiment = importlib.import_module(f"{FOLDER}.{name}").EXPERIMENT
    except Exception as error:  # whatever a module does when it is imported
        raise BrokenExperiment(f"{FOLDER}/{name}.py: {type(error).__name__}: {error}") from error
    if not isinstance(experiment, Experiment):
        raise BrokenExperiment(f"{FOLDER}/{name}.py: EXPERIMENT is no dsfit.figures.Experiment")
    return Entry(name, root, experiment)


def _digest(base: str, root: Path, module: str) -> str:
    digest = hashlib.sha256(base.encode())
    for path in sorted(_closure(root, module, {})):
        digest.update(path.relative_to(root).as_posix().encode() + b"\0" + _code(path).encode() + b"\0")
    return digest.hexdigest()[:12]


_TOLD = ("title", "shows", "minutes", "reproduces", "needs", "small")


def _code(path: Path) -> str:
    """A module without comments, docstrings and what an experiment only tells of itself."""
    tree = ast.parse(path.read_bytes())
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list) and body and _is_docstring(body[0]):
            body[0] = ast.Pass()
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "Experiment":
            node.keywords = [keyword for keyword in node.keywords if keyword.arg not in _TOLD]
    return ast.unparse(tree)


def _is_docstring(node: ast.AST) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def _closure(root: Path, module: str, seen: dict[Path, None]) -> dict[Path, None]:
    """Files of a module of the folder and of those that it imports, wherever the import stands."""
    path = root / (module.replace(".", "/") + ".py")
    if path in seen or not path.is_file():
        return seen
    seen[path] = None
    for node in ast.walk(ast.parse(path.read_bytes())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == FOLDER:
            imported = [str(node.module), *(f"{node.module}.{alias.name}" for alias in node.names)]
        elif isinstance(node, ast.Import):
            imported = [alias.name for alias in node.names if alias.name.split(".")[0] == FOLDER]
        else:
            continue
        for name in imported:
            _closure(root, name, seen)
    return seen
