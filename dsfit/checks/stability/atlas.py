"""The stability atlas: every function that is measured, by name."""

from __future__ import annotations

import functools
import importlib

from dsfit.checks.stability.function import Function, class_of

MODULES = (
    "normal_functions",
    "lobe_functions",
    "inclination_functions",
    "azimuth_functions",
    "mass_functions",
    "azimuth_mass_functions",
    "frame_functions",
    "weight_functions",
    "bsdf",
)
"""Modules with a list `FUNCTIONS`, in the order of the map's rows."""


@functools.cache
def functions() -> dict[str, Function]:
    """Name to entry.

    Raises:
        ValueError: two entries of one name.
        KeyError: a regime of no class.
    """
    found: dict[str, Function] = {}
    for name in MODULES:
        for function in importlib.import_module(f"dsfit.checks.stability.{name}").FUNCTIONS:
            if function.name in found:
                raise ValueError(f"two functions called {function.name}")
            for regime in function.regimes:
                class_of(regime)
            found[function.name] = function
    return found
