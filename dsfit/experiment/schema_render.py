"""`[geometry]`, `[camera]`, `[grid]`, `[render]` and `[compare]`: a scene of hair, its picture, and techniques
compared on it. Angles are in degrees here; their keys end with `_deg`."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from dsfit.experiment.sections import Section

Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Vector = Annotated[list[float], Field(min_length=3, max_length=3)]
Channels = NonNegative | Annotated[list[NonNegative], Field(min_length=1)]
Pixels = Annotated[int, Field(ge=1, le=16384)]
Samples = Annotated[int, Field(ge=1, le=2**20)]
Seconds = Annotated[float, Field(gt=0, le=1e6)]
Share = Annotated[float, Field(ge=0, lt=1)]
Seed = Annotated[int, Field(ge=0, lt=2**31)]
Name = Annotated[str, Field(min_length=1, max_length=60, pattern=r"^[^\x00-\x1f/\\]+$")]
Generator = Literal["block", "double_block", "straight_bundle", "wavy_bundle", "curly_wisp", "ball"]


class Scale(Section):
    """Everything `factor` times as large, radii included."""

    kind: Literal["scale"]
    factor: Positive


class Rotate(Section):
    """About an axis through the origin, right-handed."""

    kind: Literal["rotate"]
    axis: Vector
    angle_deg: float


class Translate(Section):
    """Moved by a vector."""

    kind: Literal["translate"]
    by: Vector


class TurnUp(Section):
    """From a world in which the axis `up` points up."""

    kind: Literal["turn_up"]
    up: Literal["x", "y", "z", "-x", "-y", "-z"]


class FitInto(Section):
    """Scaled and moved so that their box just fits into a cube of this side, or a box of these sides, centred at the
    origin."""

    kind: Literal["fit_into"]
    size: Positive | Annotated[list[Positive], Field(min_length=3, max_length=3)]


class Thin(Section):
    """Every k-th strand; `keep` is what the change of radius keeps: the expected scatter counts, the volume, or the
    radius itself."""

    kind: Literal["thin"]
    every: Annotated[int, Field(ge=1)]
    keep: Literal["counts", "volume", "radius"] = "counts"


Transform = Annotated[Scale | Rotate | Translate | TurnUp | FitInto | Thin, Field(discriminator="kind")]


class Placed(Section):
    """What every geometry has: `transforms`, applied one after another, and a factor on the fibres' radii."""

    transforms: list[Transform] = []
    radius_factor: Positive = 1.0


class GeneratorGeometry(Placed):
    """`[geometry] kind = "block"` and so on: a generator of `dsfit.render.geometry`, with `options` as its keyword
    arguments."""

    kind: Generator = "block"
    options: dict[str, Any] = {}


class HairFile(Placed):
    """`[geometry] kind = "hair"`: a file in Cem Yuksel's format; `path` is relative to the file that names it."""

    kind: Literal["hair"]
    path: Annotated[str, Field(min_length=1)]


class PbrtFile(Placed):
    """`[geometry] kind = "pbrt"`: the `curve` shapes of a pbrt scene in text form."""

    kind: Literal["pbrt"]
    path: Annotated[str, Field(min_length=1)]


GeometryConfig = Annotated[GeneratorGeometry | HairFile | PbrtFile, Field(discriminator="kind")]


class CameraConfig(Section):
    """`[camera]`: a pinhole; `fov_deg` is the vertical angle of view. Without a `position`, it stands in `direction`
    from the strands (left out: one that suits the generator), `margin` times as far away as it takes to see all of them
    in a square picture."""

    position: Vector | None = None
    direction: Vector | None = None
    margin: Annotated[float, Field(ge=0.05, le=100)] = 1.0
    target: Vector | None = None
    up: Vector = [0.0, 1.0, 0.0]
    fov_deg: Annotated[float, Field(gt=1, lt=150)] = 30.0
    width: Pixels = 512
    height: Pixels = 512


