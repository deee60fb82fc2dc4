"""The plans of a config: what its contexts do not need."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import torch

from dsfit.context import Context
from dsfit.experiment import build
from dsfit.experiment.schema import Config

if TYPE_CHECKING:
    from dsfit.experiment.validation import Experiment
    from dsfit.scene.plan import Plan


def plan_of(config: Config, context: Context | None = None) -> Plan:
    """The plan for one context, or, left out, one plan for all of the config's."""
    from dsfit.scene.plan import plan

    if context is None:
        each = [build.context(config, values) for values in build.context_values(config.contexts)]
        fields = [torch.stack([getattr(c, name) for c in each]) for name in ("theta_r", "phi_r", "n", "v")]
        context = Context(*fields)
    return plan(build.integrand(config), context, config.plan.tolerance)


def plans(experiment: Experiment) -> Iterator[tuple[str, Plan]]:
    """A heading and the plan of every grid point."""
    for point in experiment.points:
        heading = ", ".join(f"{key} = {value}" for key, value in point.values.items())
        yield heading or experiment.name, plan_of(point.config)
