"""The suites that `dsfit check` knows. A new one is a module with `run`, one line here, and a table of options in the
config schema.

A suite's module offers `run(..., say=..., **options) -> Outcome`, by its scope:

- `context`: `run(subject)`, once for every shading context of the config;
- `scene`: `run(integrand, seed=...)`, once for every fibre, BSDF and light of the config;
- `once`: `run(part, seed=...)` for every name in `parts(**options)`, whatever the scene.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterable
from dataclasses import dataclass
from types import ModuleType
from typing import Literal

from dsfit.errors import check_choice


@dataclass(frozen=True)
class Suite:
    """Where a suite is and what it is run over; `title` is one line for tables."""

    module: str
    scope: Literal["context", "scene", "once"]
    title: str

    def load(self) -> ModuleType:
        """The suite's module; imported when it is asked for, as some need emcee or mpmath."""
        return importlib.import_module(self.module)


SUITES: dict[str, Suite] = {
    "chi_square": Suite("dsfit.checks.chi_square", "context", "samples against the cell-integrated density"),
    "unbiased": Suite("dsfit.checks.unbiased", "context", "every estimator against the quadrature"),
    "independent": Suite("dsfit.checks.independent", "context", "ensemble MCMC against resampling"),
    "furnace": Suite("dsfit.checks.furnace", "scene", "energy, ring light, limits, reciprocity"),
    "gradients": Suite("dsfit.checks.gradients", "context", "derivatives, and gradients of the variance"),
    "stability": Suite("dsfit.checks.stability", "once", "stiff and extreme cases against 50 digits"),
    "stiff_fits": Suite("dsfit.checks.stiff_fits", "once", "every solver on badly posed fits"),
    "controls": Suite("dsfit.checks.controls", "once", "the chapter's wrong equations, which must be rejected"),
    "faults": Suite("dsfit.checks.faults", "once", "faults planted into the library, which must be caught"),
}


def chosen(field: str, names: str | Iterable[str], known: Iterable[str]) -> list[str]:
    """The parts that an option asks for: "all" that are known, or those named.

    Raises:
        InputError: a name that is not known.
    """
    if names == "all":
        return list(known)
    return [check_choice(field, name, tuple(known)) for name in names]
