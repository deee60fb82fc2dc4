"""What a negative control is: a wrong equation of the chapter, its correction, and one check that both go through."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import torch

from dsfit.checks.finding import Finding

SUITE = "controls"
REJECTION = 1e-6
"""p-value below which a statistical check has rejected a printed form."""
MARGIN = 0.1
"""A deterministic check has rejected a form whose deviation is at least 1 / MARGIN times the bound."""

Kind = Literal["bias", "not a density", "negative", "NaN", "variance", "none"]


@dataclass(frozen=True)
class Trial:
    """What the check of a control says about both forms, and how much is at stake.

    Attributes:
        printed, corrected: the check's number for the two forms: a p-value, or a deviation >= 0 (NaN counts as
            infinite).
        bound: what a deviation must not exceed; None where the numbers are p-values.
        effect: the measured effect, one short phrase of Markdown with its numbers.
        data: numbers of the effect by name.
    """

    printed: float
    corrected: float
    bound: float | None
    effect: str
    data: dict[str, float] = field(default_factory=dict)

    @property
    def rejection(self) -> float:
        """The p-value of the printed form, or bound / deviation: small where the check has rejected it."""
        if self.bound is None:
            return self.printed
        if math.isnan(self.printed):
            return 0.0
        return self.bound / self.printed if self.printed > 0 else math.inf


@dataclass(frozen=True)
class Control:
    """An erratum that has an effect.

    Attributes:
        name: of the control, one part of the suite.
        equations: printed numbers, or where in the text.
        printed, corrected: both forms, short Markdown.
        kind: what is wrong with the printed one.
        check: what rejects it, short Markdown.
        trial: puts both forms through the check; takes a seed, which only drawn samples depend on.
    """

    name: str
    equations: str
    printed: str
    corrected: str
    kind: Kind
    check: str
    trial: Callable[[int], Trial]

    def findings(self, trial: Trial) -> list[Finding]:
        """The printed form must be rejected, and the corrected one must pass the same check."""
        limit = REJECTION if trial.bound is None else MARGIN
        kind = "p" if trial.bound is None else "deviation"
        rejected = Finding(
            SUITE,
            self.name,
            "printed form is rejected",
            value=trial.rejection,
            bound=limit,
            detail=trial.effect,
            data={**trial.data, kind: trial.printed},
        )
        passes = Finding(
            SUITE,
            self.name,
            "corrected form passes",
            p_value=trial.corrected if trial.bound is None else None,
            value=None if trial.bound is None else trial.corrected,
            bound=trial.bound,
            detail=self.check,
            data={kind: trial.corrected},
        )
        return [rejected, passes]


@dataclass(frozen=True)
class Typo:
    """An erratum without effect: nothing can be computed from it, or the text beside it is right."""

    equations: str
    printed: str
    corrected: str
    kind: Kind = "none"


class Registry(dict[str, Control]):
    """Controls by name; `add` is a decorator for their trials."""

    def add(
        self, name: str, equations: str, *, printed: str, corrected: str, kind: Kind, check: str
    ) -> Callable[[Callable[[int], Trial]], Callable[[int], Trial]]:
        """Register the decorated trial."""

        def register(trial: Callable[[int], Trial]) -> Callable[[int], Trial]:
            if name in self:
                raise ValueError(f"two controls of the name {name}")
            self[name] = Control(name, equations, printed, corrected, kind, check, trial)
            return trial

        return register


def generator_of(seed: int, stream: int = 0) -> torch.Generator:
    """A generator for one of several streams of a seed."""
    return torch.Generator().manual_seed(1_000_003 * stream + seed)


__all__ = ["MARGIN", "REJECTION", "SUITE", "Control", "Kind", "Registry", "Trial", "Typo", "generator_of"]
