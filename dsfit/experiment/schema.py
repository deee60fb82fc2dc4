"""What a config may say. Angles are in degrees here, and only here; their keys end with `_deg`."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from dsfit.experiment.check_schema import CheckConfig
from dsfit.experiment.schema_amortise import AmortiseConfig, AmortisedMethod
from dsfit.experiment.schema_lights import ConstantLight, Inclination, LightConfig, NonNegative, Positive, Vector
from dsfit.experiment.schema_plan import PlanConfig
from dsfit.experiment.schema_race import RaceConfig
from dsfit.experiment.schema_render import (
    CameraConfig,
    CompareConfig,
    GeneratorGeometry,
    GeometryConfig,
    GridConfig,
    RenderConfig,
)
from dsfit.experiment.sections import Section

SCHEMA_VERSION = 1

Share = Annotated[float, Field(ge=0, le=1)]
Name = Annotated[str, Field(min_length=1, max_length=60, pattern=r"^[^\x00-\x1f/\\]+$")]
Preset = Literal["nonabsorbing", "blond", "brown", "black"]
HeuristicName = Literal["balance", "power", "maximum", "cutoff", "optimal"]


class FiberConfig(Section):
    """`[fiber]`: a preset, and whatever differs from it."""

    preset: Preset = "blond"
    sigma_a: Annotated[list[NonNegative], Field(min_length=1)] | None = None
    eta: Annotated[float, Field(gt=1)] | None = None
    alpha_deg: Annotated[list[Inclination], Field(min_length=3, max_length=3)] | None = None
    beta_deg: Annotated[list[Positive], Field(min_length=3, max_length=3)] | None = None
    eccentricity: Annotated[float, Field(gt=0.5**0.5, lt=2**0.5)] | None = None
    caustic_width_deg: Annotated[float, Field(gt=0, le=180)] | None = None
    glint_scale: NonNegative | None = None
    caustic_fade: Positive | None = None
    caustic_max_offset: Share | None = None
    gamma_tt_deg: Positive | None = None


class BsdfConfig(Section):
    """`[bsdf]`: density factors, azimuthal model, convention by name or as `{ base = name, switch = value }`.

    `precision` "auto" takes tables of N^G where the BSDF offers them (round fibres, caustic treated), the exact
    integrals elsewhere.
    """

    d_f: Share = 0.7
    d_b: Share = 0.7
    azimuthal: Literal["marschner", "raw", "simplified"] = "marschner"
    convention: str | dict[str, str | int | bool] = "consistent"
    precision: Literal["auto", "exact", "table"] = "auto"


class ConstantScattering(Section):
    """`[scattering] kind = "constant"`: n and v are those of `[contexts]`."""

    kind: Literal["constant"] = "constant"


LitShare = Literal["poisson", "threshold"] | Share
Hint = Literal["transmitted", "mean", "forward"]


class SlabScattering(Section):
    """`[scattering] kind = "slab"`: a point at `depth` in a layer of fibres; `hint` is how contexts get their n and v
    from it."""

    kind: Literal["slab"]
    thickness: Positive
    depth: NonNegative
    density: NonNegative
    normal: Vector = [0.0, 1.0, 0.0]
    v: LitShare = "poisson"
    aligned: bool = False
    max_n: Positive = 100.0
    hint: Hint = "transmitted"


class SphereScattering(Section):
    """`[scattering] kind = "sphere"`: a point at `offset` from the centre of a ball of fibres; `hint` as for the
    slab."""

    kind: Literal["sphere"]
    radius: Positive
    density: NonNegative
    offset: Vector = [0.0, 0.0, 0.0]
    v: LitShare = "poisson"
    aligned: bool = False
    hint: Hint = "transmitted"


class ContextsConfig(Section):
    """`[contexts]`: lists that are combined as an outer product or element by element; v left out is 1 where n = 0,
    else 0."""

    theta_r_deg: Annotated[list[Inclination], Field(min_length=1)] = [0.0]
    phi_r_deg: Annotated[list[float], Field(min_length=1)] = [0.0]
    n: Annotated[list[NonNegative], Field(min_length=1)] = [0.0]
    v: Annotated[list[Share], Field(min_length=1)] | None = None
    combine: Literal["product", "zip"] = "product"


class Method(Section):
    """What every method has."""

    name: Name


class UniformMethod(Method):
    """The uniform sphere."""

    kind: Literal["uniform"]


class LightMethod(Method):
    """Sampling the light alone."""

    kind: Literal["light"]


class SingleMethod(Method):
    """One proposal of the chapter alone; `defensive` is the share given to the uniform sphere."""

    kind: Literal["single"]
    proposal: str
    defensive: Annotated[float, Field(ge=0, lt=1)] = 0.0


class HeuristicMixMethod(Method):
    """Several proposals combined by multiple importance sampling: those of the chapter, "all" (the light's too) or a
    list.

    `weights` are shares of the samples: "equal", a list, or "best": optimised on quadrature nodes, over both models.
    `heuristic` left out is balance, or, with "best", the best of all but "optimal".
    """

    kind: Literal["heuristic_mix"]
    proposals: Annotated[list[str], Field(min_length=1)] | Literal["chapter", "all"] = "chapter"
    weights: Literal["equal", "best"] | Annotated[list[NonNegative], Field(min_length=1)] = "equal"
    heuristic: HeuristicName | dict[str, str | float] | None = None
    model: Literal["multi", "one"] = "multi"


class FittedMethod(Method):
    """A proposal fitted to each context; `defensive` is its share of the uniform sphere, `starts` how many starts are
    tried."""

    kind: Literal["fitted"]
    family: Literal["structured"] = "structured"
    objective: Literal["excess", "forward_kl", "variance_cost"] = "excess"
    solver: str = "optimistix.lm"
    starts: Annotated[int, Field(ge=1, le=100)] = 1
    defensive: Annotated[float, Field(ge=0, lt=1)] = 0.001
    max_steps: Annotated[int, Field(ge=0, le=100_000)] | None = None


MethodConfig = Annotated[
    UniformMethod | LightMethod | SingleMethod | HeuristicMixMethod | FittedMethod | AmortisedMethod,
    Field(discriminator="kind"),
]
ScatteringConfig = Annotated[ConstantScattering | SlabScattering | SphereScattering, Field(discriminator="kind")]


class EstimateConfig(Section):
    """`[estimate]`: the Monte Carlo side. `repeats` independent estimates make one batch, timed as one; `rounds`
    batches are run."""

    samples: Annotated[list[Annotated[int, Field(ge=2, le=2**24)]], Field(min_length=1)] = [64, 256, 1024, 4096]
    repeats: Annotated[int, Field(ge=2, le=10_000)] = 32
    rounds: Annotated[int, Field(ge=1, le=1000)] = 3
    uniforms: Literal["random", "sobol", "stratified"] = "random"
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 1
    dtype: Literal["float32", "float64"] = "float64"
    rtol: Annotated[float, Field(gt=0, le=1e-2)] = 1e-6


class OutputConfig(Section):
    """`[output]`: where runs go (relative to the working directory) and what is drawn. `maps` is the number of
    contexts drawn as maps."""

    dir: Annotated[str, Field(min_length=1)] = "runs"
    plots: bool = True
    maps: Annotated[int, Field(ge=0, le=64)] = 4


class SweepConfig(Section):
    """`[sweep]`: what is varied. `[sweep.grid]`: dotted keys, each with the list of values it takes; all combinations
    are run. `[sweep.space]`: dotted keys, each with a range `{ low, high, scale = "linear" | "log", integer }` or
    `{ choices = [...] }`, sampled at `points` points by the design "random" or "sobol" with its `seed`; each grid point
    with each of them.
    """

    design: Literal["grid", "random", "sobol"] = "grid"
    points: Annotated[int, Field(ge=1, le=10_000_000)] | None = None
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 1
    grid: dict[str, Any] = {}
    space: dict[str, Any] = {}


class TransmittanceConfig(Section):
    """`[transmittance]`: the Gaussian proposal fitted to a_f(theta)^n for every n, against the chapter's cosine."""

    n: Annotated[list[Annotated[int, Field(ge=1, le=10_000)]], Field(min_length=1)] = list(range(1, 51))


Kind = Literal["compare", "sweep", "transmittance", "check", "race", "amortise", "render", "compare_render"]


class Config(Section):
    """A whole experiment."""

    title: Annotated[str, Field(max_length=200)] = ""
    kind: Kind = "compare"
    fiber: FiberConfig = FiberConfig()
    bsdf: BsdfConfig = BsdfConfig()
    light: LightConfig = ConstantLight()
    scattering: ScatteringConfig = ConstantScattering()
    contexts: ContextsConfig = ContextsConfig()
    plan: PlanConfig = PlanConfig()
    methods: list[MethodConfig] = []
    estimate: EstimateConfig = EstimateConfig()
    output: OutputConfig = OutputConfig()
    sweep: SweepConfig = SweepConfig()
    transmittance: TransmittanceConfig = TransmittanceConfig()
    check: CheckConfig = CheckConfig()
    race: RaceConfig = RaceConfig()
    amortise: AmortiseConfig = AmortiseConfig()
    geometry: GeometryConfig = GeneratorGeometry()
    camera: CameraConfig = CameraConfig()
    grid: GridConfig = GridConfig()
    render: RenderConfig = RenderConfig()
    compare: CompareConfig = CompareConfig()
