"""The faults, module by module."""

from __future__ import annotations

from collections.abc import Sequence

from dsfit.checks.faults.in_bsdf import BSDF_FAULTS
from dsfit.checks.faults.in_estimators import ESTIMATOR_FAULTS
from dsfit.checks.faults.in_samplers import SAMPLER_FAULTS
from dsfit.checks.faults.planting import Fault
from dsfit.checks.faults.unseen import UNSEEN_FAULTS


def _named(groups: Sequence[Sequence[Fault]]) -> dict[str, Fault]:
    found: dict[str, Fault] = {}
    for fault in (fault for group in groups for fault in group):
        if fault.name in found:
            raise ValueError(f"two faults called {fault.name}")
        found[fault.name] = fault
    return found


FAULTS: dict[str, Fault] = _named((BSDF_FAULTS, SAMPLER_FAULTS, ESTIMATOR_FAULTS, UNSEEN_FAULTS))
"""Name to fault."""
