"""What the checks of a scene are given."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from dsfit.checks.finding import Finding
from dsfit.context import Context
from dsfit.proposals.base import Proposal
from dsfit.scene.integrand import Integrand

Say = Callable[[str], None]
"""Told what a check does at the moment."""


def silent(_: str) -> None:
    """Says nothing."""


@dataclass(frozen=True)
class Subject:
    """A shading point and the proposals that claim to sample it.

    Attributes:
        integrand: BSDF x light x scattering, float64.
        context: a single context, of batch shape `()`.
        proposals: by name.
        label: how tables call this context.
        seed: of every random number that a check draws.
    """

    integrand: Integrand
    context: Context
    proposals: dict[str, Proposal]
    label: str = ""
    seed: int = 1


@dataclass
class Outcome:
    """What a suite returns: findings, and arrays by name for the plots."""

    findings: list[Finding] = field(default_factory=list)
    arrays: dict[str, np.ndarray] = field(default_factory=dict)
