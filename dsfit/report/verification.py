"""What `dsfit figures verify` found, from the directory's `verify.json`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dsfit.report.page import Block, Verdict


@dataclass(frozen=True)
class Verification:
    """Empty where nothing was compared."""

    verdict: Verdict | None = None
    experiments: Mapping[str, Any] = field(default_factory=dict)

    @property
    def head(self) -> Sequence[str]:
        """Heads of its columns in the overview."""
        return ["reproduced"] if self.verdict else []

    def words(self, name: str) -> list[str]:
        """An experiment's cells in the overview."""
        return []

    def blocks(self, name: str) -> list[Block]:
        """What there is to say of an experiment."""
        return []


def verification(out: Path) -> Verification:
    """What the directory's `verify.json` says."""
    return Verification()
