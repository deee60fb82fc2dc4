"""`[amortise]` and the method "amortised": one proposal for every context of a fibre."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from dsfit.experiment.sections import Section

Count = Annotated[int, Field(ge=1, le=100_000)]
Hidden = Annotated[list[Annotated[int, Field(ge=1, le=4096)]], Field(max_length=8)]
Positive = Annotated[float, Field(gt=0)]


class TrainingStream(Section):
    """`[amortise.stream]`: the training contexts, as `dsfit.ContextStream` draws them."""

    theta: Literal["sphere", "angle"] = "angle"
    theta_max_deg: Annotated[float, Field(gt=0, le=90)] = 89.8
    direct: Annotated[float, Field(ge=0, le=1)] = 0.2
    n_mean: Positive = 15.0
    n_max: Positive = 30.0
    rule: Literal["threshold", "poisson", "mixed"] = "mixed"


class AmortiseConfig(Section):
    """`[amortise]`: how the proposal is trained, and how many of the contexts it has not seen are also judged by
    adaptive cubature. `seconds` of training proper instead of `steps` make the result depend on the machine."""

    steps: Annotated[int, Field(ge=0, le=1_000_000)] | None = None
    seconds: Annotated[float, Field(gt=0, le=1e6)] | None = None
    hidden: Hidden = [32, 32]
    defensive: Annotated[float, Field(gt=0, lt=1)] = 0.001
    inclinations: Count = 256
    pairs: Count = 16
    scale: Positive = 0.01
    check: Annotated[int, Field(ge=0, le=10_000)] = 4
    stream: TrainingStream = TrainingStream()


class AmortisedMethod(Section):
    """One proposal for every context: of a `file` that `dsfit.save_proposal` wrote (relative to the file that names
    it; `file_seconds` is what its training took, counted as a fit's time), or trained on the spot, once per process
    and fibre, for `seconds` or `steps`. 0 steps take it as its closed forms start it."""

    name: Annotated[str, Field(min_length=1, max_length=60, pattern=r"^[^\x00-\x1f/\\]+$")]
    kind: Literal["amortised"]
    file: Annotated[str, Field(min_length=1)] | None = None
    file_seconds: Annotated[float, Field(ge=0)] | None = None
    seconds: Annotated[float, Field(gt=0, le=1e6)] | None = None
    steps: Annotated[int, Field(ge=0, le=1_000_000)] | None = None