class GridConfig(Section):
    """`[grid]`: voxels along the longest side; the march's step in voxels (left out: the grid's own choice); and the
    largest n."""

    resolution: Annotated[int, Field(ge=1, le=512)] = 64
    step: Annotated[float, Field(gt=0, le=1)] | None = None
    max_n: Positive = 100.0


class Technique(Section):
    """How directions are drawn: a kind that `dsfit.render.techniques` knows and its `options`; `light` is the share of
    samples that go to light sampling, combined by MIS."""

    kind: str = "amortised"
    options: dict[str, Any] = {}
    light: Share = 0.0
    uniforms: Literal["random", "sobol"] = "sobol"


class RenderConfig(Section):
    """`[render]`.

    Every pixel has `subsamples` camera rays; the hits get `passes` times `samples` directions, in independent passes,
    whose spread gives the variance. With `pilot`, so many passes come first, and the `passes` are an average, spread to
    where the pilots of the neighbours were noisy. Tiles of `tile` x `tile` pixels are computed and stored one by one.
    `v` is the rule for the directly lit share. `exposure` is a factor on the radiance (left out: one that suits the
    image) and, as `tone_map`, matters to the PNG alone. `seed` places the rays; the seed of the directions follows from
    it, the samples, the passes and the technique, so that images of one seed differ in their noise alone.
    """

    subsamples: Annotated[int, Field(ge=1, le=1024)] = 16
    samples: Samples = 16
    passes: Annotated[int, Field(ge=2, le=4096)] = 4
    pilot: Annotated[int, Field(ge=2, le=4096)] | None = None
    tile: Annotated[int, Field(ge=1, le=4096)] = 64
    technique: Technique = Technique(light=0.25)
    v: Literal["poisson", "threshold"] = "poisson"
    seed: Seed = 1
    dtype: Literal["float32", "float64"] = "float32"
    background: Channels = 0.0
    exposure: Positive | None = None
    tone_map: Literal["srgb", "filmic"] = "filmic"


class ComparedTechnique(Technique):
    """`[[compare.techniques]]`: a technique with a name. `light` may be "best": the share of least error in a short
    trial on the picture, whose time counts as preparation."""

    name: Name
    kind: str
    light: Share | Literal["best"] = 0.0


class ReferenceConfig(Section):
    """`[compare.reference]`: the technique of the reference image, its samples per hit and pass and its passes, and the
    technique that checks it, with `check_passes` passes."""

    technique: Technique = Technique(light=0.25)
    samples: Samples = 1024
    passes: Annotated[int, Field(ge=4, le=4096)] = 4
    check: Technique = Technique(kind="chapter", options={"model": "one"}, light=0.25)
    check_samples: Samples = 128
    check_passes: Annotated[int, Field(ge=4, le=4096)] = 8


class CompareConfig(Section):
    """`[compare]`: techniques on one small image of the scene.

    The image is `width` pixels wide, its height follows from the camera's shape, and every pixel has `subsamples` rays.
    Samples per hit double from `first` until a technique has used up its `seconds` (CPU seconds of one thread, all
    rungs together) or has reached `most`. `targets` are relative errors (root of the relative mean square) whose times
    are compared. Pictures are shown at `equal_seconds` and at `equal_samples`; `crop` is their part of the image that
    is shown large: left, top, right, bottom as shares of its sides.
    """

    width: Pixels = 160
    subsamples: Annotated[int, Field(ge=1, le=1024)] = 4
    first: Samples = 1
    most: Samples = 4096
    seconds: Seconds = 16.0
    targets: Annotated[list[Annotated[float, Field(gt=0, le=1)]], Field(min_length=1, max_length=4)] = [0.05, 0.02]
    equal_seconds: Seconds = 2.0
    equal_samples: Samples = 16
    crop: Annotated[list[Annotated[float, Field(ge=0, le=1)]], Field(min_length=4, max_length=4)] = [0.3, 0.3, 0.7, 0.7]
    reference: ReferenceConfig = ReferenceConfig()
    techniques: list[ComparedTechnique] = []
