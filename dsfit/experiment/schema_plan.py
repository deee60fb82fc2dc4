"""`[plan]`: what a run leaves out of its integrand."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from dsfit.experiment.sections import Section


class PlanConfig(Section):
    """`[plan]`: `tolerance` is the largest error of the integral, relative to what is kept, that leaving terms out may
    make, proven before anything is evaluated; 0 leaves out exact zeros alone."""

    tolerance: Annotated[float, Field(ge=0, lt=1)] = 0.0
