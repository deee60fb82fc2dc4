"""`[light]`: what lights a scene. Angles are in degrees, lengths in the scene's unit, vectors in world coordinates.

A comparison of contexts has one point, the world's origin, whose fibre frame (tangent, normal, binormal) is the world's
(x, y, z).
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from dsfit.experiment.sections import Section

Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Channels = NonNegative | Annotated[list[NonNegative], Field(min_length=1)]
Inclination = Annotated[float, Field(ge=-90, le=90)]
Vector = Annotated[list[float], Field(min_length=3, max_length=3)]
Length = Annotated[float, Field(ge=1e-12, le=1e12)]


class ConstantLight(Section):
    """`[light] kind = "constant"`: the same radiance from everywhere."""

    kind: Literal["constant"] = "constant"
    radiance: Channels = 1.0


class LobeConfig(Section):
    """One von Mises-Fisher lobe; `intensity` is its radiance integrated over the sphere, so that width does not
    change its power."""

    theta_deg: Inclination
    phi_deg: float = 0.0
    width_deg: Annotated[float, Field(ge=0.06, le=180)]
    intensity: Channels = 1.0


class LobesLight(Section):
    """`[light] kind = "lobes"`: lobes over a constant ambient radiance."""

    kind: Literal["lobes"]
    lobes: Annotated[list[LobeConfig], Field(min_length=1)]
    ambient: Channels = 0.0


class EnvironmentLight(Section):
    """`[light] kind = "environment"`: an equirectangular EXR map; `path` is relative to the file that names it."""

    kind: Literal["environment"]
    path: Annotated[str, Field(min_length=1)]
    scale: Positive = 1.0


class SunLight(Section):
    """`[light] kind = "sun"`: a uniform disc at infinity; `irradiance` of what faces it, or its `radiance`."""

    kind: Literal["sun"]
    direction: Vector
    angular_radius_deg: Annotated[float, Field(ge=6e-5, le=90)] = 0.2665
    irradiance: Channels | None = None
    radiance: Channels | None = None


class SphereLight(Section):
    """`[light] kind = "sphere"`: a glowing ball."""

    kind: Literal["sphere"]
    center: Vector
    radius: Length
    radiance: Channels = 1.0


class RectangleLight(Section):
    """`[light] kind = "rectangle"`: it shines to the side of `edge_u` x `edge_v`, or to both."""

    kind: Literal["rectangle"]
    corner: Vector
    edge_u: Vector
    edge_v: Vector
    radiance: Channels = 1.0
    two_sided: bool = False


class RingLight(Section):
    """`[light] kind = "ring"`: flat, between two radii; it shines to the side of its `normal`, or to both."""

    kind: Literal["ring"]
    center: Vector
    normal: Vector
    inner: NonNegative
    outer: Length
    radiance: Channels = 1.0
    two_sided: bool = False


class Part(Section):
    """A light as a part of a total; `share` is what part of the samples it gets, in proportion to the others."""

    share: NonNegative | None = None


class ConstantPart(ConstantLight, Part):
    """`[[light.lights]] kind = "constant"`"""


class LobesPart(LobesLight, Part):
    """`[[light.lights]] kind = "lobes"`"""


class EnvironmentPart(EnvironmentLight, Part):
    """`[[light.lights]] kind = "environment"`"""


class SunPart(SunLight, Part):
    """`[[light.lights]] kind = "sun"`"""


class SpherePart(SphereLight, Part):
    """`[[light.lights]] kind = "sphere"`"""


class RectanglePart(RectangleLight, Part):
    """`[[light.lights]] kind = "rectangle"`"""


class RingPart(RingLight, Part):
    """`[[light.lights]] kind = "ring"`"""


LightPart = Annotated[
    ConstantPart | LobesPart | EnvironmentPart | SunPart | SpherePart | RectanglePart | RingPart,
    Field(discriminator="kind"),
]


class TotalLight(Section):
    """`[light] kind = "total"`: the sum of `[[light.lights]]`, any of the other kinds, each with a `share` of the
    samples or, left out of all, by the power seen from the point."""

    kind: Literal["total"]
    lights: Annotated[list[LightPart], Field(min_length=1)]


LightConfig = Annotated[
    ConstantLight | LobesLight | EnvironmentLight | SunLight | SphereLight | RectangleLight | RingLight | TotalLight,
    Field(discriminator="kind"),
]


def light_paths(light: Any) -> list[str]:
    """The files that a light is made from."""
    return [part.path for part in getattr(light, "lights", [light]) if part.kind == "environment"]
