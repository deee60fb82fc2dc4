"""What an experiment declares, and what it is handed to work with."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dsfit.errors import InputError
from dsfit.experiment.sections import Section
from dsfit.figures.data import Data
from dsfit.figures.rules import Rule

if TYPE_CHECKING:
    from dsfit.experiment.rundir import RunDirectory


@dataclass
class Used:
    """Files by their hashes, and configs with their changes and run ids."""

    files: dict[str, str] = field(default_factory=dict)
    runs: list[tuple[str, list[str], str]] = field(default_factory=list)

    def is_unchanged(self, root: Path) -> bool:
        """Whether files are what they were, and configs would run what they ran."""
        from dsfit.experiment.provenance import run_id
        from dsfit.experiment.validation import load

        try:
            return all(
                hashlib.sha256((root / path).read_bytes()).hexdigest() == found for path, found in self.files.items()
            ) and all(
                run_id(load(root / "configs" / config, tuple(changes)).config) == found
                for config, changes, found in self.runs
            )
        except (InputError, OSError):
            return False


@dataclass(frozen=True)
class Work:
    """Where and for whom an experiment computes.

    Attributes:
        folder: its own folder for whatever it keeps besides its data (runs, images); what an interrupted attempt left
            is still there.
        root: the folder that holds `configs` and `experiments`.
        say: tells what goes on.
        used: what was read besides the settings, filled by `run` and `file`: if any of it changes, the data are out of
            date.
    """

    folder: Path
    root: Path
    say: Callable[[str], None]
    used: Used = field(default_factory=Used)

    def file(self, path: str) -> Path:
        """A file below the root that the experiment reads, such as a measured map.

        Raises:
            InputError: there is none.
        """
        found = self.root / path
        if not found.is_file():
            raise InputError(path, "no such file", f"a file below {self.root}")
        self.used.files[path] = hashlib.sha256(found.read_bytes()).hexdigest()
        return found

    def run(self, config: str, overrides: tuple[str, ...] = ()) -> RunDirectory:
        """Run `configs/CONFIG` as `dsfit run` does, in this process and on one thread; cells of an earlier attempt are
        taken over.

        Raises:
            ConfigError: the config is wrong.
            RunFailure: cells failed.
        """
        from dsfit.experiment import runner
        from dsfit.experiment.provenance import run_id
        from dsfit.experiment.validation import load

        experiment = load(self.root / "configs" / config, overrides)
        self.used.runs.append((config, list(overrides), run_id(experiment.config)))
        return runner.run(experiment, self.folder / "runs", workers=0, progress=_Say(self.say)).directory


class _Say:
    """A runner's progress in words."""

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say, self._total, self._done = say, 0, 0

    def start(self, total: int, done: int) -> None:
        """`done` of `total` cells were there already."""
        self._total, self._done = total, done

    def step(self, index: int, what: str) -> None:
        """Nothing: cells are told of when they are written."""

    def finish(self, index: int) -> None:
        """One more."""
        self._done += 1
        self._say(f"{self._done} of {self._total} cells")


@dataclass(frozen=True)
class Experiment:
    """One figure or table, or several of the same data.

    Attributes:
        title: heading in reports.
        shows: what one sees, in a sentence or two.
        settings: type of the table in `configs/figures/NAME.toml`.
        compute: data from settings.
        reproduces: how values of two runs must agree, by glob patterns of their names (`Data.values`); the first
            pattern that fits counts. What no pattern fits must be equal.
        minutes: what it takes on one core, roughly.
        needs: packages outside dsfit's own dependencies, by their import names.
        small: `key=value` changes of the settings for a trial of seconds, whose numbers mean nothing.
    """

    title: str
    shows: str
    settings: type[Section]
    compute: Callable[[Any, Work], Data]
    minutes: float
    reproduces: Mapping[str, Rule] = field(default_factory=dict)
    needs: tuple[str, ...] = ()
    small: tuple[str, ...] = ()
