"""`[race]`: who races, over which stream of contexts, and for how long."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from dsfit.experiment.sections import Section

Seconds = Annotated[float, Field(gt=0, le=1e6)]
Name = Annotated[str, Field(min_length=1, max_length=60, pattern=r"^[^\x00-\x1f/\\]+$")]


class RacePeer(Section):
    """`[[race.peers]]`: a peer by the name that the registry knows it by, its options, and the kind of its uniforms."""

    name: Name
    kind: str
    options: dict[str, Any] = {}
    uniforms: Literal["random", "sobol"] = "random"


class RaceStream(Section):
    """`[race.stream]`: contexts as `dsfit.streams.ContextStream` draws them, how many, how many at once, and about how
    long a peer's longest pass over them takes. `fewest` is the size of the subset for peers whose work per context
    takes longer than that."""

    count: Annotated[int, Field(ge=16, le=10**7)] = 10_000
    batch: Annotated[int, Field(ge=1, le=10**6)] = 1000
    seconds: Seconds = 4.0
    fewest: Annotated[int, Field(ge=8, le=10**6)] = 16
    theta: Literal["sphere", "angle"] = "sphere"
    theta_max_deg: Annotated[float, Field(gt=0, le=90)] = 89.0
    direct: Annotated[float, Field(ge=0, le=1)] = 0.3
    n_mean: Annotated[float, Field(gt=0)] = 8.0
    n_max: Annotated[float, Field(gt=0)] = 30.0
    rule: Literal["threshold", "poisson", "mixed"] = "poisson"


class RaceSingle(Section):
    """`[race.single]`: seconds that a peer has for the estimates at each of `[contexts]`, and how many independent
    estimates of every length are made: `seeds` where they are quick, `fewest` at least."""

    seconds: Seconds = 1.5
    seeds: Annotated[int, Field(ge=8, le=10_000)] = 64
    fewest: Annotated[int, Field(ge=8, le=10_000)] = 8


class RaceConfig(Section):
    """`[race]`.

    `implementation` of the BSDF that all peers use: "compiled" (dsfit.kernels, float32), "eager" (torch, the dtype of
    `[estimate]`), or "auto": compiled where a compiler works and the dtype is float32. `budgets` are the seconds for
    which winners are named.
    """

    implementation: Literal["auto", "compiled", "eager"] = "auto"
    peers: list[RacePeer] = []
    stream: RaceStream = RaceStream()
    single: RaceSingle = RaceSingle()
    budgets: Annotated[list[Seconds], Field(min_length=1)] = [1e-3, 1e-2, 0.1, 1.0, 10.0, 100.0]
