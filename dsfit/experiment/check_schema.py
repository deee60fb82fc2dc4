"""`[check]`: what `dsfit check` runs, and the options of each suite."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from dsfit.experiment.sections import Section

SuiteName = Literal[
    "chi_square", "unbiased", "independent", "furnace", "gradients", "stability", "stiff_fits", "controls", "faults"
]
Level = Annotated[float, Field(gt=0, lt=1)]
HeuristicName = Literal["balance", "power", "maximum", "cutoff", "optimal"]
Count = Annotated[int, Field(ge=1)]
Names = Literal["all"] | Annotated[list[str], Field(min_length=1)]


class ChiSquareOptions(Section):
    """`[check.chi_square]`: directions drawn from each proposal, and cells in theta_i and phi."""

    samples: Annotated[int, Field(ge=100, le=10**8)] = 100_000
    cells: Annotated[list[Annotated[int, Field(ge=1, le=1000)]], Field(min_length=2, max_length=2)] = [24, 16]


class UnbiasedOptions(Section):
    """`[check.unbiased]`: samples of each estimate, MIS heuristics, and tolerance of the reference."""

    samples: Annotated[int, Field(ge=1000, le=10**8)] = 40_000
    heuristics: Annotated[list[HeuristicName], Field(min_length=1)] = [
        "balance", "power", "maximum", "cutoff", "optimal",
    ]  # fmt: skip
    rtol: Annotated[float, Field(gt=0, le=1e-3)] = 1e-5


class IndependentOptions(Section):
    """`[check.independent]`: ensembles of walkers that draw from |F| / int |F|, and directions of each proposal."""

    ensembles: Annotated[int, Field(ge=4, le=1000, multiple_of=2)] = 16
    walkers: Annotated[int, Field(ge=8, le=10_000, multiple_of=2)] = 32
    steps: Annotated[int, Field(ge=20, le=10**6)] = 300
    samples: Annotated[int, Field(ge=1000, le=10**7)] = 32_768


class FurnaceOptions(Section):
    """`[check.furnace]`: inclinations of the viewer, scattering fibres where the scene leaves them open, directions per
    proposal and inclination, and equal cells in theta_i and in phi."""

    inclinations_deg: Annotated[list[Annotated[float, Field(ge=-90, le=90)]], Field(min_length=1)] = [
        0.0,
        -50.0,
        75.0,
        89.9,
    ]
    n: Annotated[list[Annotated[float, Field(ge=0)]], Field(min_length=1)] = [0.0, 3.0]
    samples: Annotated[int, Field(ge=1000, le=10**8)] = 8192
    rings: Annotated[int, Field(ge=2, le=720)] = 36
    wedges: Annotated[int, Field(ge=1, le=720)] = 8


class GradientsOptions(Section):
    """`[check.gradients]`: points that derivatives are taken at, samples of every Monte Carlo gradient of the second
    moment, the uniform sphere's share in proposals without one, whose second moments are differentiated (those that are
    not the chapter's always are), and whether to differentiate through a fit and, in minutes, the averages."""

    points: Annotated[int, Field(ge=8, le=1000)] = 24
    samples: Annotated[int, Field(ge=1000, le=10**7)] = 20_000
    defensive: Annotated[float, Field(gt=0, lt=1)] = 0.2
    moments: Names = ["R", "TT", "mixture", "structured"]
    through_fit: bool = True
    averages: bool = False


class StabilityOptions(Section):
    """`[check.stability]`: functions by name, and decimal digits of the reference arithmetic."""

    functions: Names = "all"
    digits: Annotated[int, Field(ge=30, le=500)] = 50


class StiffFitsOptions(Section):
    """`[check.stiff_fits]`: problems and solvers by name ("controls" are the solvers that lie), and the seconds that a
    solver is told it has; most are stopped by their steps before."""

    problems: Names = "all"
    solvers: Names = "all"
    seconds: Annotated[float, Field(gt=0, le=3600)] = 20.0


class ControlsOptions(Section):
    """`[check.controls]`: controls by name."""

    controls: Names = "all"


class FaultsOptions(Section):
    """`[check.faults]`: faults by name."""

    faults: Names = "all"


class CheckConfig(Section):
    """`[check]`: suites, the level of each suite's family of p-values, and the proposals that are checked.

    `proposals` are names of the chapter's, "light", "mixture" (all of the chapter's in equal shares), "structured" (as
    it starts) or "fitted"; "all" is all but "fitted". `saved` are files of `dsfit.save_proposal`, `user` functions
    `module:name` that take (integrand, context) and return a proposal.
    """

    suites: Annotated[list[SuiteName], Field(min_length=1)] = [
        "chi_square", "unbiased", "independent", "furnace", "gradients",
    ]  # fmt: skip
    level: Level = 0.01
    proposals: Names = "all"
    saved: list[str] = []
    user: list[str] = []
    chi_square: ChiSquareOptions = ChiSquareOptions()
    unbiased: UnbiasedOptions = UnbiasedOptions()
    independent: IndependentOptions = IndependentOptions()
    furnace: FurnaceOptions = FurnaceOptions()
    gradients: GradientsOptions = GradientsOptions()
    stability: StabilityOptions = StabilityOptions()
    stiff_fits: StiffFitsOptions = StiffFitsOptions()
    controls: ControlsOptions = ControlsOptions()
    faults: FaultsOptions = FaultsOptions()
